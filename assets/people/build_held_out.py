"""Makes held_out.npz and capacity.npz of the built-in people's hand: ``python -m r2h_batch.assets.people.build_held_out``.

After build_people. What receiving/build_held_out.py and build_capacity.py make of the built-in hand, of another hand and for
the objects of r2h-v1. About 25 CPU minutes, no anny. Reception reads both, predictors never do.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.data.people import people_hand
from r2h_batch.scene.arrays import read_arrays
from r2h_batch.scene.objects import OBJECT_NAMES, ObjectModel, stored_objects
from r2h_batch.trials.holding.capacity import capacities
from r2h_batch.trials.holding.held_out import sample_held_out
from r2h_batch.trials.holding.receiving import FIELDS, ReceivingGrasps

HERE = Path(__file__).resolve().parent


def made(model: ObjectModel) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Held-out grasps of an object with the built-in people's hand, and what they withstand."""
    hand = people_hand()
    found = sample_held_out(model, hand=hand)
    none = torch.zeros(len(found["side"]), dtype=torch.int32)
    grasps = ReceivingGrasps(none, **{k: torch.from_numpy(found[k]) for k in FIELDS}, instruction=none, hand=hand)
    return found, capacities(model, grasps.vertices.numpy(), hand)


def main() -> None:
    """Writes both files after each object and prints a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="make these and keep the others; default: all")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the two files")
    args = parser.parse_args()
    files = [args.out / "held_out.npz", args.out / "capacity.npz"]
    arrays = [dict(read_arrays(f)) if args.names and f.exists() else {} for f in files]
    for name in args.names or OBJECT_NAMES:
        begin, parts = time.process_time(), made(stored_objects()[name])
        for file, there, part in zip(files, arrays, parts, strict=True):
            there |= {f"{name}/{key}": value for key, value in part.items()}
            write_npz(file, there)
        carried, seconds = np.isfinite(parts[0]["grip_n"]).mean(), time.process_time() - begin
        count = len(parts[0]["side"])
        print(
            f"{name:16s} {count} grasps, {100 * carried:.0f} % of gravities carried, {seconds:5.1f} CPU-s", flush=True
        )


if __name__ == "__main__":
    main()
