"""Makes held_out.npz: ``python -m r2h_batch.assets.receiving.build_held_out``.

It holds, per object, ``<name>/side``, ``<name>/T_obj_hand``, ``<name>/pose``, ``<name>/shape``, ``<name>/part`` as in
``r2h_batch.trials.holding.receiving`` and ``<name>/grip_n`` as in
``r2h_batch.trials.holding.held_out``. About 20 CPU minutes; the same bytes on the same kind of machine.
Reception reads it, predictors never do.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.scene.objects import stored_objects
from r2h_batch.trials.holding.held_out import sample_held_out

HERE = Path(__file__).resolve().parent


def made(name: str) -> tuple[dict[str, NDArray[Any]], float]:
    """Arrays of one built-in object, and the CPU seconds they took."""
    begin = time.process_time()
    return sample_held_out(stored_objects()[name]), time.process_time() - begin


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
            carried = np.isfinite(found["grip_n"]).mean()
            print(
                f"{name:16s} {len(found['side'])} grasps, {100 * carried:.0f} % of gravities carried, {seconds:5.1f} CPU-s",
                flush=True,
            )
    write_npz(HERE / "held_out.npz", arrays)


if __name__ == "__main__":
    main()
