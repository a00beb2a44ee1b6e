"""`HandoverEnv` and `TableHandoverEnv` under their names in Gymnasium's registry.

`import r2h_batch` registers it once Gymnasium is imported, before or after. This module, or any part of
the closed loop, imports Gymnasium and registers it.
"""

import warnings

import gymnasium

ID = "r2h_batch/Handover-v1"
TABLE_ID = "r2h_batch/Handover-v3"
"""The same on the draft r2h-v3: episodes begin with the object on the table."""
OF_TABLE = {"benchmark": "r2h-v3-draft", "method": "learned"}
"""Its arguments, unless others are given. The oracle would search for minutes."""


def register() -> None:
    """Make `gymnasium.make` and `gymnasium.make_vec` know the environments. A second call changes nothing."""
    # Gymnasium takes a higher number for a newer version; this one begins elsewhere
    warnings.filterwarnings("ignore", message=r".*Handover-v1 is out of date")
    place = "r2h_batch.view.environment"
    for name, given in ((ID, {}), (TABLE_ID, OF_TABLE)):
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{place}:make_single",
                vector_entry_point=f"{place}:make_vector",
                order_enforce=False,  # the environment says so itself
                kwargs=dict(given),
            )
