"""The command `benchmark` (a benchmark file's schema, the built-in one as a file, a check, held-out trials)."""

import sys
from pathlib import Path

from r2h_batch.base.command_line import failed, refuse
from r2h_batch.base.io.log import LOG
from r2h_batch.base.registry import DEFAULT_PROTOCOL


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


def hide(
    benchmark: str = DEFAULT_PROTOCOL, /, *, out: Path, trials: int = 500, overwrite: bool = False
) -> int:
    """Commit to held-out trials of a benchmark: nobody knows them, and you cannot choose them later.

    The command draws a seed and writes two files. OUT is the benchmark with that seed: keep it to yourself until you tell
    the trials. OUT's name with .commitment.json holds a hash of it: publish this file first. Afterwards everybody sweeps
    with `--benchmark OUT`, and `r2h-batch leaderboard --hidden` checks that OUT is what the commitment promised.

    Args:
        benchmark: a name of r2h-batch ls benchmarks, or a benchmark.yaml.
        out: the file to write, NAME.yaml; beside the benchmark.yaml if that is what you give.
        trials: of each split, from the first one on.
        overwrite: replace files of these names.
    """
    import secrets

    from r2h_batch.base.command_line import check_range
    from r2h_batch.base.errors import FileError
    from r2h_batch.base.io.read import MAX_YAML_BYTES, read_file
    from r2h_batch.base.io.write import check_output_file, write_text
    from r2h_batch.protocols.benchmark import MOST_TRIALS
    from r2h_batch.protocols.hidden import commitment_of
    from r2h_batch.protocols.load import load_benchmark
    from r2h_batch.protocols.registry import BENCHMARK

    check_range("--trials", trials, 1, MOST_TRIALS)
    if out.suffix not in (".yaml", ".yml"):
        raise FileError(f"--out {out}: the benchmark is a .yaml file")
    promise = out.with_suffix(".commitment.json")
    for path in (out, promise):
        check_output_file(path, overwrite=overwrite)
    base, file = load_benchmark(benchmark), Path(benchmark)
    if benchmark in BENCHMARK:
        text = f"protocol: {benchmark}\n"
    elif ":" in benchmark or file.suffix not in (".yaml", ".yml"):
        raise FileError(f"{benchmark}: give a name of r2h-batch ls benchmarks, or a benchmark.yaml")
    elif out.absolute().parent != file.absolute().parent:
        raise FileError(
            f"--out {out}: write it into {file.absolute().parent}, where the files that {file.name} names are"
        )
    else:
        text = read_file(file, MAX_YAML_BYTES).decode()
    if base.seed:
        raise FileError(f"{benchmark}: has a seed; give the benchmark without it")
    own = base.with_seed(secrets.token_hex(16))
    said = commitment_of(own, trials)
    write_text(out, f'{text.rstrip()}\nseed: "{own.seed}"\n')
    if load_benchmark(out).digest != own.digest:
        out.unlink()
        raise FileError(
            f"{benchmark}: its file does not say all that it is; write it as a benchmark.yaml"
        )
    out.chmod(0o600)
    write_text(promise, said.model_dump_json(indent=1) + "\n")
    print(f"{promise}: publish it now; sha256 {said.sha256}")
    print(f"{out}: keep it secret until the trials are told ({trials} of each split)")
    return 0


COMMANDS = {"show": show, "check": check, "hide": hide}
