"""All that a process needs to score a part of a sweep: the setting (evaluator, plan, header) and the
jobs (who answers)."""

import inspect
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from importlib import import_module
from itertools import groupby, islice
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np
import torch

from r2h_batch.base.command_line import counted
from r2h_batch.base.errors import EndedError, FileError, UsageError
from r2h_batch.base.gone import gone
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.base.own_imports import PACKAGE
from r2h_batch.base.registry import METHOD_NAMES, METHODS, READS
from r2h_batch.base.schedule import trial_ids
from r2h_batch.base.user_code import HOW, UserFunction, load_function, raised, user_files
from r2h_batch.base.validate import describe_value
from r2h_batch.config import Workplace
from r2h_batch.report.trained import KEY as TRAINED_ON
from r2h_batch.runs import provenance
from r2h_batch.runs.plugged import package_of_method, plugin_records
from r2h_batch.runs.writing import check_files
from r2h_batch.scene.person import PIECES
from r2h_batch.strangers import Ended, stranger, words_of
from r2h_batch.sweep.answers import (
    answer_of,
    check_grasps,
    coverage_of,
    guessed_contacts,
    why_no_cuda,
)
from r2h_batch.sweep.options import SEEN_BY, base_of, options_of, own_name, text_of_options
from r2h_batch.sweep.request import Sweep
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.predictions import (
    Answers,
    Motions,
    align,
    check_benchmark,
    check_frame,
    doubts,
    load_answers,
)
from r2h_batch.trials.run_files import RunFiles, files_of
from r2h_batch.trials.trials_file import Labels
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import REGISTRY, SIDES

if TYPE_CHECKING:
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.methods.predictors import Observations
    from r2h_batch.observe.sees import Sees
    from r2h_batch.scene.objects import ObjectModel
    from r2h_batch.sweep.seeing import Looks
    from r2h_batch.trials.noise import Errors

DIGEST_TRIALS = 10_000
"""Trials of each split that the digest of the trial list covers: the generator counts, so these
stand for all."""


NAMED = 4
"""Objects of `TRAINED_ON` that tables name."""
MOST_TRAINED_ON = 10_000
"""Names and patterns of `TRAINED_ON` at most: each is compared with each judged object."""

CPU_CHUNK = 256
"""Trials scored at once on a CPU: a stop signal is heard between two chunks. On a GPU the evaluator's own
chunk."""


@dataclass(frozen=True, eq=False)
class Setting:
    """The evaluator, the planned trials as positions 0..N-1 (split by split), and run.json's header.

    `ids(first, last)`: trial ids of a range of positions. `trials(ids)`: those trials. Nothing
    grows with N.
    """

    evaluator: "Evaluator"
    header: dict[str, Any]
    ids: Callable[[int, int], torch.Tensor]
    trials: Callable[[torch.Tensor], Trials]
    sweep: Sweep = field(default_factory=Sweep)  # what was asked for
    labels: Labels | None = None  # what the owner of listed trials calls them
    files: RunFiles = field(default_factory=lambda: RunFiles({}, ()))  # of the benchmark

    @property
    def chunk(self) -> int:
        """Trials scored at once."""
        if self.sweep.chunk:
            return self.sweep.chunk
        return CPU_CHUNK if self.sweep.device == "cpu" else self.evaluator.rows_at_once()

    def own_file(self, name: str) -> str:
        """The file that this part has for itself: progress.json, or progress-3.json of part 3."""
        (part, parts), (stem, _, ending) = self.sweep.part, name.partition(".")
        return name if parts == 1 else f"{stem}-{part}.{ending}"

    @property
    def names(self) -> dict[str, int] | None:
        """Trial ids by their owner's texts."""
        return None if self.labels is None else {text: i for i, (text, _) in self.labels.items()}

    @property
    def planned(self) -> int:
        return int(sum(self.header["trials"].values()))


@dataclass(frozen=True, eq=False)
class Job:
    """One method to score: its name in the table, where its answers come from, and how to get them
    for a chunk.

    `rows` (N,) is the row that answers each planned position, -1 for none; None: `predict` answers
    every trial. `warm`: ask for a few trials before the clock starts; not for a user's method,
    which may keep count of its calls.
    """

    name: str
    source: dict[str, str]
    predict: Callable[[Trials, torch.Tensor | None], Predictions]
    rows: torch.Tensor | None = None
    motions: Motions | None = None  # of the answers' rows, where they are motions
    warm: bool = False
    lines: tuple[str, ...] = ()
    """for people: what it cannot answer, or what of it is not compared on a resume"""
    looked: Callable[[torch.Tensor], Mapping[str, torch.Tensor]] | None = None
    """what was seen of the trials (ids) of the last answers, where the method sees: the columns of `sees`"""


def set_up(sweep: Sweep) -> Setting:
    """The setting of a sweep.

    Raises:
        UsageError: there is no such device, or a split without objects.
        ValueError: one line about a file.
    """
    if sweep.device != "cpu" and not torch.cuda.is_available():
        what = f"torch sees no CUDA device ({why_no_cuda()})"
        raise UsageError(f"--device {sweep.device}: {what}; use --device cpu")
    # a convex decomposition takes up to a minute: only where it is used
    collision = sweep.configuration.plan.object_collision
    benchmark = sweep.read(pieces=collision == "pieces")
    plan = sweep.plan(benchmark)
    sees = sweep.seeing and sweep.seeing.on(benchmark)
    if sweep.loop is not None:
        from r2h_batch.closed_loop.episodes import check_in_gripper

        check_in_gripper(benchmark)
    setting = prepare(benchmark, plan, sweep, sees)
    files = files_of(sweep.choice, Path(sweep.out))
    left_out = {"left_out": list(files.left_out)} if files.left_out else {}
    setting = replace(setting, files=files)
    setting.header.update(
        benchmark={"flags": sweep.choice.flags(), **left_out},
        seed=sweep.seed,
        predictors=sweep.about_predictors(),
        stored=list(sweep.stored),
    )
    methods = [base_of(name) for name in sweep.names]
    if added := plugin_records(families=families_of(benchmark.objects), methods=methods):
        setting.header["plugins"] = added
    if sees is not None:
        setting.header["sees"] = sees.identity
        setting.header["digests"]["sees"] = sees.digest
    if sweep.left_out:
        setting.header["motions_left_out"] = dict(sweep.left_out)
    return setting


def check_home(evaluator: "Evaluator") -> None:
    """`UsageError` where the arm overlaps itself or the table at home, however far the gripper is open: no trial could pass."""
    from r2h_batch.data.robot_pairs import touching

    place, robot = evaluator.config.workplace, evaluator.scene.robot
    if place == Workplace(robot.home_q):  # looked at when the robot was made
        return
    met = [m for m in touching(robot, np.array(place.home_q), place) if not m.endswith(")")]
    if met:
        how = "no motion can begin there; change table or home in the benchmark's file"
        raise UsageError(
            f"benchmark {printable(evaluator.benchmark.name)}: {', '.join(met)} overlap at home; {how}"
        )


def families_of(objects: Iterable["ObjectModel"]) -> dict[str, str]:
    """Category of the objects -> the module of its generator, where that is the user's and no entry point names it."""
    from r2h_batch.scene.families.family import FAMILIES

    found = {}
    for category in {c for o in objects if (c := o.who.category) is not None}:
        family = None if category in FAMILIES.declared else FAMILIES.known(category)
        module = "" if family is None else family.make.__module__
        found[category] = "" if module.startswith(f"{PACKAGE}.") else module
    return found


def prepare(
    benchmark: Benchmark, plan: dict[str, int], sweep: Sweep, sees: "Sees | None" = None
) -> Setting:
    """The setting of a plan (split -> trials of it); its header lacks what it does not depend on.

    `sees`: how methods see on this benchmark.
    """
    import platform

    from r2h_batch.evaluate import Evaluator
    from r2h_batch.scene.objects import object_digest
    from r2h_batch.scene.robot_file import load_robot
    from r2h_batch.trials.benchmark import trials_digest

    config, loop = benchmark.config(sweep.configuration), sweep.loop
    count, objects = min(max(plan.values()), DIGEST_TRIALS), benchmark.objects
    first_trials = benchmark.trials(count, splits=list(plan))
    evaluator = Evaluator(
        benchmark, config, device=sweep.device, threads=sweep.threads,
        plans_in=sees if sees is not None and sees.plans else None,
    )  # fmt: skip
    check_home(evaluator)
    robot, execute = benchmark.robot, config.execute
    about_robot: dict[str, Any] = {"name": robot.name, "digest": robot.digest}
    if robot.ik_missed and robot.family != "ur":
        about_robot["ik_missed"] = list(robot.ik_missed)
    motion = {"engine": execute.sim, **dict.fromkeys(("model", "step_s", "sample_s"))}
    if execute.sim != "none":
        motion |= {"model": execute.model, "step_s": execute.step_s}
        motion["sample_s"] = execute.step_s * execute.record_steps
    sides = evaluator.scene.hands.set.side.tolist()
    header = {
        "protocol": benchmark.protocol,
        "trials": plan,
        "configuration": asdict(config),
        "digests": {
            "trials": trials_digest(first_trials),
            "benchmark": benchmark.digest,
            "objects": object_digest(objects),
            "hand_set": evaluator.scene.hands.set.digest,
            **({} if benchmark.people is None else {"people": benchmark.people.digest}),
            "code": provenance.code_digest(),
            # runs of the default robot keep the digests they had before robots could be chosen
            **({} if robot == load_robot() else {"robot": robot.digest}),
            **({} if loop is None else {"closed_loop": loop.identity}),
        },
        "code_parts": provenance.code_parts(),
        "robot": about_robot,
        "motion": motion,
        "objects": [_about_object(o) for o in objects],
        **({"asks": list(benchmark.asks)} if benchmark.asks else {}),
        **({"head_clearance_m": head_m} if (head_m := benchmark.head_clearance_m) else {}),
        **({"person": list(PIECES)} if benchmark.has_bodies else {}),
        "hands": [[SIDES[s], len(list(group))] for s, group in groupby(sides)],
        "device": {
            "kind": sweep.device.partition(":")[0],
            "name": provenance.device_name(sweep.device),
        },
        "versions": provenance.versions(),
        "platform": platform.platform(),
        "git_commit": provenance.git_commit(),
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }

    def ids(first: int, last: int) -> torch.Tensor:
        return torch.from_numpy(trial_ids(plan, first, last))

    return Setting(evaluator, header, ids, benchmark.trials_with_ids, sweep, benchmark.labels)


def _about_object(model: "ObjectModel") -> dict[str, Any]:
    """The entry of run.json about an object: a repaired mesh with what was done, and what came of it."""
    from r2h_batch.scene.objects import object_digest

    fields: dict[str, Any] = {
        "name": model.name,
        "split": model.split,
        "built_in": model.who.key is not None,
        "digest": object_digest(model),
    }
    if (category := model.who.category) is not None:
        fields["category"] = category
    if any(entry.applies for entry in REGISTRY):
        fields["concerned"] = [e.name for e in REGISTRY if e.concerns(model)]
    return fields if model.repair is None else {**fields, "repair": asdict(model.repair)}


LOOKED_AT = 64
"""Rows of a file whose declared frame is compared with where the hands are."""

Files = list[tuple[str, str, Answers]]


def load_files(sweep: Sweep) -> Files:
    """(path, sha256, answers) of every file: refused before anything slow starts."""
    loaded = [(path, load_answers(path)) for path in (*sweep.predictions, *sweep.motions)]
    for path, answers in loaded:
        if (answers.motions is not None) != (path in sweep.motions):
            flags = ("--predictions", "--motions")
            flag, other = flags if path in sweep.predictions else flags[::-1]
            words = f"{path}: {flag} needs {flag[2:]}, the file holds {other[2:]}; say {other}"
            raise FileError(words)
        for words in doubts(answers.predictions, answers.motions):
            LOG.info(f"{path}: {words}")
    return [(path, provenance.file_digest([Path(path)]), answers) for path, answers in loaded]


def make_jobs(setting: Setting, files: Files) -> list[Job]:
    """Every method and file as a job, aligned with the plan; names must differ."""
    sweep = setting.sweep
    _check_postures(sweep.names, setting.evaluator)
    seen = _seen(sweep.seen, setting)
    if any(base_of(name) in METHOD_NAMES for name in sweep.names):
        check_grasps(setting.evaluator.scene, sweep.allow_empty_candidates)
    looks = None
    if sweep.seeing is not None:
        from r2h_batch.sweep.seeing import KEPT_TRIALS, Looks

        kept = KEPT_TRIALS if len(sweep.names) > 1 else 0
        looks = Looks(sweep.seeing, setting.evaluator, kept)
    jobs = [_method_job(name, setting.evaluator, sweep, seen, looks) for name in sweep.names]
    for path, digest, answers in files:
        planned, answers = setting.ids(0, setting.planned), answers.named(setting.names, path)
        robot = setting.evaluator.scene.robot
        answers = answers.ordered(robot.joints, robot.home_q, path)
        predictions, motions = answers.predictions, answers.motions
        if motions is not None and motions.q.shape[1] != len(robot.joints) and len(motions.q):
            words = f"motions of {motions.q.shape[1]} joints; {robot.name} has {len(robot.joints)}"
            raise FileError(f"{path}: {words}; name their robot with --robot")
        check_benchmark(answers, setting.evaluator.benchmark.label, path)
        if not answers.benchmark:
            ours = setting.evaluator.benchmark.name
            LOG.info(f"{path}: does not say its benchmark; it is judged on {ours}")
        rows = align(predictions, planned, source=path, allow_missing=sweep.allow_missing)
        if answers.frame and motions is None:
            some = torch.nonzero(rows >= 0)[:LOOKED_AT, 0]
            if told := check_frame(answers, rows[some], setting.trials(planned[some]), path):
                LOG.info(told)
        kind = "predictions" if motions is None else "motions"
        source = {"kind": kind, "file": path, "sha256": digest}
        source |= {"reads": answers.reads} if answers.reads else {}
        jobs.append(Job(predictions.method, source, partial(_rows_of, answers), rows, motions))
    names = [job.name for job in jobs]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        how = "give each predictions file its own method name"
        raise UsageError(f"two methods are called {twice[0]!r}; {how}")
    return jobs


def _rows_of(answers: Answers, trials: Trials, rows: torch.Tensor | None) -> Predictions:
    if rows is None:
        return answers.predictions
    return answers.in_world(answers.predictions[rows], trials)


def _check_postures(names: Sequence[str], evaluator: "Evaluator") -> None:
    """Raises `UsageError` where hands without postures meet who needs them."""
    if getattr(evaluator.scene.hands.set, "skin", None) is None:
        return
    needing = [m for m in names if base_of(m) in SEEN_BY["predicted_hands"]]
    if evaluator.config.plan.hand == "estimated":
        needing.append("--plan.hand estimated")
    if needing:
        what = "needs the hands' postures, and these trials have meshes of hands"
        raise UsageError(f"{needing[0]} {what}; take another method, or --plan.hand true")


def _seen(files: Mapping[str, str], setting: Setting) -> "Observations | None":
    """Observations of the user's networks, checked against the plan; None where no file is given.

    `files`: as `Methods.seen`.
    """
    if not files:
        return None
    from r2h_batch.methods.predictors import read_observations

    scene = setting.evaluator.scene
    named = {name.removeprefix("predicted_"): file for name, file in files.items()}
    seen = read_observations(scene.objects, scene.hands.model, **named)
    planned = setting.ids(0, setting.planned)
    seen.check_trials(planned.numpy())
    if seen.parts is not None:
        seen.check_parts(setting.trials(planned), scene.objects)
    return seen


@dataclass(frozen=True)
class _Method:
    """A method that was found, its parameters and the values of its options."""

    built_in: bool
    found: UserFunction
    takes: Mapping[str, Any]
    options: Mapping[str, Any]


def resolve(sweep: Sweep) -> None:
    """Raises `UsageError` or `ValueError` for a --method, --policy or --predictor that is not there, or a method whose files are
    not those of its rows, before anything slow starts."""
    if (loop := sweep.loop) is not None:
        from r2h_batch.closed_loop.episodes import policy_of

        try:
            policy_of(loop.policy)
        except (ImportError, TypeError) as error:
            raise UsageError(f"--policy {loop.policy}: {error}") from None
    for name in map(base_of, sweep.method):
        if ":" not in name:
            METHODS[
                name
            ]  # one of a package is looked at, and the package named where it cannot be had
    for name in sweep.names:
        method = _method(name, seeing=sweep.seeing is not None)
        # the code of a plug-in's method decides what run it is: another one is refused with the run, and --overwrite is no help
        own = not method.built_in and not package_of_method(method.found.spec)
        if own and not sweep.overwrite:
            made_of = _made_of(name, method, _files(name, method))
            check_files(Path(sweep.out), _title(name, method), made_of)
    if sweep.predictor and "predicted_contacts" in sweep.seen:
        raise UsageError("--predictor and --predicted-contacts both say the contacts; give one")
    if sweep.predictor:
        from r2h_batch.methods.predictors import load_predictor

        load_predictor(sweep.predictor)


def _function_of(word: str) -> str:
    """A built-in method's `module:function`."""
    return f"r2h_batch.methods.{word.replace('-', '_')}:predict"


def _method(argument: str, *, seeing: bool = False) -> _Method:
    """`seeing`: it is shown what cameras see."""
    name = base_of(argument)
    built_in = name in METHOD_NAMES
    takes = "(seen) with --sees" if seeing else "(trials, scene), or (seen) with --sees"
    form = f"it must be {HOW}; the function takes {takes}, and seed if it draws numbers"
    try:
        if built_in:
            spec = _function_of(name)
            module = import_module(spec.partition(":")[0])
            found = UserFunction(module.predict, module, spec)
        else:
            found = load_function(name)
    except ImportError as error:
        if isinstance(error.__cause__, Ended):
            raise EndedError(f"--method {name}: {error}") from error
        words = " ".join(str(error).split())
        # what the module itself raised, a syntax error for example, has nothing to do with how it is named
        how = "" if error.__cause__ else f"; {form}"
        raise UsageError(f"--method {name}: {words}{how}") from error
    function = found.function
    chosen = options_of(argument, function, known=built_in) if callable(function) else {}
    try:
        signature = _signature(function)
        told = {"evaluator", "noise", "predictor", "seen", "T_world_obj"}
        more = told & signature.parameters.keys()
        if seeing and not built_in:
            more = set()
        if _takes_seed(signature.parameters):
            more |= {"seed"}
        given = 1 if seeing and not built_in else 2
        signature.bind(*(None,) * given, **dict.fromkeys(more), **chosen)
    except (TypeError, ValueError) as error:
        raise UsageError(f"--method {name}: {error}; {form}") from error
    return _Method(built_in, found, signature.parameters, chosen)


def _signature(function: Any) -> inspect.Signature:
    """Raises TypeError where it has none: a stranger's `__signature__` may raise anything."""
    try:
        return inspect.signature(function)
    except Exception as error:
        raise TypeError(words_of(error).partition(": ")[2]) from error


def method_reads(argument: str, *, seeing: bool = False) -> str:
    """What a method may read, a word of `READS`: what its arguments give it, or what it declares where they allow it.

    Args:
        argument: of `--method`.
        seeing: it is shown what cameras see.
    """
    method = _method(argument, seeing=seeing)
    if seeing:
        return "cameras"
    if "evaluator" in method.takes:
        return "judge"
    declared = getattr(method.found.function, "reads", "")
    if isinstance(declared, str) and declared in READS:
        return declared
    # a function is given the scene, with the true region: that it looks at estimates alone only its author knows
    given = method.built_in and {"noise", "seen"} & method.takes.keys()
    return "estimates" if given else "scene"


def _takes_seed(parameters: Mapping[str, inspect.Parameter]) -> bool:
    return "seed" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def _title(name: str, method: _Method) -> str:
    """What tables call a method, of a built-in one before its predictors are known."""
    base = own_name(name) or (base_of(name) if method.built_in else method.found.spec)
    options = text_of_options(name)
    return f"{base} ({options})" if options and not own_name(name) else base


def _files(name: str, method: _Method) -> dict[str, Path]:
    """The files that decide a method's answers: modules, `METHOD_FILES`, and files that its options name."""
    if method.built_in:
        named = (method.options.get(k) for k in METHODS[base_of(name)].files)
        return {"": Path(str(method.found.module.__file__))} | {str(v): Path(v) for v in named if v}
    texts = [v for v in method.options.values() if isinstance(v, str)]
    return method.found.files() | {v: Path(v) for v in texts if Path(v).is_file()}


def _made_of(name: str, method: _Method, files: Mapping[str, Path]) -> dict[str, str]:
    """What a method's source says of its options, its package and these files of its."""
    options, package = text_of_options(name), package_of_method(method.found.spec)
    source = {"options": options} if options else {}
    source |= {"package": package} if package else {}
    source["sha256"] = provenance.file_digest(files.values())
    if not method.built_in:
        source |= {f"file {k}": provenance.file_digest([p]) for k, p in files.items()}
    return source


def _method_job(
    name: str,
    evaluator: "Evaluator",
    sweep: Sweep,
    seen: "Observations | None" = None,
    looks: "Looks | None" = None,
) -> Job:
    method, method_options = _method(name, seeing=sweep.seeing is not None), text_of_options(name)
    module, takes, built_in = method.found.module, method.takes, method.built_in
    extra = dict(method.options)
    sees = METHODS[base_of(name)].sees if built_in else ()
    if "evaluator" in takes and sweep.seeing is None:
        extra["evaluator"] = evaluator
    if _takes_seed(takes):
        extra["seed"] = sweep.seed
    title, files = _title(name, method), _files(name, method)
    source = {"kind": "method", "function": method.found.spec}
    source["reads"] = method_reads(name, seeing=sweep.seeing is not None)
    if told := _trained_on(name, method, evaluator):
        source[TRAINED_ON] = told
    source |= _made_of(name, method, files)
    theirs = sweep.predictor or (seen is not None and seen.contacts is not None)
    guesses = () if theirs else guessed_contacts(name, sees, evaluator.scene)
    if looks is not None:
        from r2h_batch.sweep.seeing import SeeingMethod

        if built_in:
            more = f"; {method_options}" if method_options else ""
            title = f"{getattr(module, 'TITLE', base_of(name))} (seen{more})"
            asked = SeeingMethod.built_in(title, method.found.function, sees, extra, looks)
            lines = guesses
        else:
            asked = SeeingMethod.apart(title, base_of(name), extra, looks)
            lines = _not_compared(title, method.found.module, files)
        return Job(
            title, source, lambda trials, _: asked.predict(trials), lines=lines, looked=asked.looked
        )
    if "noise" in takes:
        from r2h_batch.methods.predictors import load_predictor

        extra["noise"] = sweep.noise
        own = sweep.predictor if built_in and "predictor" in takes else ""
        if own:
            extra["predictor"] = load_predictor(own)
        if seen is not None and "seen" in takes:
            extra["seen"] = seen
        if built_in:
            others: Mapping[str, str] = getattr(module, "STAND_INS", {})
            chosen = (
                word for option, word in others.items() if option in method_options.split(",")
            )
            stand_in = Path(own).name or next(chosen, module.STAND_IN)
            shown = {k: v for k, v in (seen.sources() if seen else {}).items() if k in sees}
            noise, errors = sweep.predictor_noise, sweep.errors
            title = table_name(
                module.TITLE, stand_in, noise, shown, sees, method_options, errors=errors
            )
        source["predictors"] = json.dumps(sweep.about_predictors(), sort_keys=True)

    on_table = "T_world_obj" in takes and "pick" in evaluator.benchmark.asks

    def answer(trials: Trials) -> Predictions:
        before = sys.modules.copy()
        if on_table:
            from r2h_batch.observe.known import known_moments  # cameras too: a third of a second

            extra["T_world_obj"] = known_moments(evaluator.scene).of(trials)
        with on_threads(evaluator.threads):
            function = partial(method.found.function, **extra)
            answer = answer_of(
                title, trials, lambda copied: function(copied, evaluator.scene), of=module.__name__
            )
        own = module.__name__.partition(".")[0]
        late = user_files(sys.modules.keys() - before.keys(), installed={own})
        for k in late.keys() - files.keys() if not built_in else ():
            words = "a resume does not notice its changes"
            LOG.info(f"{title}: imported {k} when it was called; {words}")
        return answer

    if not built_in:
        lines = _not_compared(title, module, files)
        return Job(title, source, lambda trials, _: answer(trials), lines=lines)
    coverage = coverage_of(name, sees, evaluator.scene, seen)

    def covered(trials: Trials, _: Any) -> Predictions:
        return coverage.answer(trials, answer)

    return Job(title, source, covered, warm=True, lines=(*coverage.lines, *guesses))


def _not_compared(title: str, module: ModuleType, files: Mapping[str, Path]) -> tuple[str, ...]:
    """A line on what of a user's method a resume does not compare; nothing where it names its files."""
    if hasattr(module, "METHOD_FILES"):
        return ()
    others = f" or {counted(len(files) - 1, 'modules')} that it imports"
    changes = f"{module.__name__}{others if len(files) > 1 else ''} changes"
    words = "other files (weights, data) are not compared: name them in METHOD_FILES of the module"
    return (f"{title}: a resume is refused once {changes}; {words}",)


def _trained_on(name: str, method: _Method, evaluator: "Evaluator") -> str:
    """The objects that `TRAINED_ON` of a method's module names; empty where it names none.

    It is a sequence of names or patterns of objects (`cup_s1005_*`), or a function of the method's options that returns one.

    Raises:
        UsageError: it is neither, or one of the judged objects is among them.
    """
    told = getattr(method.found.module, "TRAINED_ON", ())
    try:
        with stranger(f"--method {name}", method.found.module.__name__):
            told = told(**method.options) if callable(told) else told
            several = isinstance(told, Iterable) and not isinstance(told, str)
            names = tuple(islice(told, MOST_TRAINED_ON + 1)) if several else ()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit too
        raise UsageError(f"--method {name}: its TRAINED_ON: {raised(error)}") from error
    if not several or not all(isinstance(t, str) for t in names):
        raise UsageError(
            f"--method {name}: TRAINED_ON is {describe_value(told)}; write names or patterns of objects, such as ['cup_s1005_*']"
        )
    if len(names) > MOST_TRAINED_ON:
        raise UsageError(
            f"--method {name}: TRAINED_ON has more than {MOST_TRAINED_ON} names; write patterns, such as ['cup_s1005_*']"
        )
    for pattern in names:
        if seen := [
            model.name for model in evaluator.scene.objects if fnmatchcase(model.name, pattern)
        ]:
            raise UsageError(
                f"--method {name}: was trained on {seen[0]}, says its TRAINED_ON; judge it on other objects"
            )
    few = ", ".join(names[:NAMED])
    return f"{few} and {len(names) - NAMED} more objects" if len(names) > NAMED else few


class NotBuiltIn(UsageError):
    """A method, or files of its networks, are the user's: they are not run or opened again. Nor is a method with an option
    that went (`base.gone`)."""


def job_of_run(header: Mapping[str, Any], source: Mapping[str, str], evaluator: "Evaluator") -> Job:
    """The built-in method that a run folder names, to be asked again.

    A folder may come from anybody: modules and files that it names are not opened.

    Args:
        header: run.json.
        source: where its answers come from, as its `Entry` says.
        evaluator: of the run's objects and hands.

    Raises:
        NotBuiltIn: a method or files of the user's answered, or one with an option that went.
        UsageError: the built-in method takes no such options.
    """
    from r2h_batch.observe.sees import Sees
    from r2h_batch.trials.noise import Errors

    predictors = header.get("predictors", {})
    function = source.get("function", "")
    word = function.removeprefix("r2h_batch.methods.").removesuffix(":predict").replace("_", "-")
    if function != _function_of(word) or word not in METHOD_NAMES:
        raise NotBuiltIn("only built-in methods can be called again")
    if files := [k for k, v in predictors.items() if isinstance(v, dict) and "file" in v]:
        raise NotBuiltIn(f"{', '.join(files)} came from files of its own, which are not opened")
    noise = predictors.get("noise")
    errors = noise.get("target_errors", "normal") if isinstance(noise, dict) else "normal"
    if errors not in get_args(Errors):
        named, allowed = str(errors)[:40], ", ".join(get_args(Errors))
        raise UsageError(f"run.json names the error model {named!r}; allowed are {allowed}")
    method_options = source.get("options", "")
    given = {part.partition("=")[0].strip() for part in method_options.split(",")}
    if went := [told for option in sorted(given) if (told := gone(f"--method {word},{option}"))]:
        raise NotBuiltIn(went[0])
    if own := given & {*METHODS[word].files}:
        raise NotBuiltIn(f"{', '.join(own)} came from a file of its own, which is not opened")
    sees = Sees.of_run(header)
    if sees is None and header.get("sees") is not None:
        raise NotBuiltIn("it saw by cameras of a file of its own, which is not opened")
    noise_factor = predictors.get("noise_factor", 1.0)
    name = f"{word},{method_options}" if method_options else word
    sweep = Sweep(
        method=(name,), seed=header["seed"], predictor_noise=noise_factor, seeing=sees,
        errors=cast("Errors", errors),
    )  # fmt: skip
    looks = None
    if sees is not None:
        from r2h_batch.sweep.seeing import Looks

        looks = Looks(sees, evaluator)
    return _method_job(name, evaluator, sweep, looks=looks)


SHOWN_AS = {"receiving": "hand", "target": "target hand", "parts": "labels", "contacts": "contacts"}
"""Observation -> its name in a method's name in tables."""


def table_name(
    title: str, stand_in: str, noise: float, shown: Mapping[str, str] | None = None,
    sees: Sequence[str] = (), method_options: str = "", *, errors: "Errors" = "normal",
) -> str:  # fmt: skip
    """A method's name in tables: what stood in for the original network, the error model it was
    given, its own options.

    `shown`: kind -> the network whose prediction it saw, of all the kinds that it `sees`; what no
    network gave is named too. `method_options`: those that were given with its name.
    """
    more = f"; {method_options}" if method_options else ""
    kind = {"normal": "", "frames": " of frames", "tails": " with tails"}[errors]
    added = "" if noise == 0 else f" + noise{kind}" if noise == 1 else f" + {noise:g} x noise{kind}"
    if not shown:
        return f"{title} ({stand_in}{added}{more})"
    # the built-in contact network sees no noise: it is asked about the object alone
    stood = dict.fromkeys(sees, f"oracle{added}") | {"contacts": stand_in.partition(",")[0]}
    return f"{title} ({', '.join(f'{SHOWN_AS[k]}: {shown.get(k, stood[k])}' for k in sees)}{more})"
