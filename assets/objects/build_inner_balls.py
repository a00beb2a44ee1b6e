"""Stores the largest ball inside the hull of every shipped object: ``python -m r2h_batch.assets.objects.build_inner_balls``.

A process finds those of other objects when it needs them, by linear programs.
"""

import json
from pathlib import Path

import numpy as np

from r2h_batch.scene.bounds import BALLS, hull_key, inner_ball
from r2h_batch.scene.objects import BUILT_IN_NAMES, INSTANCE_NAMES, load_objects


def main() -> None:
    hulls = [o.hull_vertices.astype(np.float64) for o in load_objects((*BUILT_IN_NAMES, *INSTANCE_NAMES))]
    rows = (f"{json.dumps(hull_key(hull))}: {json.dumps(inner_ball(hull).tolist())}" for hull in hulls)
    (Path(__file__).parent / BALLS).write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
