"""Masses of an imported arm: those of its file, and those of what its links fill where the file says none."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.data.robot_chain import Chain, Rigid, holding_torque
from r2h_batch.data.robot_links import Link
from r2h_batch.scene.robot import Dynamics, Robot, frozen

Array = NDArray[np.float64]

DENSITY_KG_M3 = 1000.0
"""Mass of a link whose file says none, by the volume of its mesh's convex hull. The links of eleven arms whose files say
their masses have 720 to 1,130 together [choice]."""
LEAST_KG = 0.05
"""The least such mass: of a link that collides as a ball of 1 mm, too [choice]."""
MOST_KG, MOST_KG_M2 = 1e3, 1e3
"""The most that a link of a robot file may have."""
FLAT_M = 1e-6
"""Extent of a link's corners below which they have no hull."""
ROUNDED, MOST_EXCESS = 1.001, 1.25
"""By how much the largest moment of a link may be above the sum of the others: as rounding makes it, and as files of
vendors have it."""
ROUNDING_KG_M2 = 1e-15
"""Moments below this come of turning a tensor of zeros."""
SMALL_EFFORT_NM, STIFF, SOFT = 40.0, 10_000.0, 2_000.0
"""Servos below this effort are soft, N m/rad: the UR5e's rule [choice]."""


def check_masses(chain: Chain, shown: str) -> Chain:
    """The chain with moments that bodies can have. Links of which the file says no mass or no tensor stay as they are.

    Args:
        chain: the arm.
        shown: the file, for messages.

    Raises:
        FileError: a link's mass or moments are those of no body.
    """
    links, mended = [chain.links[0]], []
    for link in chain.links[1:]:
        moments, axes = np.linalg.eigh(link.inertia)
        most = moments[0] + moments[1]
        if _unsaid(link):
            links.append(link)
            continue
        if link.mass <= 0 or moments[0] <= 0 or moments[2] > MOST_EXCESS * most:
            what = f"mass {link.mass:g} kg, moments {moments} kg m^2"
            raise FileError(f"{shown}: link {printable(link.name)} is not a body: {what}")
        if link.mass > MOST_KG or moments[2] > MOST_KG_M2:
            what = f"has {link.mass:.0f} kg and moments to {moments[2]:.0f} kg m^2"
            most = f"{MOST_KG:g} kg and {MOST_KG_M2:g} kg m^2 are allowed"
            raise FileError(f"{shown}: link {printable(link.name)} {what}; {most}")
        if moments[2] > ROUNDED * most:  # no body has such moments, and the simulator takes none
            mended.append(link.name)
            tensor = (axes * [moments[0], moments[1], most]) @ axes.T
            links.append(replace(link, inertia=tensor))
        else:
            links.append(link)
    if mended:
        what = f"{shown}: the largest moment of {printable(', '.join(mended))[:120]} is above the sum of the others"
        warnings.warn(f"{what}, as of no body: taken as the sum", stacklevel=3)
    if unsaid := [link.name for link in links[1:] if _unsaid(link)]:
        what = f"{shown}: no mass or no inertia of {printable(', '.join(unsaid))[:120]}"
        how = f"those of its convex hull at {DENSITY_KG_M3:g} kg/m3; an <inertial> in the file replaces them"
        warnings.warn(f"{what}: {how}", stacklevel=3)
    return replace(chain, links=tuple(links))


def weighed(chain: Chain, links: Sequence[Link], shown: str) -> tuple[Chain, tuple[int, ...]]:
    """The chain with a mass of every link, the torques that follow from them, and the numbers of the links that got one.

    Args:
        chain: the arm, after `check_masses`.
        links: how its links look.
        shown: the file, for messages.

    Raises:
        FileError: a link is as heavy as no robot's.
    """
    parts, got = list(chain.links), []
    for k, part in enumerate(chain.links):
        if k and _unsaid(part):
            parts[k] = _with_mass(part, links[k].triangles)
            got.append(k)
            if parts[k].mass > MOST_KG:
                what = f"{shown}: link {printable(part.name)} fills so much that it would weigh {parts[k].mass:.0f} kg"
                how = "correct the scale of its meshes, or give it an <inertial>"
                raise FileError(
                    f"{what} at {DENSITY_KG_M3:g} kg/m3, allowed are {MOST_KG:g}; {how}"
                )
    if not got:
        return chain, ()
    torque = holding_torque(chain.T_parent_joint, chain.T_last_flange, parts)
    assumed = [name in chain.assumed for name in chain.joints]
    effort = np.where(assumed, torque, chain.effort)
    return replace(chain, links=tuple(parts), effort=effort), tuple(got)


def dynamics_of(chain: Chain, robot: Robot) -> Dynamics:
    """Masses and servos of an arm whose links all have a mass, as simulators take them; servos by the UR5e's rule."""
    moving = chain.links[1:]
    return replace(
        robot.dynamics,
        mass=frozen([link.mass for link in moving]),
        com=frozen([link.com for link in moving]),
        inertia=frozen([link.inertia for link in moving]),
        stiffness=frozen(np.where(chain.effort < SMALL_EFFORT_NM, SOFT, STIFF)),
    )


def _unsaid(link: Rigid) -> bool:
    """Whether the file leaves the link's mass or tensor out, as a mesh's or as zeros."""
    return np.abs(link.inertia).max() < ROUNDING_KG_M2 and link.mass >= 0


def _with_mass(link: Rigid, triangles: Array) -> Rigid:
    """The link with the mass and the tensor of the convex hull of its triangles (F, 3, 3); a mass of the file, and where it
    lies, stays."""
    corners = triangles.reshape(-1, 3)
    flat = np.ptp(corners, 0).min() < FLAT_M  # it has no hull: a box
    solid = (
        trimesh.creation.box(bounds=[corners.min(0) - FLAT_M, corners.max(0) + FLAT_M])
        if flat
        else trimesh.convex.convex_hull(corners)
    )
    mass = link.mass or max(DENSITY_KG_M3 * float(solid.volume), LEAST_KG)
    com = link.com if link.mass else np.asarray(solid.center_mass)
    return replace(link, mass=mass, com=com, inertia=mass / solid.volume * solid.moment_inertia)
