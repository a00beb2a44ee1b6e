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


def answers_of_shipped(run: "Run", method: str) -> dict[str, float]:
    """Built-in method -> the share of a method's answers that are its shipped ones, where that is `ALIKE_SHARE` or more.

    An answer is a shipped one if grasp and handover pose both have the ee within `ALIKE_M` of it. Other built-in methods agree
    in none of 1,000 trials of r2h-v2.

    Args:
        run: with poses.
        method: name in the run.
    """
    ids, places = _places(run, method)
    shares: dict[str, float] = {}
    for folder in stored_rows():
        header = read_header(folder)
        digests = run.header.get("digests", {}), header["digests"]
        if "poses" not in header["stored"] or len({d.get("benchmark") for d in digests}) > 1:
            continue
        stored = load_baselines(folder, verify=False)
        for name in stored.methods:
            own, there = _places(stored, name)
            _, a, b = np.intersect1d(ids, own, return_indices=True)
            near = np.linalg.norm(places[a] - there[b], axis=2) <= ALIKE_M
            shares[name] = max(shares.get(name, 0.0), near.all(1).sum() / max(len(ids), 1))
    return {name: float(share) for name, share in shares.items() if share >= ALIKE_SHARE}


def _places(run: "Run", method: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Trials, and where the ee is on the object and in the world (n, 2, 3), m."""
    table = run.poses(method)
    T = [
        pc.list_flatten(table[k]).to_numpy().astype(np.float64).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    ]
    return table["trial_id"].to_numpy(), np.stack([x[:, :3, 3] for x in T], 1)
