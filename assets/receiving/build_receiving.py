"""Makes receiving.npz and receiving_report.json: ``python -m r2h_batch.assets.receiving.build_receiving``.

receiving.npz holds, per object, ``<name>/side``, ``<name>/T_obj_hand``, ``<name>/pose``, ``<name>/shape``
and ``<name>/part`` as in ``r2h_batch.receiving.ReceivingGrasps``. Some four CPU minutes.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.hand import arrays_digest, load_hand, load_hand_set
from r2h_batch.objects import load_objects, object_digest
from r2h_batch.receiving import describe_grasps
from r2h_batch.receiving_sampler import sample_receiving

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Writes both files and prints a line per object."""
    arrays: dict[str, NDArray[Any]] = {}
    report: dict[str, object] = {}
    for model in load_objects():
        begin = time.process_time()
        found = sample_receiving(model)
        arrays |= {f"{model.name}/{key}": value for key, value in found.items()}
        report[model.name] = line = describe_grasps(model, found)
        print(f"{model.name:16s} {time.process_time() - begin:5.1f} CPU-s  {json.dumps(line)}", flush=True)
    write_npz(HERE / "receiving.npz", arrays)
    summary = {
        "digest": arrays_digest(arrays),
        "hand_digest": arrays_digest({"v": load_hand().vertices.numpy(), "w": load_hand().weights.numpy()}),
        "handset_digest": load_hand_set().digest,
        "objects_digest": object_digest(load_objects()),
        "objects": report,
    }
    (HERE / "receiving_report.json").write_text(json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main()
