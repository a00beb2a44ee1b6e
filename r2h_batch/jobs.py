"""What a process needs to score a part of a sweep: the bench (evaluator, plan, header) and the jobs (who answers)."""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from r2h_batch import provenance
from r2h_batch.options import METHODS, Options, UsageError
from r2h_batch.predictions import align, load_predictions
from r2h_batch.rows import TrialNames
from r2h_batch.types import Predictions, Trials

if TYPE_CHECKING:
    from r2h_batch.config import EvalConfig
    from r2h_batch.evaluate import Evaluator

DIGEST_TRIALS = 10_000
"""Trials of each split that the digest of the trial list covers: the generator counts, so these stand for all."""


@dataclass(frozen=True, eq=False)
class Bench:
    """The evaluator, the plan as positions 0..N-1 (split by split), and run.json's header.

    `ids(first, last)`: trial ids of a range of positions. `trials(ids)`: those trials. Nothing grows with N.
    """

    evaluator: "Evaluator"
    header: dict[str, Any]
    ids: Callable[[int, int], torch.Tensor]
    trials: Callable[[torch.Tensor], Trials]

    @property
    def planned(self) -> int:
        return int(sum(self.header["trials"].values()))

    @property
    def names(self) -> TrialNames:
        scene = self.evaluator.scene
        return TrialNames(
            objects=[o.name for o in scene.objects],
            object_splits=[o.split for o in scene.objects],
            hand_sides=[("right", "left")[s] for s in scene.hands.set.side.tolist()],
            parts=scene.part_names,
        )


@dataclass(frozen=True, eq=False)
class Job:
    """One method to score: its name in the table, where its answers come from, and how to get them for a chunk.

    `rows` (N,) is the row that answers each planned position, -1 for none; None: `predict` answers every trial. `warm`:
    ask for a few trials before the clock starts; not for a user's method, which may keep count of its calls.
    """

    name: str
    source: dict[str, str]
    predict: Callable[[Trials, torch.Tensor | None], Predictions]
    rows: torch.Tensor | None = None
    warm: bool = False


def prepare(options: Options) -> Bench:
    """The bench that the options describe."""
    import platform

    from r2h_batch.evaluate import Evaluator
    from r2h_batch.objects import load_objects, object_digest, object_from_argument
    from r2h_batch.trials import PROTOCOL, SPLITS, make_trials, trials_digest, trials_with_ids

    if options.device != "cpu" and not torch.cuda.is_available():
        raise UsageError(f"--device {options.device}: torch sees no CUDA device; use --device cpu")
    config = _configuration(options)
    built_in = load_objects()
    pieces = options.object_collision == "pieces"  # a convex decomposition takes up to a minute: only where it is used
    objects = (*built_in, *(object_from_argument(mesh, pieces=pieces) for mesh in options.object_mesh))
    splits = [s for s in SPLITS if s in options.splits]
    first_trials = make_trials(splits, min(options.trials, DIGEST_TRIALS), objects=objects)
    evaluator = Evaluator(config, device=options.device, objects=objects, threads=options.threads)
    header = {
        "protocol": PROTOCOL,
        "trials": dict.fromkeys(splits, options.trials),
        "configuration": asdict(config),
        "digests": {
            "trials": trials_digest(first_trials, objects=objects),
            "objects": object_digest(objects),
            "hand_set": evaluator.scene.hands.set.digest,
            "code": provenance.code_digest(),
        },
        "motion": {
            "engine": config.execute.sim,
            "model": config.execute.model if config.execute.sim != "none" else None,
            "step_s": config.execute.step_s if config.execute.sim != "none" else None,
            "sample_s": config.execute.step_s * config.execute.record_steps if config.execute.sim != "none" else None,
        },
        "objects": [{"name": o.name, "split": o.split, "built_in": i < len(built_in)} for i, o in enumerate(objects)],
        "seed": options.seed,
        "predictors": _predictors(options),
        "stored": options.stored,
        "device": {"kind": options.device.partition(":")[0], "name": provenance.device_name(options.device)},
        "versions": provenance.versions(),
        "platform": platform.platform(),
        "git_commit": provenance.git_commit(),
        "command": ["python", "-m", "r2h_batch.sweep", *sys.argv[1:]],
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }

    def ids(first: int, last: int) -> torch.Tensor:
        split, turn = torch.arange(first, last).div(options.trials, rounding_mode="floor"), torch.arange(first, last)
        place = torch.tensor([SPLITS.index(s) for s in splits])
        return 2 * (turn - split * options.trials) + place[split]

    return Bench(evaluator, header, ids, partial(trials_with_ids, objects=objects))


def _configuration(options: Options) -> "EvalConfig":
    """The preset with what the options change."""
    from r2h_batch.config import EvalConfig

    config = EvalConfig.preset(options.preset)
    edge_check = config.plan.edge_check if options.edge_check == "preset" else options.edge_check
    plan = replace(config.plan, object_collision=options.object_collision, edge_check=edge_check)
    execute = replace(config.execute, sim=options.sim, model=options.sim_model)
    execute = replace(execute, sim=execute.engine(options.device))
    return replace(config, plan=plan, execute=execute, width=options.width, stability=options.stability)


def _predictors(options: Options) -> dict[str, Any]:
    """What the methods see: the error model, and which contact network."""
    from r2h_batch.predictors import PredictorNoise

    file = Path(options.predictor)
    own = {"file": options.predictor} | ({"sha256": provenance.file_digest([file])} if file.is_file() else {})
    return {
        "noise_factor": options.predictor_noise,
        "noise": asdict(PredictorNoise().scaled(options.predictor_noise)),
        "contact": own if options.predictor else {"built_in": "VoxNet"},
    }


Files = list[tuple[str, str, Predictions]]


def load_files(options: Options) -> Files:
    """(path, sha256, predictions) of every file: refused before anything slow starts."""
    loaded = [(path, load_predictions(path)) for path in options.predictions]
    return [(path, provenance.file_digest([Path(path)]), predictions) for path, predictions in loaded]


def make_jobs(options: Options, files: Files, bench: Bench) -> list[Job]:
    """Every method and file as a job, aligned with the plan; names must differ."""
    jobs = [_method_job(name, bench.evaluator, options) for name in options.method]
    for path, digest, predictions in files:
        planned = bench.ids(0, bench.planned)
        rows = align(predictions, planned, source=path, allow_missing=options.allow_missing)
        source = {"kind": "predictions", "file": path, "sha256": digest}
        jobs.append(Job(predictions.method, source, partial(_stored, predictions), rows))
    names = [job.name for job in jobs]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise UsageError(f"two methods are called {twice[0]!r}; give each predictions file its own method name")
    return jobs


def _stored(predictions: Predictions, _: Trials, rows: torch.Tensor | None) -> Predictions:
    return predictions if rows is None else predictions[rows]


def _method_job(name: str, evaluator: "Evaluator", options: Options) -> Job:
    import inspect

    built_in = name in METHODS
    module_name, function_name = (
        (f"r2h_batch.methods.{name.replace('-', '_')}", "predict") if built_in else name.rsplit(":", 1)
    )
    try:
        module = import_module(module_name)
        function = getattr(module, function_name)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"--method {name}: {error}; it must be package.module:function") from error
    takes = inspect.signature(function).parameters
    extra: dict[str, Any] = {"evaluator": evaluator} if "evaluator" in takes else {}
    source = {"kind": "method", "function": f"{module_name}:{function_name}"}
    source["sha256"] = provenance.file_digest([Path(module.__file__)]) if module.__file__ else ""
    title = name
    if "noise" in takes:
        from r2h_batch.predictors import PredictorNoise, load_predictor

        extra["noise"] = PredictorNoise().scaled(options.predictor_noise)
        own = options.predictor if built_in and "predictor" in takes else ""
        if own:
            extra["predictor"] = load_predictor(own)
        if built_in:
            title = table_name(module.TITLE, Path(own).name or module.STAND_IN, options.predictor_noise)
        source["predictors"] = json.dumps(_predictors(options), sort_keys=True)

    def predict(trials: Trials, _: object) -> Predictions:
        return _as_predictions(title, trials, lambda: function(trials, evaluator.scene, seed=options.seed, **extra))

    return Job(title, source, predict, warm=built_in)


def table_name(title: str, stand_in: str, noise: float) -> str:
    """A method's name in tables: what stood in for the original network, and the error model it was given."""
    added = "" if noise == 0 else " + noise" if noise == 1 else f" + {noise:g} x noise"
    return f"{title} ({stand_in}{added})"


def _as_predictions(name: str, trials: Trials, call: Callable[[], Any]) -> Predictions:
    """The answer of a method as `Predictions`, with its amortised wall time where it gives none of its own."""
    start = time.perf_counter()
    answer = call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    seconds = (time.perf_counter() - start) / max(len(trials), 1)
    keys: Sequence[str] = ("T_obj_ee", "T_world_ee", "t_method_s")
    parts: list[Any] = [*answer, None][:3] if isinstance(answer, tuple) else [getattr(answer, k, None) for k in keys]
    own = parts[2]
    shape = (len(trials), 4, 4)
    for key, value in zip(keys[:2], parts):
        if not isinstance(value, torch.Tensor) or tuple(value.shape) != shape:
            found = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            raise TypeError(f"method {name}: {key} is {found}; it must be a tensor {shape}")
    t_method_s = torch.full((len(trials),), seconds) if own is None else own
    return Predictions(trials.trial_id, parts[0], parts[1], t_method_s, name)
