"""Score methods or predictions files on a split's trials: `python -m r2h_batch.sweep --help`. Command line only."""

import contextlib
import difflib
import io
import itertools
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # torch, Warp and pyarrow are imported when there is work: --help and typing errors answer at once
    import torch

    from r2h_batch.evaluate import Evaluator
    from r2h_batch.results import MethodWriter, RunFolder
    from r2h_batch.rows import TrialNames
    from r2h_batch.types import Predictions, Trials

METHODS = ("random", "oracle")
"""Built-in methods: modules of `r2h_batch.methods` with a `predict(trials, scene, *, seed, evaluator)`."""

CPU_CHUNK = 256
"""Trials between two progress reports on a CPU; on a GPU it is the evaluator's own chunk."""

WARM_TRIALS = 32
"""Scored once before the clock starts, so that compiling kernels is in nobody's T_plan."""


class UsageError(Exception):
    """A command line that cannot be run: one line that says what was given and what is allowed."""


@dataclass(frozen=True)
class Options:
    """Score handover methods on the benchmark's trials and print Table I."""

    method: tuple[str, ...] = ()
    """Methods to score: random, oracle, or your own package.module:function (trials, scene, *, seed) -> Predictions."""
    predictions: tuple[str, ...] = ()
    """Predictions files (.npz or .safetensors) to score."""
    splits: tuple[Literal["S0", "S1"], ...] = ("S0", "S1")
    """S0 free handover, S1 functional."""
    trials: int = 500
    """Trials of each split."""
    device: str = "cpu"
    """cpu, cuda or cuda:N."""
    out: str = ""
    """Run folder; runs/DATE-TIME unless given."""
    seed: int = 0
    """Seed of the methods; the trials do not depend on it."""
    object_mesh: tuple[str, ...] = ()
    """Your own objects, FILE[:S0|S1]: they take turns with the built-in objects of that split."""
    preset: Literal["default", "paper"] = "default"
    """default: exact planning to any branch. paper: one goal, MoveIt's edge resolution, to compare with the paper."""
    width: Literal["pads", "whole"] = "pads"
    """Stability measures the material between the pads, or the whole object's extent along the closing axis."""
    stability: Literal["geometric", "physics"] = "geometric"
    """physics: the object must also stay in a friction grasp through its weight and a shake along three axes."""
    object_collision: Literal["hull", "pieces"] = "hull"
    """The attached object in planning: its convex hull (as in the paper), or its convex decomposition."""
    edge_check: Literal["preset", "exact", "moveit"] = "preset"
    """Path edges: as the preset says, certified, or sampled at MoveIt's resolution."""
    sim: Literal["auto", "none", "mujoco", "mjwarp"] = "auto"
    """Who moves the arm: MuJoCo C, MuJoCo-Warp, nobody (the motion as planned); auto: mujoco on a CPU, mjwarp on CUDA."""
    format: Literal["md", "latex", "csv", "json"] = "md"
    """Format of the table on stdout."""
    save_paths: bool = False
    """Also store waypoints, times and joint goal of every trial."""
    threads: int | None = None
    """CPU threads; all cores unless given."""
    allow_missing: bool = False
    """Count trials that a predictions file leaves out as failures instead of refusing the file."""

    def __post_init__(self) -> None:
        if not self.method and not self.predictions:
            raise UsageError(f"nothing to score: give --method {' '.join(METHODS)} or --predictions FILE")
        for name in self.method:
            if name not in METHODS and ":" not in name:
                raise UsageError(
                    f"unknown method {name!r}{_close(name, METHODS)}; allowed are {', '.join(METHODS)}"
                    " or your own package.module:function"
                )
        for name, value in (("--trials", self.trials), ("--threads", 1 if self.threads is None else self.threads)):
            if value < 1:
                raise UsageError(f"{name} is {value}; it must be 1 or more")
        for name, given in (("--method", self.method), ("--splits", self.splits), ("--predictions", self.predictions)):
            if twice := [g for g in given if given.count(g) > 1]:
                raise UsageError(f"{name} {twice[0]} is given twice; once is enough")
        if not self.splits:
            raise UsageError("--splits names no split; allowed are S0, S1")
        if self.device not in ("cpu", "cuda") and not (
            self.device.startswith("cuda:") and self.device[5:].isascii() and self.device[5:].isdigit()
        ):
            raise UsageError(f"--device is {self.device!r}; allowed are cpu, cuda, cuda:N")


@dataclass(frozen=True, eq=False)
class Job:
    """One method to score: its name in the table, where its answers come from, and how to get them for a chunk.

    `rows` (N,) is the row that answers each trial, -1 for none; None: `predict` answers every trial. `warm`: ask for
    a few trials before the clock starts; not for a user's method, which may keep count of its calls.
    """

    name: str
    source: dict[str, str]
    predict: "Callable[[Trials, torch.Tensor | None], Predictions]"
    rows: "torch.Tensor | None" = None
    warm: bool = False


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of the command: 0 done, 1 failed on the way, 2 refused before any work, 130 interrupted."""
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
    except UsageError as error:
        return _fail(error, 2)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return run(options)
    except KeyboardInterrupt:
        return _fail("interrupted; methods that were complete are stored, the others left nothing", 130)
    except OSError as error:
        return _fail(f"{error.filename or 'writing the run folder'}: {error.strerror or error}", 1)


def parse(arguments: Sequence[str]) -> Options:
    """The checked options; raises `UsageError` with one line."""
    import tyro

    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(
                Options,
                prog="python -m r2h_batch.sweep",
                args=list(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        raise UsageError(_one_line(box.getvalue(), arguments)) from None


def _one_line(box: str, arguments: Sequence[str]) -> str:
    flags = ["--" + f.name.replace("_", "-") for f in fields(Options)]
    for argument in arguments:
        name = argument.partition("=")[0].replace("_", "-")
        if name.startswith("-") and name not in (*flags, "-h", "--help") and not name[1:].replace(".", "").isdigit():
            return f"unknown flag {name}{_close(name, flags)}; allowed are {', '.join(flags)}"
    lines = [line.strip("\u2502| \n") for line in box.splitlines()]
    worded = [any(c.isalnum() for c in line) for line in lines]
    start = worded.index(True) + 1 if any(worded) else 0  # tyro prints a title, the message, a rule or blank, hints
    message = itertools.takewhile(
        lambda i: worded[i], itertools.dropwhile(lambda i: not worded[i], range(start, len(lines)))
    )
    return " ".join(lines[i] for i in message) or "the command line was not understood; see --help"


def _close(name: str, allowed: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, allowed, n=1)
    return f", did you mean {near[0]}?" if near else ""


def _fail(error: object, code: int) -> int:
    print(f"sweep: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def run(options: Options) -> int:
    """Score every job, store its rows, print the table of the whole run folder."""
    from r2h_batch import report, results

    with contextlib.ExitStack() as stack:
        try:
            files = _load_files(options)
            evaluator, trials, header = _prepare(options)
            jobs = _jobs(options, files, evaluator, trials)
            out = options.out or time.strftime("runs/%Y%m%d-%H%M%S")
            folder = stack.enter_context(results.open_run(out, header))
            todo = [job for job in jobs if not folder.stored(job.name, job.source)]
        except (UsageError, ValueError, ImportError) as error:
            return _fail(error, 2)
        for job in jobs:
            if job in todo:
                _score(job, folder, evaluator, trials, options)
            else:
                print(f"{job.name}: already in the run folder, reused", file=sys.stderr, flush=True)
    sys.stdout.write(report.render(report.table_of(results.load_run(out)), options.format))
    sys.stdout.flush()
    print(f"run folder: {out}", file=sys.stderr)
    return 0


def _load_files(options: Options) -> "list[tuple[str, str, Predictions]]":
    """(path, sha256, predictions) of every file: refused before anything slow starts."""
    from pathlib import Path

    from r2h_batch.predictions import load_predictions
    from r2h_batch.provenance import file_digest

    loaded = [(path, load_predictions(path)) for path in options.predictions]
    return [(path, file_digest([Path(path)]), predictions) for path, predictions in loaded]


def _prepare(options: Options) -> "tuple[Evaluator, Trials, dict[str, Any]]":
    """The evaluator, the planned trials and run.json's header."""
    import dataclasses
    import platform

    import torch

    from r2h_batch import provenance
    from r2h_batch.config import EvalConfig
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.objects import load_objects, object_digest, object_from_argument
    from r2h_batch.trials import PROTOCOL, make_trials, trials_digest

    if options.device != "cpu" and not torch.cuda.is_available():
        raise UsageError(f"--device {options.device}: torch sees no CUDA device; use --device cpu")
    config = EvalConfig.preset(options.preset)
    edge_check = config.plan.edge_check if options.edge_check == "preset" else options.edge_check
    plan = dataclasses.replace(config.plan, object_collision=options.object_collision, edge_check=edge_check)
    execution = dataclasses.replace(config.execute, sim=options.sim)
    engine = execution.engine(options.device)
    execution = dataclasses.replace(execution, sim=engine)
    config = dataclasses.replace(config, plan=plan, execute=execution, width=options.width, stability=options.stability)
    built_in = load_objects()
    pieces = options.object_collision == "pieces"  # a convex decomposition takes up to a minute: only where it is used
    objects = (*built_in, *(object_from_argument(mesh, pieces=pieces) for mesh in options.object_mesh))
    splits = [s for s in ("S0", "S1") if s in options.splits]
    trials = make_trials(splits, options.trials, objects=objects)
    evaluator = Evaluator(config, device=options.device, objects=objects, threads=options.threads)
    header = {
        "protocol": PROTOCOL,
        "trials": dict.fromkeys(splits, options.trials),
        "configuration": dataclasses.asdict(config),
        "digests": {
            "trials": trials_digest(trials, objects=objects),
            "objects": object_digest(objects),
            "hand_set": evaluator.scene.hands.set.digest,
            "code": provenance.code_digest(),
        },
        "motion": {
            "engine": engine,
            "step_s": execution.step_s if engine != "none" else None,
            "sample_s": execution.step_s * execution.record_steps if engine != "none" else None,
        },
        "objects": [{"name": o.name, "split": o.split, "built_in": i < len(built_in)} for i, o in enumerate(objects)],
        "seed": options.seed,
        "save_paths": options.save_paths,
        "device": {"kind": options.device.partition(":")[0], "name": provenance.device_name(options.device)},
        "versions": provenance.versions(),
        "platform": platform.platform(),
        "git_commit": provenance.git_commit(),
        "command": ["python", "-m", "r2h_batch.sweep", *sys.argv[1:]],
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return evaluator, trials, header


def _jobs(
    options: Options, files: "list[tuple[str, str, Predictions]]", evaluator: "Evaluator", trials: "Trials"
) -> list[Job]:
    """Every method and file as a job, aligned with the trials; names must differ."""
    from r2h_batch.predictions import align

    jobs = [_method_job(name, evaluator, options.seed) for name in options.method]
    for path, digest, predictions in files:
        rows = align(predictions, trials.trial_id, source=path, allow_missing=options.allow_missing)
        source = {"kind": "predictions", "file": path, "sha256": digest}
        jobs.append(Job(predictions.method, source, partial(_stored, predictions), rows))
    names = [job.name for job in jobs]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise UsageError(f"two methods are called {twice[0]!r}; give each predictions file its own method name")
    return jobs


def _stored(predictions: "Predictions", _: "Trials", rows: "torch.Tensor | None") -> "Predictions":
    return predictions if rows is None else predictions[rows]


def _method_job(name: str, evaluator: "Evaluator", seed: int) -> Job:
    import inspect
    from importlib import import_module
    from pathlib import Path

    from r2h_batch.provenance import file_digest

    module_name, function_name = (f"r2h_batch.methods.{name}", "predict") if name in METHODS else name.rsplit(":", 1)
    try:
        module = import_module(module_name)
        function = getattr(module, function_name)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"--method {name}: {error}; it must be package.module:function") from error
    extra = {"evaluator": evaluator} if "evaluator" in inspect.signature(function).parameters else {}
    digest = file_digest([Path(module.__file__)]) if module.__file__ else ""

    def predict(trials: "Trials", _: object) -> "Predictions":
        return _as_predictions(name, trials, lambda: function(trials, evaluator.scene, seed=seed, **extra))

    source = {"kind": "method", "function": f"{module_name}:{function_name}", "sha256": digest}
    return Job(name, source, predict, warm=name in METHODS)


def _as_predictions(name: str, trials: "Trials", call: Callable[[], Any]) -> "Predictions":
    """The answer of a method as `Predictions`, with its amortised wall time where it gives none of its own."""
    import torch

    from r2h_batch.types import Predictions

    start = time.perf_counter()
    answer = call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    seconds = (time.perf_counter() - start) / max(len(trials), 1)
    keys = ("T_obj_ee", "T_world_ee", "t_method_s")
    parts: list[Any] = [*answer, None][:3] if isinstance(answer, tuple) else [getattr(answer, k, None) for k in keys]
    own = parts[2]
    shape = (len(trials), 4, 4)
    for key, value in zip(keys[:2], parts):
        if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
            found = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            raise TypeError(f"method {name}: {key} is {found}; it must be a tensor {shape}")
    t_method_s = torch.full((len(trials),), seconds) if own is None else own
    return Predictions(trials.trial_id, parts[0], parts[1], t_method_s, name)


def _score(job: Job, folder: "RunFolder", evaluator: "Evaluator", trials: "Trials", options: Options) -> None:
    """All trials of one job through the evaluator into the run folder, chunk by chunk."""
    from r2h_batch.progress import progress

    chunk = CPU_CHUNK if options.device == "cpu" else evaluator.config.chunk
    names = _names(evaluator)
    print(f"{job.name}: warming up (kernels are compiled on first use)", file=sys.stderr, flush=True)
    _warm_up(job, evaluator, trials)
    with folder.write(job.name, job.source) as writer, progress(job.name, len(trials)) as advance:
        for first in range(0, len(trials), chunk):
            rows = slice(first, min(first + chunk, len(trials)))
            _score_chunk(job, rows, writer, evaluator, trials, names, options.save_paths)
            advance(rows.stop - rows.start)


def _warm_up(job: Job, evaluator: "Evaluator", trials: "Trials") -> None:
    """Compile what the job will use; the poses do not matter, and a user's method is not asked."""
    import torch

    few = trials[:WARM_TRIALS].to(evaluator.scene.device)
    if job.warm:
        answers = job.predict(few, None)
        T_obj_ee, T_world_ee = answers.T_obj_ee, answers.T_world_ee
    else:
        T_obj_ee = torch.eye(4, device=few.T_world_hand.device).repeat(len(few), 1, 1)
        T_world_ee = few.T_world_hand.clone()
    evaluator.score(T_obj_ee, T_world_ee, few)


def _names(evaluator: "Evaluator") -> "TrialNames":
    from r2h_batch.rows import TrialNames

    scene = evaluator.scene
    return TrialNames(
        objects=[o.name for o in scene.objects],
        object_splits=[o.split for o in scene.objects],
        hand_sides=[("right", "left")[s] for s in scene.hands.set.side.tolist()],
        parts=scene.part_names,
    )


def _score_chunk(
    job: Job,
    rows: slice,
    writer: "MethodWriter",
    evaluator: "Evaluator",
    trials: "Trials",
    names: "TrialNames",
    save_paths: bool,
) -> None:
    import torch

    from r2h_batch.rows import missing_rows, path_rows, pose_rows, score_rows

    part = trials[rows]
    answered = torch.ones(len(part), dtype=torch.bool) if job.rows is None else job.rows[rows] >= 0
    if not answered.all():
        writer.append(trials=missing_rows(part[~answered], names))
        part = part[answered]
    if len(part) == 0:
        return
    part = part.to(evaluator.scene.device)
    answers = job.predict(part, None if job.rows is None else job.rows[rows][answered]).to(evaluator.scene.device)

    scores = evaluator.score(answers.T_obj_ee, answers.T_world_ee, part)
    writer.append(trials=score_rows(part, scores, names, answers.t_method_s), poses=pose_rows(answers))
    if save_paths:
        writer.append(paths=path_rows(scores))


if __name__ == "__main__":
    sys.exit(main())
