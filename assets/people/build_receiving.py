"""Makes receiving.npz, the receiving grasps of the built-in people's hand: ``python -m r2h_batch.assets.people.build_receiving``.

After build_people. The sampler of receiving/build_receiving.py on another hand: a CPU minute, no anny.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.data.people import people_hand
from r2h_batch.scene.objects import stored_objects
from r2h_batch.trials.holding.sampler import sample_receiving

HERE = Path(__file__).resolve().parent


def made(name: str) -> tuple[dict[str, NDArray[Any]], float]:
    """Arrays of one built-in object, and the CPU seconds they took."""
    begin = time.process_time()
    return sample_receiving(stored_objects()[name], hand=people_hand()), time.process_time() - begin


def main() -> None:
    """Writes the file and prints a line per object."""
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


if __name__ == "__main__":
    main()
