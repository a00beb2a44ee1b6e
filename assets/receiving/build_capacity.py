"""Makes capacity.npz, for the objects of r2h-v1: ``python -m r2h_batch.assets.receiving.build_capacity``.

It holds, per object, the arrays of ``r2h_batch.trials.holding.capacity.FORM`` of the grasps in held_out.npz, as ``NAME/FIELD``.
About two CPU minutes; the same bytes on the same kind of machine. Transfers read it, predictors never do.
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
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import OBJECT_NAMES, stored_objects
from r2h_batch.trials.holding.capacity import of_held_out

HERE = Path(__file__).resolve().parent


def made(name: str) -> tuple[dict[str, NDArray[Any]], float]:
    """Arrays of one built-in object, and the CPU seconds they took."""
    model, begin = stored_objects()[name], time.process_time()
    return of_held_out(model, load_hand()), time.process_time() - begin


def main() -> None:
    """Writes the file and prints a line per object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=1, help="objects made at a time; the result is the same")
    args = parser.parse_args()
    arrays: dict[str, NDArray[Any]] = {}
    names = list(OBJECT_NAMES)
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name, (found, seconds) in zip(names, pool.map(made, names), strict=True):
            arrays |= {f"{name}/{key}": value for key, value in found.items()}
            carried = (found["total_n"] > 0).mean()
            print(
                f"{name:16s} {len(found['total_n'])} grasps, {100 * carried:.0f} % of gravities carried, {seconds:6.1f} CPU-s",
                flush=True,
            )
    write_npz(HERE / "capacity.npz", arrays)


if __name__ == "__main__":
    main()
