"""`HandoverEnv` under its name in Gymnasium's registry.

`import r2h_batch` registers it once Gymnasium is imported, before or after. This module, or any part of
the closed loop, imports Gymnasium and registers it.
"""

import gymnasium

ID = "r2h_batch/Handover-v1"


def register() -> None:
    """Make `gymnasium.make` and `gymnasium.make_vec` know the environment. A second call changes nothing."""
    place = "r2h_batch.view.environment"
    if ID not in gymnasium.registry:
        gymnasium.register(
            ID,
            entry_point=f"{place}:make_single",
            vector_entry_point=f"{place}:make_vector",
            order_enforce=False,  # the environment says so itself
        )
