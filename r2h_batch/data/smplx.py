"""Arms of SMPL-X bodies (Pavlakos et al. 2019): where shoulder, elbow and wrist stand.

A joint follows from the vertices at rest by J_regressor, and from the turns of the joints above it;
blend shapes of the pose move no joint. Sequences of GRAB and ARCTIC name the subject's own mesh, whose
vertices stand in for v_template.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import path_within, printable, read_npz
from r2h_batch.data.arrays import numbers
from r2h_batch.scene.mesh_import.file import load_mesh_file

F64 = NDArray[np.float64]
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
"""Parent joints of pelvis, hips, spine, legs, neck, collars, head and arms; face and fingers
follow."""
CHAINS = ((0, 3, 6, 9, 14, 17, 19, 21), (0, 3, 6, 9, 13, 16, 18, 20))
"""From the pelvis to the right wrist, and to the left one."""
GENDERS = ("male", "female", "neutral")
MAX_BYTES = 1 << 30
MOST_VERTICES = 20_000


@dataclass(frozen=True)
class Bodies:
    """A folder with SMPLX_MALE.npz, SMPLX_FEMALE.npz, SMPLX_NEUTRAL.npz, or some of them."""

    folder: Path

    def arms(self, gender: str, root: Path, mesh: str, columns: Sequence[F64]) -> F64 | None:
        """Shoulder, elbow and wrist of right and left arms.

        Args:
            gender: male, female or neutral.
            root: the folder that `mesh` is in or below.
            mesh: the body's own vertices at rest; without this file those of the model.
            columns: (F, 3) global orientation, (F, 3) translation, (F, 63) turns of joints 1 to 21.

        Returns:
            (2, F, 3, 3) m, the sequence's world; None, told once, where the model cannot be read.
        """
        rest = _rest_joints(self.folder, gender, root, mesh)
        if rest is None:
            return None
        turn, place, body = columns
        every = np.concatenate([turn, body], 1).reshape(len(turn), -1, 3)
        arms = np.zeros((2, len(turn), 3, 3))
        for side, chain in enumerate(CHAINS):
            at, R = rest[0] + place, Rotation.from_rotvec(every[:, 0])
            for k, (above, joint) in enumerate(pairwise(chain)):
                at = at + R.apply(rest[joint] - rest[above])
                R = R * Rotation.from_rotvec(every[:, joint])
                if k >= len(chain) - 4:
                    arms[side, :, k - len(chain) + 4] = at
        return arms


@lru_cache(maxsize=64)
def _rest_joints(folder: Path, gender: str, root: Path, mesh: str) -> F64 | None:
    """(22, 3) joints of a body at rest."""
    try:
        if gender not in GENDERS:
            raise FileError(f"gender {printable(gender)[:40]!r}; SMPL-X has {', '.join(GENDERS)}")
        template, regressor = _model(folder / f"SMPLX_{gender.upper()}.npz")
    except FileError as error:
        LOG.info(f"{printable(error)}; arms of such bodies stay unknown")
        return None
    try:
        file = path_within(root, mesh)
        if not file.is_file():
            raise FileError(f"not in {printable(root)}")
        own = np.asarray(load_mesh_file(file, mesh).vertices, np.float64)
        if own.shape != template.shape:
            raise FileError(f"{len(own)} vertices; the model has {len(template)}")
        template = own
    except ValueError as error:
        LOG.info(f"{printable(mesh)}: {printable(error)}; its arms get the model's own lengths")
    return np.asarray(regressor @ template)


@lru_cache(maxsize=4)
def _model(path: Path) -> tuple[F64, F64]:
    """v_template (V, 3) and the rows of J_regressor (22, V)."""
    names, where = ("v_template", "J_regressor", "kintree_table"), printable(path)
    found = read_npz(path, only=names, most=MAX_BYTES, most_each=MAX_BYTES)
    if missing := [n for n in names if n not in found]:
        raise FileError(f"{where}: has no {missing[0]}; it is not an SMPL-X model")
    template = numbers(found["v_template"], (None, 3), f"{where} v_template")
    if len(template) > MOST_VERTICES:
        raise FileError(f"{where}: {len(template)} vertices; at most {MOST_VERTICES} are allowed")
    regressor = numbers(found["J_regressor"], (None, len(template)), f"{where} J_regressor")
    tree = numbers(found["kintree_table"], (2, None), f"{where} kintree_table", most=2.0**32)
    if len(regressor) < len(PARENTS) or tuple(tree[0, 1 : len(PARENTS)]) != PARENTS[1:]:
        raise FileError(f"{where}: kintree_table is not SMPL-X' (parents {PARENTS})")
    return template, regressor[: len(PARENTS)]
