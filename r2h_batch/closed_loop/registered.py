"""`HandoverEnv` under its names in Gymnasium's registry.

`import r2h_batch` registers it once Gymnasium is imported, before or after. This module, or any part of
the closed loop, imports Gymnasium and registers it.
"""

from typing import Any

import gymnasium

ID = "r2h_batch/Handover-v1"
FROM_TABLE = "r2h_batch/Handover-v3"
"""On the benchmark whose objects are picked from the table: episodes begin where they are lifted."""
BENCHMARKS: dict[str, dict[str, Any]] = {ID: {}, FROM_TABLE: {"benchmark": "r2h-v3"}}
"""Name of an environment -> arguments that it is made with."""


def register() -> None:
    """Make `gymnasium.make` and `gymnasium.make_vec` know the environments. A second call changes nothing."""
    place = "r2h_batch.view.environment"
    for name in BENCHMARKS.keys() - gymnasium.registry.keys():
        gymnasium.register(
            name,
            entry_point=f"{place}:make_single",
            vector_entry_point=f"{place}:make_vector",
            order_enforce=False,  # the environment says so itself
            kwargs=BENCHMARKS[name],
        )
