"""Makes receiving.npz, the receiving grasps of the built-in people's hand, and hulls.npz, the hulls of the hands of all
people: ``python -m r2h_batch.assets.people.build_receiving``.

After build_people. The sampler of receiving/build_receiving.py on another hand: a CPU minute, no anny.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.data.people import ALL, built_in_people, people_hand, people_hand_set
from r2h_batch.scene.hand import posed_hulls
from r2h_batch.scene.objects import stored_objects
from r2h_batch.trials.holding.sampler import sample_receiving

HERE = Path(__file__).resolve().parent


def made(name: str) -> tuple[dict[str, NDArray[Any]], float]:
    """Arrays of one built-in object, and the CPU seconds they took."""
    begin = time.process_time()
    return sample_receiving(stored_objects()[name], hand=people_hand()), time.process_time() - begin


def write_hulls() -> None:
    """Writes hulls.npz: for each hand, which vertices of each piece lie on the piece's hull, as packed bits."""
    hands, pieces = people_hand_set(built_in_people(ALL)), [p.numpy() for p in people_hand().pieces]
    ids, offsets = posed_hulls(hands.model, hands.pose, hands.shape, hands.side)
    on = [np.isin(pieces[k % len(pieces)], ids[a:b]) for k, (a, b) in enumerate(pairwise(offsets))]
    write_npz(HERE / "hulls.npz", {"on_hull": np.packbits(np.concatenate(on).reshape(len(hands), -1), axis=1)})


def main() -> None:
    """Writes both files and prints a line per object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=1, help="objects made at a time; the result is the same")
    args = parser.parse_args()
    arrays: dict[str, NDArray[Any]] = {}
    names = list(stored_objects())
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name, (found, seconds) in zip(names, pool.map(made, names), strict=True):
            arrays |= {f"{name}/{key}": value for key, value in found.items()}
            left = int(found["side"].sum())
            print(f"{name:16s} {len(found['side']) - left} right, {left} left, {seconds:5.1f} CPU-s", flush=True)
    write_npz(HERE / "receiving.npz", arrays)
    write_hulls()


if __name__ == "__main__":
    main()
