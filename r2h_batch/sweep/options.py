"""The options of a sweep: flags, and a YAML file with fields of the same names. Imports nothing heavy.

Settings of the configuration are in `settings`: a dotted name is a field of `EvalConfig`."""

import inspect
import json
import keyword
import math
import re
import shutil
import sys
import textwrap
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args, get_origin

from r2h_batch.base import command_line
from r2h_batch.base.errors import FileError, UsageError, nearest
from r2h_batch.base.gone import gone
from r2h_batch.base.registry import (
    BENCHMARKS,
    DEFAULT_BENCHMARK,
    METHOD_NAMES,
    METHODS,
    PRESETS,
    PresetName,
)
from r2h_batch.base.user_code import HOW
from r2h_batch.base.validate import expand_home
from r2h_batch.plugins import PackageError, PluginError

if TYPE_CHECKING:
    from r2h_batch.config import EvalConfig

SEEN_BY = {
    name: tuple(m for m in METHOD_NAMES if set(METHODS[m].sees) & set(kinds))
    for name, kinds in {
        "predicted_hands": ("receiving", "target"),
        "predicted_parts": ("parts",),
        "predicted_contacts": ("contacts",),
    }.items()
}
"""Files of networks' answers -> the methods that are shown them."""

KINDS = ("details", "poses", "paths")
"""Tables that can be stored beside the trials."""

MOST = 10**12
"""Largest count: a larger number is a slip that something else would refuse much later."""


class Flag(NamedTuple):
    """The help of an option, and the group in which `--help-all` lists it."""

    help: str
    group: str = ""  # of `GROUPS`; empty: of `FIRST`


FIRST = ("method", "predictions", "benchmark", "trials", "robot", "preset", "device", "out")
"""Options that everybody needs: `--help` explains these, `--help-all` every one."""

GROUPS = {
    "methods": "what methods see, answers from files",
    "trials": "objects, people, hands, trials of your own",
    "closed loop": "a hand that moves, a policy that reacts",
    "errors": "camera and object are not where they are said to be",
    "output": "table, run folder, loggers",
    "work": "threads, chunks, job arrays, a Ray cluster",
}
"""Groups of options, in the order of the help."""

SETTINGS_GROUP = ("configuration", "criteria, planning, motion, errors")


_BENCHMARK_HELP = "; ".join(
    f"{p.name}{' (default)' if p.name == DEFAULT_BENCHMARK else ''}: {p.help}"
    for p in sorted(BENCHMARKS, key=lambda p: p.name != DEFAULT_BENCHMARK)
)
_PRESET_HELP = "; ".join(f"{p.name}: {p.help}" for p in PRESETS)


ABOUT = "Score handover methods on the benchmark's trials and print Table I."


@dataclass(frozen=True)
class Flags:
    """Score handover methods on the benchmark's trials and print Table I."""

    method: Annotated[
        tuple[str, ...],
        Flag(
            f"{', '.join(METHOD_NAMES)}; your own: package.module:function, "
            "FILE.py:function or NAME=FILE.py:function; with options: contact,gate=ik",
        ),
    ] = ()
    predictions: Annotated[tuple[str, ...], Flag("files of poses: .npz, .csv, .json")] = ()
    motions: Annotated[
        tuple[str, ...],
        Flag("files of joint motions, judged as they are: .npz, .parquet", "methods"),
    ] = ()
    seed: Annotated[int, Flag("seed of the methods; it does not change the trials", "methods")] = 0
    trials_from: Annotated[
        str, Flag("judge trials and motions of the authors' release: a folder or file", "trials")
    ] = ""
    trials: Annotated[int, Flag("trials of each split")] = 500
    splits: Annotated[
        tuple[Literal["S0", "S1"], ...],
        Flag("S0: free handover; S1: functional handover", "trials"),
    ] = ("S0", "S1")
    receiver: Annotated[
        Literal["", "hand", "body"],
        Flag(
            "what planning and Safe see of the person: hand, or body; default: the benchmark's",
            "trials",
        ),
    ] = ""
    until: Annotated[
        Literal["", "present", "received"],
        Flag(
            "where trials of r2h-v3 end: present (nobody is asked to take it), or received; default: the benchmark's",
            "trials",
        ),
    ] = ""
    trials_file: Annotated[str, Flag("your own trials, .npz or .parquet", "trials")] = ""
    benchmark: Annotated[
        str,
        Flag(f"{_BENCHMARK_HELP}; or your benchmark.yaml, or package.module:function"),
    ] = ""
    objects: Annotated[str, Flag("other objects: folder, or benchmark.yaml", "trials")] = ""
    object_mesh: Annotated[
        tuple[str, ...],
        Flag(
            "more objects, FILE[:S0|S1[:REGION]]; REGION, the receiver's part: its name, a plane such as "
            "z<0.3, or an .npy of faces",
            "trials",
        ),
    ] = ()
    grasps: Annotated[
        tuple[str, ...], Flag("grasp candidates: NAME=FILE, a file, or a folder", "trials")
    ] = ()
    robot: Annotated[
        str,
        Flag("ur5e_2f85 (default), another of ls robots, or a folder of import robot"),
    ] = ""
    persons: Annotated[
        Literal["", "for-robot", "as-for-ur5e"],
        Flag(
            "where persons stand. for-robot (default): scaled by the robot's reach; as-for-ur5e: as for the "
            "UR5e",
            "trials",
        ),
    ] = ""
    people: Annotated[
        str,
        Flag(
            "receivers with their own bodies and hands: adults, children, elderly, all, wheelchair, or a .csv of lengths "
            "(import people)",
            "trials",
        ),
    ] = ""
    turn: Annotated[
        str,
        Flag(
            "turn the objects' frames: half (180 degrees about z), cycled (x to y, y to z, z to x) or degrees about x, y, z "
            "(20,40,60); for the turn test (docs/statistics.md)",
            "trials",
        ),
    ] = ""
    hands: Annotated[str, Flag("another hand set: .npz of import hands", "trials")] = ""
    hand_model: Annotated[str, Flag("MANO_RIGHT.pkl, or .npz of import hand", "trials")] = ""
    preset: Annotated[PresetName, Flag(_PRESET_HELP)] = "default"
    out: Annotated[
        str, Flag("run folder; the same command continues it; default: runs/DATE-TIME")
    ] = ""
    format: Annotated[
        Literal["md", "latex", "csv", "json"], Flag("format of the table", "output")
    ] = "md"
    save_paths: Annotated[
        bool,
        Flag("store waypoints, goals, grasps and witnesses, for r2h-batch export scene", "output"),
    ] = False
    quiet: Annotated[bool, Flag("print only errors on stderr", "output")] = False
    device: Annotated[str, Flag("cpu, cuda or cuda:N")] = "cpu"
    threads: Annotated[int | None, Flag("CPU threads; default: all cores", "work")] = None
    shard: Annotated[str, Flag("I/N: part I of N, for job arrays with one --out", "work")] = "1/1"
    shard_trials: Annotated[int, Flag("trials of a shard; 0: a minute of work", "work")] = 0
    engine: Annotated[Literal["local", "ray"], Flag("this process, or a Ray cluster", "work")] = (
        "local"
    )
    address: Annotated[str, Flag("Ray cluster to join: auto or HOST:PORT", "work")] = ""
    replan: Annotated[
        bool,
        Flag(
            "with trials_from: plan every motion anew instead of judging that of the file", "trials"
        ),
    ] = False
    predictor: Annotated[
        str,
        Flag(
            "contact network of method contact: .onnx, VoxNet weights as .safetensors, or "
            "package.module:function or FILE.py:function; default: the built-in VoxNet",
            "methods",
        ),
    ] = ""
    predictor_noise: Annotated[
        float,
        Flag("factor on the error model of what the methods see; 0: they see the truth", "methods"),
    ] = 1.0
    sees: Annotated[
        str,
        Flag(
            "show methods what depth cameras see, and nothing else: cell-v1 or a rig's TOML file, with options "
            "cell-v1,noise=0.5,labels=eroded,model=known,object=field,region=told,seed=1; your method is then predict(seen)",
            "methods",
        ),
    ] = ""
    object_errors: Annotated[
        str,
        Flag(
            "how far off methods see the object, per axis: none, lab (2 mm, 1 degrees), field (5 mm, 4 degrees), rgb (10 mm, 8 "
            "degrees), or such as 7mm,3deg; all methods, also oracle and files of poses. Gross errors: --object-errors.gross",
            "errors",
        ),
    ] = ""
    execution_error: Annotated[
        str,
        Flag(
            "what the executed poses miss by. 5mm,1deg: camera and object err in every trial; camera:5mm,1deg or "
            "object:5mm,1deg: one of both; bias:5mm,1deg: one error of the camera for all trials; two with + between them",
            "errors",
        ),
    ] = ""
    predicted_hands: Annotated[
        str,
        Flag(
            "hands of your own network instead of the error model, .npz; fc, handover-va, contact and intent "
            "see them",
            "methods",
        ),
    ] = ""
    predicted_parts: Annotated[
        str,
        Flag("part labels or affordances of your own network; handover-va sees them", "methods"),
    ] = ""
    predicted_contacts: Annotated[
        str, Flag("contact probabilities of your own network; contact sees them", "methods")
    ] = ""
    receiver_motion: Annotated[
        str,
        Flag(
            "also play every handover in closed loop; the receiver's hand: still, moves, reaches, hesitates, "
            "withdraws or takes, with a size such as moves:100mm,20deg; or replay:NAME_motion.npz of import "
            "hands (needs the extra env)",
            "closed loop",
        ),
    ] = ""
    policy: Annotated[
        str,
        Flag(
            "policy that moves the arm in closed loop: planned, stop, servo, replan, or your "
            "package.module:function, which takes an observation of HandoverEnv",
            "closed loop",
        ),
    ] = "planned"
    horizon: Annotated[
        float | None,
        Flag(
            "longest episode of a closed loop, s: 15 unless given; slow arms need more",
            "closed loop",
        ),
    ] = None
    log: Annotated[
        Literal["", "tensorboard", "wandb", "mlflow", "trackio"],
        Flag("also write the table's numbers into a logger, in the run folder (offline)", "output"),
    ] = ""
    no_poses: Annotated[
        bool,
        Flag(
            "do not store the scored poses: saves 51 to 81 bytes a trial; reevaluate needs them",
            "output",
        ),
    ] = False
    overwrite: Annotated[
        bool,
        Flag("judge a method of --out anew whose files changed, in place of its rows", "output"),
    ] = False
    verbose: Annotated[
        bool, Flag("print every step and shard on stderr; log.txt always has them", "output")
    ] = False
    allow_empty_candidates: Annotated[
        bool,
        Flag("count trials of objects without a grasp as failures of built-in methods", "methods"),
    ] = False
    allow_missing: Annotated[
        bool, Flag("count trials that a predictions file leaves out as failures", "methods")
    ] = False
    chunk: Annotated[int, Flag("trials scored at once; 0: 256 on a CPU, 2048 on a GPU", "work")] = 0
    ray_timeout: Annotated[
        float, Flag("seconds after which a Ray cluster that does not answer counts as lost", "work")
    ] = 30.0
    workers: Annotated[int, Flag("Ray actors; 0: one for each GPU, or for each 4 CPUs", "work")] = 0
    gpus_per_worker: Annotated[float, Flag("GPUs of each actor; 0: 1 with device cuda", "work")] = (
        0.0
    )

    @property
    def part(self) -> tuple[int, int]:
        """(I, N) of --shard I/N."""
        i, _, n = self.shard.partition("/")
        return int(i), int(n)


@dataclass(frozen=True)
class Options(Flags):
    """A sweep as a command line asks for it.

    Attributes:
        settings: setting of the configuration (`settings.settings`) -> its value, where it is given.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)


def help_text(prog: str) -> str:
    """The flags that everybody needs, and the names of the other groups: one screen."""
    groups = [*GROUPS.items(), SETTINGS_GROUP]
    lines = [
        _usage(prog),
        "",
        ABOUT,
        "",
        *_described(FIRST),
        "",
        "more, in groups (--help-all):",
    ]
    config = ("--config FILE", "a YAML file with any option; a flag wins over it")
    return "\n".join([*lines, *_columns(groups), *_columns([config])]) + "\n"


def full_help(prog: str) -> str:
    """Every flag in its group, with its meaning."""
    from r2h_batch.sweep.settings import described

    lines = [_usage(prog), "", ABOUT, "", "first:", *_described(FIRST)]
    for group, words in GROUPS.items():
        names = [name for name, (_, flag) in _flags().items() if flag.group == group]
        lines += ["", f"{group} ({words}):", *_described(names)]
    name, words = SETTINGS_GROUP
    lines += ["", f"{name} ({words}):", *_columns(described())]
    config = (
        (
            "--config FILE",
            "a YAML file with any option by its name, such as plan.edge_check: moveit; a flag wins over it",
        ),
        ("--help, --help-all", "the first flags, or all"),
    )
    return "\n".join([*lines, "", "this list:", *_columns(config)]) + "\n"


def _usage(prog: str) -> str:
    return f"usage: {prog} [--config FILE] [FLAGS]"


def _flags() -> dict[str, tuple[Any, Flag]]:
    """Name of an option -> its type and what the help says of it."""
    hints = typing.get_type_hints(Flags, include_extras=True)
    return {name: (hint.__origin__, hint.__metadata__[0]) for name, hint in hints.items()}


def _flag(name: str) -> str:
    """An option as a flag."""
    return f"--{name.replace('_', '-')}"


def _described(names: Iterable[str]) -> list[str]:
    """The lines of options."""
    rows, known = [], _flags()
    for name in names:
        (kind, flag), more = known[name], ""
        if get_origin(kind) is tuple:
            kind, more = get_args(kind)[0], " ..."
        if get_origin(kind) is Literal:
            value = "|".join(v for v in get_args(kind) if v)
        else:
            value = {bool: "", str: "TEXT", float: "NUMBER"}.get(kind, "INT")
        rows.append((f"{_flag(name)} {value}{more}".rstrip(), flag.help + _default(name, flag)))
    return _columns(rows)


def _default(name: str, flag: Flag) -> str:
    """An option's default in brackets; "" for a switch, where nothing is set by default, or where the text names it."""
    value = Options.__dataclass_fields__[name].default
    if isinstance(value, bool) or value in ("", (), None) or "default" in flag.help:
        return ""
    return f" (default: {' '.join(value) if isinstance(value, tuple) else f'{value:g}' if isinstance(value, float) else value})"


def _columns(rows: Sequence[tuple[str, str]]) -> list[str]:
    width, start, lines = min(shutil.get_terminal_size().columns, 100), 32, []
    for head, words in rows:
        wrapped = textwrap.wrap(words, max(width - start, 30), break_on_hyphens=False)
        if len(head) + 3 > start:  # a long head has a line of its own
            lines.append(f"  {head}")
            head = ""
        lines.append(f"  {head}".ljust(start) + wrapped[0])
        lines += [" " * start + line for line in wrapped[1:]]
    return lines


EXCLUDED = (
    ("save_paths", ("no_poses",), "stores all that a trial can be opened by"),
    (
        "receiver_motion",
        ("motions", "trials_from", "execution_error", "object_errors"),
        "plays handovers from poses without errors",
    ),
    (
        "sees",
        (
            *("predictions", "motions", "trials_from", "receiver_motion", "object_errors"),
            *("predicted_hands", "predicted_parts", "predicted_contacts", "predictor"),
        ),
        "shows methods images and estimates of its own",
    ),
    (
        "execution_error",
        ("motions", "trials_from"),
        "changes poses, and motions are judged as they are",
    ),
    (
        "object_errors",
        ("motions", "trials_from"),
        "changes grasps, and motions are judged as they are",
    ),
)
"""Options that exclude others, and why."""


def configuration(options: Options) -> "EvalConfig":
    """The preset of a sweep with its settings and errors.

    Raises:
        UsageError: one line about the first value that cannot be.
    """
    from r2h_batch.config import EvalConfig
    from r2h_batch.sweep.settings import configured, execution_error, object_error_size

    config = configured(EvalConfig.preset(options.preset), options.settings)
    if options.execution_error:
        config = replace(config, execution_error=execution_error(options.execution_error))
    if options.object_errors:
        m, deg = object_error_size(options.object_errors)
        told = replace(config.object_errors, translation_m=m, rotation_deg=deg)
        config = replace(config, object_errors=told)
    return config


def check(options: Options) -> Options:
    """The options, or a `UsageError` about the first that cannot be."""
    if not (options.method or options.predictions or options.motions or options.trials_from):
        flags = "--predictions FILE, --motions FILE or --trials-from FILE"
        raise UsageError(f"nothing to score: give --method {' '.join(METHOD_NAMES)}, {flags}")
    bases = [base_of(name) for name in options.method]
    for name, base in zip(options.method, bases, strict=True):
        check_method(base)
        if base in METHOD_NAMES and own_name(name):
            words = f"{base} is built in and keeps its name in tables; leave {own_name(name)}= out"
            raise UsageError(f"--method {name}: {words}")
    least = {"trials": 1, "threads": 1, "shard_trials": 0, "chunk": 0, "workers": 0}
    for name, low in {**least, "gpus_per_worker": 0}.items():
        value, flag = getattr(options, name), _flag(name)
        if value is not None and not value >= low:
            raise UsageError(f"{flag} is {value}; it must be {low} or more")
        if value is not None and value > MOST:
            raise UsageError(f"{flag} is {str(value)[:40]}; it must be {MOST} or less")
    if not -(1 << 63) <= options.seed < 1 << 63:
        raise UsageError(f"--seed is {str(options.seed)[:40]}; it must fit 64 bits")
    for name in ("method", "splits", "predictions", "motions"):
        values = getattr(options, name)
        if twice := [v for v in values if values.count(v) > 1]:
            raise UsageError(f"--{name} {twice[0]} is given twice; once is enough")
    if not (math.isfinite(options.predictor_noise) and options.predictor_noise >= 0):
        words = "it must be 0 (the truth) or more, 1 is the default"
        raise UsageError(f"--predictor-noise is {options.predictor_noise}; {words}")
    config = configuration(options)
    for name, others, why in EXCLUDED:
        for other in others if _is_given(options, name) else ():
            if _is_given(options, other):
                raise UsageError(f"{_flag(name)} {why}; leave {_flag(other)} out")
    if options.policy != Options.policy and not options.receiver_motion:
        words = "add --receiver-motion, such as moves or still"
        raise UsageError(f"--policy moves the arm in closed loop; {words}")
    if options.horizon is not None and not options.receiver_motion:
        raise UsageError("--horizon is of a closed loop; add --receiver-motion, such as moves")
    if options.sees:
        from r2h_batch.observe.sees import Sees

        Sees.parse(options.sees)
        if "oracle" in bases:
            words = "is told the truth, it asks the judge; leave it out"
            raise UsageError(f"--method oracle {words}, or leave --sees out")
    if options.predictor and "contact" not in bases:
        words = "add that method, or leave it out"
        raise UsageError(f"--predictor is the contact network of --method contact; {words}")
    for name, users in SEEN_BY.items():
        if getattr(options, name) and not any(m in users or ":" in m for m in bases):
            words = f"is seen by --method {', '.join(users)}; add one, or leave it out"
            raise UsageError(f"{_flag(name)} {words}")
    if options.predicted_hands and config.plan.hand == "estimated":
        words = "paths are planned against the error model's hand or the true one"
        raise UsageError(f"--predicted-hands: {words}; add --plan.hand true")
    if not options.splits:
        raise UsageError("--splits names no split; allowed are S0, S1")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", options.device, re.ASCII):
        raise UsageError(f"--device is {options.device!r}; allowed are cpu, cuda, cuda:N")
    part = re.fullmatch(r"(\d{1,9})/(\d{1,9})", options.shard, re.ASCII)
    if not part or not 1 <= int(part[1]) <= int(part[2]):
        words = "it must be I/N with I from 1 to N, such as 2/8"
        raise UsageError(f"--shard is {options.shard!r}; {words}")
    if options.part[1] > 1 and not options.out:
        raise UsageError("--shard needs --out: all parts write to one folder")
    if not 0 < options.ray_timeout <= 86400:
        words = "it must be more than 0 and at most 86400 seconds"
        raise UsageError(f"--ray-timeout is {options.ray_timeout:g}; {words}")
    of_ray = options.workers or options.address or options.gpus_per_worker
    if options.engine == "local" and of_ray:
        raise UsageError("--workers, --address and --gpus-per-worker belong to --engine ray")
    return options


def _is_given(options: Options, name: str) -> bool:
    """Whether an option is given, or a setting of the section that has its name."""
    return bool(getattr(options, name)) or any(k.startswith(f"{name}.") for k in options.settings)


def parse(arguments: Sequence[str], *, prog: str = "python -m r2h_batch.sweep") -> Options:
    """The checked options of a command line.

    Raises:
        UsageError: one line about the first option that cannot be.
        SystemExit: the help is printed.
    """
    if {"--help", "-h", "--help-all"} & set(arguments):
        text = full_help if "--help-all" in arguments else help_text
        sys.stdout.write(text(prog))
        raise SystemExit(0)
    from r2h_batch.sweep.settings import given_in

    arguments, path = _without_config(arguments)
    file = Options() if path is None else load_config(Path(path))
    kind, flags = line_class(), [f.name for f in fields(Flags)]
    default = kind(**{name: getattr(file, name) for name in flags})
    more = ["--config", "--help-all"]
    line = command_line.parse(kind, arguments, prog=prog, default=default, more_flags=more)
    values = {name: getattr(line, name) for name in flags}
    settings = {**file.settings, **given_in(line, arguments)}
    return check(Options(**values, settings=settings))


def line_class() -> type:
    """The dataclass that tyro reads: the flags, and the settings as `settings.line_fields`."""
    from r2h_batch.sweep.settings import line_fields

    made: type = make_dataclass("Line", line_fields(), bases=(Flags,), frozen=True)
    made.__doc__ = ABOUT  # python -OO takes docstrings
    return made


def load_config(path: Path) -> Options:
    """Options from a YAML file with the flags' names as fields, such as `plan.edge_check`.

    Raises:
        UsageError: a field is unknown or of another type; the message names it.
    """
    import pydantic

    from r2h_batch.base.io.read import read_yaml
    from r2h_batch.base.validate import rule_of
    from r2h_batch.config import EvalConfig
    from r2h_batch.sweep.settings import configured, given_in_file

    try:
        data = read_yaml(path)
        try:
            given = given_in_file(data)
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None
        _check_names(str(path), data)
        text = json.dumps(data, default=str)
        options = pydantic.TypeAdapter(Flags).validate_json(text, strict=True)
        values = {k: _expanded(v) for k, v in asdict(options).items()}
    except FileError as error:
        raise UsageError(str(error)) from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        found = repr(first["input"])[:80]
        raise UsageError(f"{path}: {where} is {found}; {rule_of(first)}") from None
    try:
        configured(EvalConfig.preset(options.preset), given)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    return Options(**values, settings=given)


def _check_names(where: str, names: Iterable[Any]) -> None:
    from r2h_batch.sweep.settings import elsewhere, settings

    allowed = [*(f.name for f in fields(Flags)), *settings()]
    for name in names:
        if name not in allowed:
            if told := gone(f"sweep --{str(name).replace('_', '-')}"):
                raise UsageError(f"{where}: {told}")
            if how := elsewhere(str(name)):
                raise UsageError(f"{where}: {name} is no field of its own; {how}")
            hint = nearest(str(name), allowed)
            raise UsageError(f"{where}: unknown field {name!r}{hint}; see --help-all")


def _expanded(value: Any) -> Any:
    """A value with ~ written out, as in an argument."""
    if isinstance(value, (tuple, list)):
        return tuple(map(_expanded, value))
    return expand_home(value) if isinstance(value, str) else value


def _without_config(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    """The command line without `--config FILE`, and FILE."""
    from r2h_batch.sweep.settings import elsewhere

    rest, path = list(arguments), None
    flags: list[str] = []
    while rest:
        argument = rest.pop(0)
        name, equals, value = argument.partition("=")
        if name.startswith("--") and "." in name:
            name = name.replace("_", "-")
            if how := elsewhere(name[2:].replace("-", "_")):
                raise UsageError(f"{name} is no flag of its own; {how}")
        if name != "--config":
            flags.append(argument)
            continue
        path = value if equals else rest.pop(0) if rest else ""
        if not path:
            raise UsageError("--config names no file")
    return flags, path


GIVEN = (
    *("trials", "scene", "seed", "evaluator", "noise", "predictor", "seen", "instructions"),
    "T_world_obj",
)
"""Arguments of a method that the sweep passes; its other keyword arguments are its options:
`--method contact,gate=ik`."""


POSE_FILES = (".npz", ".csv", ".json", ".parquet")
"""Endings of files that `--predictions` reads."""


def check_method(name: str) -> None:
    """That a method is built in, somebody's own, or given by a package; `spelled_out` says where.

    Args:
        name: as `base_of` says it.

    Raises:
        UsageError: one line with the names that are known.
    """
    if name in METHOD_NAMES or ":" in name:
        return
    try:
        known = tuple(METHODS)
        if name in known and METHODS.outside(name):
            return
    except PackageError:
        raise
    except PluginError as error:
        raise UsageError(f"--method {name}: {error}") from error
    suffix = Path(name).suffix.lower()
    if suffix in POSE_FILES:
        raise UsageError(f"--method {name}: a file of poses is given with --predictions {name}")
    if suffix == ".py":
        raise UsageError(f"--method {name}: name its function too, such as {name}:predict")
    allowed = f"allowed are {', '.join(known)} or your own {HOW}"
    raise UsageError(f"unknown method {name!r}{nearest(name, known)}; {allowed}")


def spelled_out(method: str) -> str:
    """A method of an installed package as its `NAME=module:function`; any other as it is."""
    base = base_of(method)
    if base in METHOD_NAMES or ":" in base:
        return method
    _, comma, chosen = method.partition(",")
    return f"{own_name(method) or base}={METHODS.outside(base)}{comma}{chosen}"


def base_of(method: str) -> str:
    """A built-in method or where the user's function is: without a name for tables, without
    options."""
    return method.partition(",")[0].rpartition("=")[2]


def own_name(method: str) -> str:
    """The name before `=`, which tables show; empty where none is given."""
    return method.partition(",")[0].rpartition("=")[0]


def text_of_options(method: str) -> str:
    """The text after the name, for tables and run folders: `gate=ik, height_m=0.12`; empty
    without options."""
    return ", ".join(part.strip() for part in method.split(",")[1:])


def options_of(method: str, function: Callable[..., Any], *, known: bool) -> dict[str, Any]:
    """The options after a method's name, checked against its function.

    Args:
        method: such as `contact,gate=ik`.
        function: its keyword-only arguments are the options.
        known: whether types must be given (built-in methods). A user's parameter without a type
            takes a number if the text is one.

    Raises:
        UsageError: one line about the first option that cannot be.
    """
    base, *parts = method.split(",")
    if not parts:
        return {}
    allowed = _allowed(function)
    found: dict[str, Any] = {}
    for part in parts:
        name, equals, text = (x.strip() for x in part.partition("="))
        name += "_" if keyword.iskeyword(name) else ""  # oracle,for=reception: parameter for_
        if name not in allowed:
            if told := gone(f"--method {base},{name}"):
                raise UsageError(told)
            takes = f"allowed are {', '.join(allowed)}" if allowed else "it takes none"
            hint = nearest(name, list(allowed))
            raise UsageError(f"--method {base}: unknown option {name!r}{hint}; {takes}")
        if not equals or not text:
            raise UsageError(f"--method {base}: option {name} has no value; say {name}=VALUE")
        if name in found:
            raise UsageError(f"--method {base}: option {name} is given twice; once is enough")
        found[name] = _value(base, name, text, allowed[name], known)
    return found


def _allowed(function: Callable[..., Any]) -> dict[str, Any]:
    """Option -> its type (None: not said)."""
    hints: Mapping[str, Any] = {}
    # a user's annotations may name what is missing when it runs
    with suppress(NameError, TypeError):
        hints = typing.get_type_hints(function)
    takes = inspect.signature(function).parameters.values()
    keywords = [p for p in takes if p.kind is p.KEYWORD_ONLY and p.name not in GIVEN]
    return {p.name: hints.get(p.name) for p in keywords}


def _value(method: str, name: str, text: str, kind: Any, known: bool) -> Any:
    """The text as the option's type."""
    if type(None) in get_args(kind):  # `float | None`: a text is the float
        kind = next(k for k in get_args(kind) if k is not type(None))
    refused = f"--method {method}: {name} is {text!r}"
    words = ("true", "false") if kind is bool else ()
    if words := get_args(kind) if get_origin(kind) is Literal else words:
        if text not in words:
            hint = nearest(text, words)
            raise UsageError(f"{refused}{hint}; allowed are {', '.join(words)}")
        return text == "true" if kind is bool else text
    if kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            what = "a whole number" if kind is int else "a number"
            raise UsageError(f"{refused}; it must be {what}")
        return number
    if kind is None and not known:
        try:
            return int(text) if text.lstrip("-").isdigit() else float(text)
        except ValueError:
            return text
    return text
