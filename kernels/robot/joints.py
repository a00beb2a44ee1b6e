"""How many joints the arm has, and what follows from it. Links: 0 the base, one a joint, then gripper and attached object."""

import warp as wp

from .. import JOINTS as _JOINTS

JOINTS = wp.constant(_JOINTS)
LAST = wp.constant(_JOINTS - 1)
"""The last joint."""
LAST_LINK = wp.constant(_JOINTS)
"""The arm's last link: gripper and object ride on it."""
GRIPPER = wp.constant(_JOINTS + 1)
OBJECT = wp.constant(_JOINTS + 2)
LINKS = wp.constant(_JOINTS + 3)
FRAMES = wp.constant(_JOINTS + 1)
"""Frames of the arm's links, base to last link."""
CHANGES = wp.constant(_JOINTS + 1)
"""Row from which on `twists` writes how the twists change."""
FIELDS = wp.constant(2 * _JOINTS + 2)
"""Rows that `twists` writes."""

vecq = wp.types.vector(length=_JOINTS, dtype=float)
"""A number a joint, float32."""
vecqd = wp.types.vector(length=_JOINTS, dtype=wp.float64)
