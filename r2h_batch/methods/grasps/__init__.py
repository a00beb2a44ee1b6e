"""Grasps of an object: proposed at antipodal points, tried on the gripper, scored, chosen; the
user's own, seated."""
