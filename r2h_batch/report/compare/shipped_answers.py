"""Answers that are those of a shipped method, or of a board's baseline: a board gives them no place."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

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


def answers_of_shipped(run: "Run", method: str, baselines: "Run | None" = None) -> dict[str, float]:
    """Built-in method or baseline -> the share of a method's answers that are its stored ones, where that is `ALIKE_SHARE`
    or more.

    An answer is a shipped one if grasp and handover pose both have the ee within `ALIKE_M` of it, or within `MOVED_M` with the
    object turned by at most `MOVED_DEG`. How the gripper is turned about the object does not count: a half turn about its axis
    is the same grasp.

    Args:
        run: with poses.
        method: name in the run.
        baselines: those of a board, beside the shipped rows: a benchmark may have no other ones. None: the shipped alone.
    """
    ids, places, turns = _places(run, method)
    shares: dict[str, float] = {}
    for stored in _stored(run.header, baselines):
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


def _stored(header: Mapping[str, Any], baselines: "Run | None") -> Iterator["Run"]:
    """The stored runs with poses on a run's benchmark."""

    def suits(own: Mapping[str, Any]) -> bool:
        digests = header.get("digests", {}), own.get("digests", {})
        return "poses" in own.get("stored", ()) and len({d.get("benchmark") for d in digests}) == 1

    for folder in stored_rows():
        if suits(read_header(folder)):
            yield load_baselines(folder, verify=False)
    if baselines is not None and baselines.folder not in stored_rows() and suits(baselines.header):
        yield baselines


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
