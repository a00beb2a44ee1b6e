"""The command `benchmark` (a benchmark file's schema, the built-in one as a file, a check)."""

import sys
from pathlib import Path

from r2h_batch.base.command_line import failed, refuse
from r2h_batch.base.io.log import LOG


def show(*, builtin: bool = False) -> int:
    """Print the schema of a benchmark file (JSON Schema).

    Args:
        builtin: print the default benchmark as a file (YAML) that you can edit.
    """
    import json

    from r2h_batch.protocols.file_fields import BenchmarkFile

    if builtin:
        from r2h_batch.protocols.file_fields import text_of
        from r2h_batch.protocols.load import load_benchmark

        found = load_benchmark()
        sys.stdout.write(text_of(found.name, found.objects, found.receiver))
    else:
        print(json.dumps(BenchmarkFile.model_json_schema(), indent=1))
    return 0


def check(file: Path, /) -> int:
    """Read a benchmark file and all files that it names, and say what it holds.

    Args:
        file: a benchmark.yaml.
    """
    import warnings

    from r2h_batch.protocols.load import load_benchmark
    from r2h_batch.protocols.yaml_file import read_benchmark

    try:
        if file.is_dir():
            inside = file / "benchmark.yaml"
            how = (
                f"give {inside}"
                if inside.is_file()
                else "give a benchmark.yaml; meshes alone: sweep --objects FOLDER"
            )
            return refuse("benchmark", f"{file}: is a folder; {how}")
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", UserWarning)
            found = read_benchmark(file)
        for w in told:  # what was done to a mesh
            if w.category is UserWarning:
                LOG.info(f"benchmark: {w.message}")
        own = found.digest
        same = own == load_benchmark().digest
    except ValueError as error:
        return refuse("benchmark", error)
    except OSError as error:
        return failed("benchmark", error, file)
    sides = found.hand_set.side.tolist()
    print(
        f"{file}: protocol {found.protocol}, digest {own}{' (the default benchmark)' if same else ''}"
    )
    for split in ("S0", "S1"):
        print(
            f"{split}: {', '.join(o.name for o in found.objects if o.split == split) or 'no object'}"
        )
    print(
        f"hands: {sides.count(0)} right, {sides.count(1)} left, {len(found.hand_set.model.vertices)} vertices"
    )
    grasps = [f"{o.name} {len(o.grasps)}" for o in found.objects if o.grasps is not None]
    print(f"grasps of its own: {', '.join(grasps) or 'none'}")
    return 0


COMMANDS = {"show": show, "check": check}
