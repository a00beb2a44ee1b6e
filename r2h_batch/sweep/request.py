"""The request for a sweep: `requested` turns the options of a command line into the benchmark, the
configuration, the methods, the work and the storage. Nothing behind it sees the options."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import load_function
from r2h_batch.config import EstimateConfig, EvalConfig, ExecutionError, ObjectErrors
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.runs import provenance
from r2h_batch.sweep.options import KINDS, SEEN_BY, Options, spelled_out
from r2h_batch.sweep.settings import configured
from r2h_batch.verdicts import SPLITS

if TYPE_CHECKING:
    from r2h_batch.base.loggers import LoggerName
    from r2h_batch.closed_loop.episodes import Loop
    from r2h_batch.data.release import Imported
    from r2h_batch.observe.sees import Sees
    from r2h_batch.protocols.benchmark import Benchmark
    from r2h_batch.trials.noise import Errors, PredictorNoise


@dataclass(frozen=True)
class TrialPlan:
    """Which trials are planned: the benchmark by its flags, splits, and how many of each."""

    benchmark: BenchmarkChoice
    splits: tuple[str, ...]  # in the order of `SPLITS`
    count: int | None  # None: not said

    def read(self, *, pieces: bool) -> "Benchmark":
        """The benchmark; `pieces` as `load_benchmark` takes it.

        Raises:
            ValueError: one line; a `UsageError` where a split has no object.
        """
        from r2h_batch.protocols.edit import edited, said_splits

        if splits := said_splits(self.benchmark):  # before any mesh is built
            self._check_splits(splits)
        return edited(self.benchmark, pieces=pieces)

    def plan(self, benchmark: "Benchmark") -> dict[str, int]:
        """Split -> trials of it."""
        if benchmark.listed is None:
            self._check_splits({o.split for o in benchmark.objects})
            return dict.fromkeys(self.splits, self.count or Options.trials)
        if self.count is not None:
            words = "a trials file has its own number, so leave --trials out"
            raise UsageError(f"--trials sets how many trials the protocol draws; {words}")
        listed = benchmark.listed.trial_id % 2
        counts = {s: int((listed == SPLITS.index(s)).sum()) for s in self.splits}
        if not any(counts.values()):
            raise UsageError(f"the trials file has none of --splits {' '.join(self.splits)}")
        return {s: n for s, n in counts.items() if n}

    def shares(self, benchmark: "Benchmark", plan: Mapping[str, int]) -> str:
        """One line that says how many trials each object of --object-mesh gets, for the objects of a split
        take turns; empty without such objects, or with listed trials.

        Args:
            benchmark: as `read` gives it.
            plan: as `plan` gives it.
        """
        if not self.benchmark.object_mesh or benchmark.listed is not None:
            return ""
        added, words = benchmark.objects[-len(self.benchmark.object_mesh) :], []
        for model in added:
            of_split = [o for o in benchmark.objects if o.split == model.split]
            rounds, rest = divmod(plan.get(model.split, 0), len(of_split))
            turn = next(i for i, o in enumerate(of_split) if o is model)
            own = rounds + (turn < rest)
            words.append(
                f"{printable(model.name)} gets {own or 'none'} of {plan.get(model.split, 0)} trials of {model.split}"
                f" ({len(of_split)} objects)"
            )
        how = "--objects FOLDER judges your meshes alone"
        return f"--object-mesh adds to the benchmark's objects: {', '.join(words)}; {how}"

    def _check_splits(self, known: set[str]) -> None:
        if missing := [s for s in self.splits if s not in known]:
            how = f"give at least one, or --splits {' '.join(sorted(known))}"
            raise UsageError(f"no object belongs to split {missing[0]}; {how}")


@dataclass(frozen=True)
class Methods:
    """Who answers, and what they see.

    Attributes:
        names: methods as `--method` names them.
        predictions: files of poses.
        motions: files of joint motions.
        seed: of the methods.
        noise_factor: on the error model of what they see.
        errors: the error model of the target hand.
        predictor: the contact network of the method contact; empty: the built-in one.
        seen: key of `SEEN_BY` -> file of a network's answers.
        allow_empty_candidates: count trials of objects without grasps as failures.
        allow_missing: count trials that a file leaves out as failures.
        sees: what methods are shown instead of trials and scene; None: they are told the truth.
    """

    names: tuple[str, ...] = ()
    predictions: tuple[str, ...] = ()
    motions: tuple[str, ...] = ()
    seed: int = 0
    noise_factor: float = 1.0
    errors: "Errors" = "normal"
    predictor: str = ""
    seen: Mapping[str, str] = field(default_factory=dict)
    allow_empty_candidates: bool = False
    allow_missing: bool = False
    sees: "Sees | None" = None

    @property
    def noise(self) -> "PredictorNoise":
        """The error model of what the methods see."""
        from r2h_batch.trials.noise import PredictorNoise

        return PredictorNoise(target_errors=self.errors).scaled(self.noise_factor)

    def about_predictors(self) -> dict[str, Any]:
        """The entry of run.json about what the methods see: the error model, which contact network (its file,
        or the files of its Python module), and the files of networks' answers."""
        contact: dict[str, Any] = {"built_in": "VoxNet"}
        if spec := self.predictor:
            is_file = Path(spec).is_file()
            files = [Path(spec)] if is_file else load_function(spec).files().values()
            contact = {"file": spec, "sha256": provenance.file_digest(files)}
        networks = {
            name: {"file": file, "sha256": provenance.file_digest([Path(file)])}
            for name, file in self.seen.items()
        }
        return {
            "noise_factor": self.noise_factor,
            "noise": asdict(self.noise),
            "contact": contact,
            **networks,
        }


@dataclass(frozen=True)
class Cluster:
    """The Ray cluster that scores.

    Attributes:
        address: to join; empty: one on this machine.
        timeout_s: after which a cluster that does not answer counts as lost.
        workers: actors; 0: one for each GPU, or for each 4 CPUs.
        gpus_per_worker: of each actor; 0: one with device cuda.
    """

    address: str
    timeout_s: float
    workers: int
    gpus_per_worker: float


@dataclass(frozen=True)
class Work:
    """How it is scored.

    Attributes:
        device: cpu, cuda or cuda:N.
        threads: CPU threads; None: all cores.
        chunk: trials scored at once; 0: what suits the device.
        part: (I, N): part I of N.
        cluster: None: this process scores.
    """

    device: str
    threads: int | None
    chunk: int
    part: tuple[int, int]
    cluster: Cluster | None


@dataclass(frozen=True)
class Storage:
    """The run folder, its tables, and the printed one.

    Attributes:
        folder: the run folder.
        kinds: tables beside the trials.
        shard_trials: trials of a shard; 0: a minute of work.
        format: of the printed table.
        log: logger that gets the table's numbers; None: none does.
    """

    folder: Path
    kinds: list[str]
    shard_trials: int
    format: str
    log: "LoggerName | None"


@dataclass(frozen=True)
class Request:
    """A sweep: `loop` says how the handovers are also played in closed loop; `left_out` why executed
    motions of a file are not judged, by the ids of their trials."""

    trials: TrialPlan
    configuration: EvalConfig
    methods: Methods
    work: Work
    storage: Storage
    loop: "Loop | None" = None
    left_out: Mapping[str, str] = field(default_factory=dict)


def requested(options: Options) -> Request:
    """The request that the options make. Trials of `--trials-from` are imported into the run folder.

    Raises:
        ValueError: one line about an option that cannot be.
    """
    loop = _loop(options)
    options, released = _with_trials(options)
    config = configured(EvalConfig.preset(options.preset), options.settings)
    flags = {f.name: getattr(options, f.name) for f in fields(BenchmarkChoice)}
    splits = tuple(s for s in SPLITS if s in options.splits)
    count = None if options.trials == Options.trials else options.trials
    cluster = None
    if options.engine == "ray":
        cluster = Cluster(
            options.address, options.ray_timeout, options.workers, options.gpus_per_worker
        )
    methods = Methods(
        names=tuple(map(spelled_out, options.method)), predictions=options.predictions, motions=options.motions,
        seed=options.seed, noise_factor=options.predictor_noise, errors=config.estimate.errors,
        predictor=options.predictor,
        seen={name: file for name in SEEN_BY if (file := getattr(options, name))},
        allow_empty_candidates=options.allow_empty_candidates, allow_missing=options.allow_missing,
        sees=_sees(options),
    )  # fmt: skip
    return Request(
        TrialPlan(BenchmarkChoice(**flags), splits, count),
        _configuration(options, config, pieces=released is not None and released.boxes),
        methods,
        Work(options.device, options.threads, options.chunk, options.part, cluster),
        Storage(
            Path(options.out),
            _stored(options),
            options.shard_trials,
            options.format,
            options.log or None,
        ),
        loop,
        released.left_out if released is not None and not options.replan else {},
    )


def _with_trials(options: Options) -> tuple[Options, "Imported | None"]:
    """The options with --trials-from as the benchmark and the answers that it is read into, a folder
    in the run folder; and what that folder says about itself."""
    if not options.trials_from:
        return options, None
    from r2h_batch.data.release import about, imported

    own = ("benchmark", "trials_file", "objects", "object_mesh", "hands", "hand_model")
    if taken := [name for name in own if getattr(options, name)]:
        flag = taken[0].replace("_", "-")
        raise UsageError(f"--{flag} and --trials-from both say the trials; give one of the two")
    folder = imported(Path(options.trials_from), Path(options.out))
    motions = folder / "motions.npz"
    options = replace(options, benchmark=str(folder / "benchmark.yaml"))
    if options.replan or not motions.exists():
        file = str(folder / "predictions.npz")
        return replace(options, predictions=(*options.predictions, file)), about(folder)
    return replace(options, motions=(*options.motions, str(motions))), about(folder)


def _configuration(options: Options, config: EvalConfig, *, pieces: bool) -> EvalConfig:
    """The configuration of the settings with what other options decide.

    `pieces`: preset release judges the object piece by piece, as the release judges a file's boxes.
    """
    plan = config.plan
    if pieces and config.name == "release" and "plan.object_collision" not in options.settings:
        plan = replace(plan, object_collision="pieces")
    # settings that no verdict uses stay at their defaults: runs that differ in them can be compared
    seen, error, told = EstimateConfig(), ExecutionError(), ObjectErrors()
    if plan.hand == "estimated":
        seen = EstimateConfig(config.estimate.errors, options.predictor_noise, options.seed)
    if config.execution_error.any:
        error = replace(config.execution_error, seed=options.seed)
    if config.object_errors.any:
        told = replace(config.object_errors, seed=options.seed)
        if not told.gross:
            told = replace(told, gross_turn=ObjectErrors.gross_turn)
    execute = replace(config.execute, sim=config.execute.engine(options.device))
    return replace(
        config,
        plan=plan,
        execute=execute,
        estimate=seen,
        execution_error=error,
        object_errors=told,
    )


def _stored(options: Options) -> list[str]:
    """Tables beside the trials; paths bring everything that opening a trial needs."""
    played = ["episodes"] if options.receiver_motion else ["sees"] if options.sees else []
    # nobody plans motions from a file again
    if options.save_paths or options.motions or options.trials_from:
        return [*KINDS, *played]
    return [*([] if options.no_poses else ["poses"]), *played]


def _sees(options: Options) -> "Sees | None":
    """How methods see; None: they are told the truth."""
    if not options.sees:
        return None
    from r2h_batch.observe.sees import Sees

    return Sees.parse(options.sees)


def _loop(options: Options) -> "Loop | None":
    """How the handovers are played in closed loop; None: they are not."""
    if not options.receiver_motion:
        return None
    from r2h_batch.closed_loop.env import LoopConfig
    from r2h_batch.closed_loop.episodes import Loop
    from r2h_batch.closed_loop.moving import ReceiverMotion

    motion = ReceiverMotion.parse(options.receiver_motion, options.seed)
    config, horizon_s = LoopConfig(seed=options.seed), options.horizon
    if horizon_s is not None:
        try:
            config = replace(config, horizon_s=horizon_s)
        except ValueError as error:
            raise UsageError(
                f"--horizon{str(error).removeprefix('LoopConfig.horizon_s')}"
            ) from None
    return Loop(motion, options.policy, config)
