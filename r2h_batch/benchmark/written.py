"""The built-in benchmark as a file: equal to it in every number, so its digest is the same."""

from typing import Any

import yaml

from r2h_batch.benchmark.file import BenchmarkFile, ObjectEntry
from r2h_batch.benchmark.words import S0_ROLES, THINGS
from r2h_batch.bodies.objects import ObjectModel, load_objects

__all__ = ["built_in_text"]

ABOUT = """\
# The built-in benchmark. `r2h-batch benchmark show` prints what every field may hold, `r2h-batch benchmark check FILE` reads
# a file, `r2h-batch sweep --benchmark FILE` scores on it. What is left out is as here. The robot is a UR5e with a 2F-85.
"""


class _Plain(yaml.SafeDumper):
    """Nothing is an anchor: readers of these files refuse them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def built_in_text() -> str:
    """YAML that `read_benchmark` reads as the built-in benchmark."""
    file = BenchmarkFile(objects=[_entry(o) for o in load_objects()])
    data = file.model_dump(exclude_none=True)
    return ABOUT + yaml.dump(
        data, Dumper=_Plain, sort_keys=False, default_flow_style=None, width=118
    )


def _entry(model: ObjectModel) -> ObjectEntry:
    thing = THINGS[model.name]
    words = {
        "names": list(thing.names),
        "parts": {k: list(v) for k, v in thing.parts.items()},
        "verbs": dict(thing.verbs),
        "part_words": {k: list(v) for k, v in thing.part_words.items()},
    }
    own = {k: getattr(model, k) for k in ("split", "instruction", "mass")}
    roles = S0_ROLES.get(model.name)
    return ObjectEntry.model_validate(
        {
            "built_in": model.name,
            **own,
            "part_names": list(model.part_names),
            "roles": roles,
            "words": words,
        }
    )
