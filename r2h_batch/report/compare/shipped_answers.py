"""Answers that are those of a shipped method: a board gives them no place."""

from typing import TYPE_CHECKING

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from r2h_batch.report.compare.stored import load_baselines, stored_rows
from r2h_batch.runs.header import read_header

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

ALIKE_M, ALIKE_SHARE = 1e-3, 0.01
"""Answers nearer than this are the same; a method with this share of another one's answers has them from it [choice]."""
MOVED_M, MOVED_DEG = 20e-3, 8.0
"""So far an answer may be moved, and the object turned by it, and is still another one's [choice]. Of shipped methods at most
0.2 % of the answers are so near to another one's (all presets, 1,000 trials each), 5 % if the object's turn does not count."""


def answers_of_shipped(run: "Run", method: str) -> dict[str, float]:
    """Built-in method -> the share of a method's answers that are its shipped ones, where that is `ALIKE_SHARE` or more.

    An answer is a shipped one if grasp and handover pose both have the ee within `ALIKE_M` of it, or within `MOVED_M` with the
    object turned by at most `MOVED_DEG`. How the gripper is turned about the object does not count: a half turn about its axis
    is the same grasp.

    Args:
        run: with poses.
        method: name in the run.
    """
    ids, places, turns = _places(run, method)
    shares: dict[str, float] = {}
    for folder in stored_rows():
        header = read_header(folder)
        digests = run.header.get("digests", {}), header["digests"]
        if "poses" not in header["stored"] or len({d.get("benchmark") for d in digests}) > 1:
            continue
        stored = load_baselines(folder, verify=False)
        for name in stored.methods:
            own, there, turned = _places(stored, name)
            _, a, b = np.intersect1d(ids, own, return_indices=True)
            apart = np.linalg.norm(places[a] - there[b], axis=2).max(1)
            cosine = (np.einsum("nij,nij->n", turns[a], turned[b]) - 1) / 2
            near = (apart <= ALIKE_M) | (
                (apart <= MOVED_M) & (cosine >= np.cos(np.radians(MOVED_DEG)))
            )
            shares[name] = max(shares.get(name, 0.0), near.sum() / max(len(ids), 1))
    return {name: float(share) for name, share in shares.items() if share >= ALIKE_SHARE}


def _places(
    run: "Run", method: str
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Trials, where the ee is on the object and in the world (n, 2, 3), m, and how the object is turned (n, 3, 3)."""
    table = run.poses(method)
    T_obj_ee, T_world_ee = (
        pc.list_flatten(table[k]).to_numpy().astype(np.float64).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    )
    places = np.stack([T_obj_ee[:, :3, 3], T_world_ee[:, :3, 3]], 1)
    return (
        table["trial_id"].to_numpy(),
        places,
        T_world_ee[:, :3, :3] @ T_obj_ee[:, :3, :3].transpose(0, 2, 1),
    )
