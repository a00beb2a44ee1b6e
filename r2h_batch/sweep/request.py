"""A sweep: the options of a command line, and what they mean (`requested`). One value goes through all of the room."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.base.user_code import load_function
from r2h_batch.config import EstimateConfig, EvalConfig, ExecutionError, ObjectErrors
from r2h_batch.runs import provenance
from r2h_batch.sweep.options import KINDS, SEEN_BY, Options, configuration, spelled_out
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.verdicts import SPLITS

if TYPE_CHECKING:
    from r2h_batch.closed_loop.episodes import Loop
    from r2h_batch.data.release import Imported
    from r2h_batch.observe.sees import Sees
    from r2h_batch.trials.benchmark import Benchmark
    from r2h_batch.trials.noise import Errors, PredictorNoise


@dataclass(frozen=True)
class Sweep(Options):
    """A sweep: its options, and what they mean once files and presets are read.

    Attributes:
        configuration: how it is judged.
        seeing: what methods are shown instead of trials and scene; None: they are told the truth.
        loop: how the handovers are also played in closed loop.
        left_out: why executed motions of a file are not judged, by the ids of their trials.
        stored: tables beside the trials.
        errors: the error model of the target hand as methods see it, whatever the planner sees.
    """

    configuration: EvalConfig = field(default_factory=EvalConfig)
    seeing: "Sees | None" = None
    loop: "Loop | None" = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    stored: tuple[str, ...] = ("poses",)
    errors: "Errors" = "normal"

    @property
    def names(self) -> tuple[str, ...]:
        """The methods; those of installed packages spelled out."""
        return tuple(map(spelled_out, self.method))

    @property
    def seen(self) -> dict[str, str]:
        """Key of `SEEN_BY` -> file of a network's answers."""
        return {name: file for name in SEEN_BY if (file := getattr(self, name))}

    @property
    def choice(self) -> BenchmarkChoice:
        """The benchmark's own flags."""
        return BenchmarkChoice(**{f.name: getattr(self, f.name) for f in fields(BenchmarkChoice)})

    @property
    def noise(self) -> "PredictorNoise":
        """The error model of what the methods see."""
        from r2h_batch.trials.noise import PredictorNoise

        return PredictorNoise(target_errors=self.errors).scaled(self.predictor_noise)

    def read(self, *, pieces: bool) -> "Benchmark":
        """The benchmark; `pieces` as `load_benchmark` takes it.

        Raises:
            ValueError: one line; a `UsageError` where a split has no object.
        """
        from r2h_batch.trials.edit import added_calls, edited, said_splits
        from r2h_batch.trials.load import load_benchmark

        if splits := said_splits(self.choice):  # before any mesh is built
            self._check_splits(splits)
        calls = added_calls(self.choice)
        if calls and not (self.objects or self.trials_file):
            base = load_benchmark(self.benchmark or DEFAULT_BENCHMARK, pieces=pieces)
            if base.listed is None:
                added = [(printable(Path(c["mesh"]).stem), c["split"]) for c in calls]
                self._check_shares([*_named(base), *added], dict.fromkeys(self.splits, self.trials))
        return edited(self.choice, pieces=pieces)

    def plan(self, benchmark: "Benchmark") -> dict[str, int]:
        """Split -> trials of it."""
        splits: list[str] = [s for s in SPLITS if s in self.splits]
        if benchmark.listed is None:
            self._check_splits({o.split for o in benchmark.objects})
            plan = dict.fromkeys(splits, self.trials)
            self._check_shares(_named(benchmark), plan)
            return plan
        if self.trials != Options.trials:
            words = "a trials file has its own number, so leave --trials out"
            raise UsageError(f"--trials sets how many trials the benchmark draws; {words}")
        listed = benchmark.listed.trial_id % 2
        counts = {s: int((listed == SPLITS.index(s)).sum()) for s in splits}
        if not any(counts.values()):
            raise UsageError(f"the trials file has none of --splits {' '.join(splits)}")
        return {s: n for s, n in counts.items() if n}

    def shares(self, benchmark: "Benchmark", plan: Mapping[str, int]) -> str:
        """One line that says how many trials each object of --object-mesh gets, for the objects of a split
        take turns; empty without such objects, or with listed trials.

        Args:
            benchmark: as `read` gives it.
            plan: as `plan` gives it.
        """
        if not self.object_mesh or benchmark.listed is not None:
            return ""
        return self._shares(_named(benchmark), plan)

    def _shares(self, objects: Sequence[tuple[str, str]], plan: Mapping[str, int]) -> str:
        """`shares` of the names and splits of all objects."""
        words = [
            f"{printable(name)} gets {own or 'none'} of {n} trials of {split} ({of_split} objects)"
            for name, (own, n, split, of_split) in self._of_added(objects, plan).items()
        ]
        how = "--objects FOLDER judges your meshes alone"
        return f"--object-mesh adds to the benchmark's objects: {', '.join(words)}; {how}"

    def _check_shares(self, objects: Sequence[tuple[str, str]], plan: Mapping[str, int]) -> None:
        """`UsageError` where an object of --object-mesh gets no trial; these are the last of the objects."""
        none = [name for name, (own, *_) in self._of_added(objects, plan).items() if not own]
        if none:
            words = f"a larger --trials reaches {printable(none[0])}"
            raise UsageError(f"{self._shares(objects, plan)}, and {words}")

    def _of_added(
        self, objects: Sequence[tuple[str, str]], plan: Mapping[str, int]
    ) -> dict[str, tuple[int, int, str, int]]:
        """Object of --object-mesh -> its trials, those of its split, the split, and how many objects that has."""
        found, before = {}, len(objects) - len(self.object_mesh)
        for place, (name, split) in enumerate(objects[before:], before):
            of_split = [i for i, (_, other) in enumerate(objects) if other == split]
            rounds, rest = divmod(plan.get(split, 0), len(of_split))
            own = rounds + (of_split.index(place) < rest)
            found[name] = (own, plan.get(split, 0), split, len(of_split))
        return found

    def _check_splits(self, known: set[str]) -> None:
        if missing := [s for s in SPLITS if s in self.splits and s not in known]:
            how = f"give at least one, or --splits {' '.join(sorted(known))}"
            raise UsageError(f"no object belongs to split {missing[0]}; {how}")

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
            "noise_factor": self.predictor_noise,
            "noise": asdict(self.noise),
            "contact": contact,
            **networks,
        }


def requested(options: Options) -> Sweep:
    """The sweep that the options ask for. Trials of `--trials-from` are imported into the run folder.

    Raises:
        ValueError: one line about an option that cannot be.
    """
    loop = _loop(options)
    options, released = _with_trials(options)
    config = configuration(options)
    return Sweep(
        **vars(options),
        configuration=_configuration(
            options, config, pieces=released is not None and released.boxes
        ),
        seeing=_sees(options),
        loop=loop,
        left_out=released.left_out if released is not None and not options.replan else {},
        stored=tuple(_stored(options)),
        errors=config.estimate.errors,
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


def _named(benchmark: "Benchmark") -> list[tuple[str, str]]:
    """Name and split of each object."""
    return [(o.name, o.split) for o in benchmark.objects]


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
