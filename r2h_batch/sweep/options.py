"""The options of a sweep: flags, `--set NAME=VALUE` and a YAML file. Imports nothing heavy."""

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
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args, get_origin

from r2h_batch.base import command_line
from r2h_batch.base.errors import FileError, UsageError, nearest
from r2h_batch.base.registry import (
    DEFAULT_PROTOCOL,
    METHOD_NAMES,
    METHODS,
    PRESETS,
    PROTOCOLS,
    EngineWord,
    PresetName,
)
from r2h_batch.base.user_code import HOW
from r2h_batch.base.validate import expand_home
from r2h_batch.plugins import PluginError

if TYPE_CHECKING:
    from r2h_batch.config import ExecutionError

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
    """The help of an option, and the group in which `--help` lists it."""

    help: str
    group: str = ""  # of `GROUPS`; empty: for --set and --config


GROUPS = ("methods", "trials", "verdict", "output", "work")
"""Groups of the help, in order."""


_BENCHMARK_HELP = "; ".join(
    f"{p.name}{' (default)' if p.name == DEFAULT_PROTOCOL else ''}: {p.help}"
    for p in sorted(PROTOCOLS, key=lambda p: p.name != DEFAULT_PROTOCOL)
)
_PRESET_HELP = "; ".join(f"{p.name}: {p.help}" for p in PRESETS)


@dataclass(frozen=True)
class Options:
    """Score handover methods on the benchmark's trials and print Table I."""

    method: Annotated[
        tuple[str, ...],
        Flag(
            "fc, handover-va, contact, intent, random, oracle; your own: package.module:function, "
            "FILE.py:function or NAME=FILE.py:function; with options: contact,gate=ik",
            "methods",
        ),
    ] = ()
    predictions: Annotated[
        tuple[str, ...], Flag("files of poses: .npz, .csv, .json", "methods")
    ] = ()
    motions: Annotated[
        tuple[str, ...],
        Flag("files of joint motions, judged as they are: .npz, .parquet", "methods"),
    ] = ()
    seed: Annotated[int, Flag("seed of the methods; it does not change the trials", "methods")] = 0
    trials_from: Annotated[
        str, Flag("judge trials and motions of the authors' release: a folder or file", "trials")
    ] = ""
    trials: Annotated[int, Flag("trials of each split", "trials")] = 500
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
    trials_file: Annotated[str, Flag("your own trials, .npz or .parquet", "trials")] = ""
    benchmark: Annotated[
        str,
        Flag(f"{_BENCHMARK_HELP}; or your benchmark.yaml, or package.module:function", "trials"),
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
        Flag("ur5e_2f85 (default), another of ls robots, or a folder of import robot", "trials"),
    ] = ""
    persons: Annotated[
        Literal["", "for-robot", "as-for-ur5e"],
        Flag(
            "where persons stand. for-robot (default): scaled by the robot's reach; as-for-ur5e: as for the "
            "UR5e"
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
            "(20,40,60); r2h-batch turn compares them"
        ),
    ] = ""
    hands: Annotated[str, Flag("another hand set: .npz of import hands", "trials")] = ""
    hand_model: Annotated[str, Flag("MANO_RIGHT.pkl, or .npz of import hand")] = ""
    preset: Annotated[PresetName, Flag(_PRESET_HELP, "verdict")] = "default"
    sim: Annotated[
        EngineWord,
        Flag(
            "engine that moves the arm; auto: mujoco on a CPU, mjwarp on CUDA, none with preset release",
            "verdict",
        ),
    ] = "auto"
    out: Annotated[
        str, Flag("run folder; the same command continues it; default: runs/DATE-TIME", "output")
    ] = ""
    format: Annotated[
        Literal["md", "latex", "csv", "json"], Flag("format of the table", "output")
    ] = "md"
    save_paths: Annotated[
        bool, Flag("store waypoints, goals, grasps and witnesses, for r2h-batch scene", "output")
    ] = False
    quiet: Annotated[bool, Flag("print only errors on stderr", "output")] = False
    device: Annotated[str, Flag("cpu, cuda or cuda:N", "work")] = "cpu"
    threads: Annotated[int | None, Flag("CPU threads; default: all cores", "work")] = None
    shard: Annotated[str, Flag("I/N: part I of N, for job arrays with one --out", "work")] = "1/1"
    shard_trials: Annotated[int, Flag("trials of a shard; 0: a minute of work")] = 0
    engine: Annotated[Literal["local", "ray"], Flag("this process, or a Ray cluster", "work")] = (
        "local"
    )
    address: Annotated[str, Flag("Ray cluster to join: auto or HOST:PORT")] = ""
    replan: Annotated[
        bool, Flag("with trials_from: plan every motion anew instead of judging that of the file")
    ] = False
    predictor: Annotated[
        str,
        Flag(
            "contact network of method contact: .onnx, VoxNet weights as .safetensors, or "
            "package.module:function or FILE.py:function; default: the built-in VoxNet"
        ),
    ] = ""
    trust_code: Annotated[
        bool,
        Flag(
            "also accept a TorchScript file as predictor; such a program can write any file. A --config file "
            "cannot set this: use --trust-code"
        ),
    ] = False
    predictor_noise: Annotated[
        float, Flag("factor on the error model of what the methods see; 0: they see the truth")
    ] = 1.0
    predicted_hands: Annotated[
        str,
        Flag(
            "hands of your own network instead of the error model, .npz; fc, handover-va, contact and intent "
            "see them"
        ),
    ] = ""
    predicted_parts: Annotated[
        str, Flag("part labels or affordances of your own network; handover-va sees them")
    ] = ""
    predicted_contacts: Annotated[
        str, Flag("contact probabilities of your own network; contact sees them")
    ] = ""
    hand_errors: Annotated[
        Literal["preset", "normal", "frames", "tails"],
        Flag(
            "error model of the target hand. normal: no outliers; frames: errors of published estimators in "
            "single frames; tails: both; preset: normal, with preset paper tails"
        ),
    ] = "preset"
    candidates: Annotated[
        Literal["preset", "filtered", "as-generated", "narrow"],
        Flag(
            "grasps that methods choose from. filtered: those that this gripper can hold; as-generated: all "
            "that the sampler proposes; narrow: those across which the whole object fits; preset: filtered, "
            "with preset paper as-generated, with preset release narrow"
        ),
    ] = "preset"
    width: Annotated[
        Literal["preset", "pads", "whole"],
        Flag(
            "Stability measures the material between the pads, or the whole object's extent along the closing "
            "axis; preset: pads, with preset release whole"
        ),
    ] = "preset"
    reach: Annotated[
        Literal["preset", "solid", "hull"],
        Flag(
            "Reach measures the object, or its convex hull; preset: solid, with preset release hull"
        ),
    ] = "preset"
    stability: Annotated[
        Literal["geometric", "physics"],
        Flag(
            "physics: friction must also hold the object against its weight and a shake along three axes"
        ),
    ] = "geometric"
    object_collision: Annotated[
        Literal["preset", "hull", "pieces"],
        Flag(
            "the attached object in planning: its convex hull (as in the paper), or its convex decomposition; "
            "preset: hull, with preset release pieces where trials_from has boxes as objects"
        ),
    ] = "preset"
    edge_check: Annotated[
        Literal["preset", "exact", "moveit"],
        Flag(
            "edges of a path: certified, or sampled at MoveIt's resolution; preset: exact, with preset paper moveit"
        ),
    ] = "preset"
    plan_hand: Annotated[
        Literal["preset", "true", "estimated"],
        Flag(
            "hand that planned paths avoid: the true hand, or the estimated hand that methods see. Safe "
            "judges the true hand. preset: true, with preset paper estimated"
        ),
    ] = "preset"
    ik: Annotated[
        Literal["fused", "pytorch-kinematics"],
        Flag("inverse kinematics: a Warp kernel, or pytorch-kinematics (slower)"),
    ] = "fused"
    sim_model: Annotated[
        Literal["auto", "scene", "arm"],
        Flag(
            "scene: simulate everything, with contacts; arm: a rigid gripper, no contacts; auto: the arm, and "
            "the scene for each trial in which a contact is possible"
        ),
    ] = "auto"
    execution_error: Annotated[
        str,
        Flag(
            "errors of the executed poses as standard deviations per axis. 5mm,1deg: both the camera's "
            "calibration and the object in the gripper err anew in every trial; camera:5mm,1deg or "
            "object:5mm,1deg: one of both errs; bias:5mm,1deg: one error of the camera for all trials"
        ),
    ] = ""
    robustness: Annotated[
        bool,
        Flag(
            "sweep without and with each of four execution errors, into folders of --out, and print how SR "
            "falls"
        ),
    ] = False
    receiver_motion: Annotated[
        str,
        Flag(
            "also play every handover in closed loop; the receiver's hand: still, moves, reaches, hesitates, "
            "withdraws or takes, with a size such as moves:100mm,20deg; or replay:NAME_motion.npz of import "
            "hands (needs the extra env)"
        ),
    ] = ""
    policy: Annotated[
        str,
        Flag(
            "policy that moves the arm in closed loop: planned, stop, servo, replan, or your "
            "package.module:function, which takes an observation of HandoverEnv"
        ),
    ] = "planned"
    horizon: Annotated[
        float,
        Flag("longest episode of a closed loop, s; slow arms need more"),
    ] = 15.0
    log: Annotated[
        Literal["", "tensorboard", "wandb", "mlflow", "trackio"],
        Flag("also write the table's numbers into a logger, in the run folder (offline)"),
    ] = ""
    no_poses: Annotated[
        bool,
        Flag("do not store the scored poses: saves 51 to 81 bytes a trial; reevaluate needs them"),
    ] = False
    verbose: Annotated[
        bool, Flag("print every step and shard on stderr; log.txt always has them")
    ] = False
    allow_empty_candidates: Annotated[
        bool, Flag("count trials of objects without a grasp as failures of built-in methods")
    ] = False
    allow_missing: Annotated[
        bool, Flag("count trials that a predictions file leaves out as failures")
    ] = False
    chunk: Annotated[int, Flag("trials scored at once; 0: 256 on a CPU, 2048 on a GPU")] = 0
    ray_timeout: Annotated[
        float, Flag("seconds after which a Ray cluster that does not answer counts as lost")
    ] = 30.0
    workers: Annotated[int, Flag("Ray actors; 0: one for each GPU, or for each 4 CPUs")] = 0
    gpus_per_worker: Annotated[float, Flag("GPUs of each actor; 0: 1 with device cuda")] = 0.0

    @property
    def part(self) -> tuple[int, int]:
        """(I, N) of --shard I/N."""
        i, _, n = self.shard.partition("/")
        return int(i), int(n)


def help_text(prog: str) -> str:
    """The flags in groups, each with its meaning."""
    usage = f"usage: {prog} [--config FILE.yaml] [--set NAME=VALUE ...] [FLAGS]"
    lines = [usage, "", str(Options.__doc__)]
    for group in GROUPS:
        lines += ["", f"{group}:", *_described(group, "--")]
    config = (
        ("--config FILE", "a YAML file with any option; a flag wins over it"),
        ("--set NAME=VALUE ...", "any option; `--set help` explains them"),
        ("as flags too", ", ".join(_flag(n) for n, (_, f) in _flags().items() if not f.group)),
    )
    return "\n".join([*lines, "", "more options:", *_columns(config)]) + "\n"


def set_help() -> str:
    """The options that the help lists by name alone, each with its meaning."""
    head = "Options for --set NAME=VALUE. A --config file takes these and the flags by name:"
    return "\n".join([head, "", *_described("", "")]) + "\n"


def _flags() -> dict[str, tuple[Any, Flag]]:
    """Name of an option -> its type and what the help says of it."""
    hints = typing.get_type_hints(Options, include_extras=True)
    return {name: (hint.__origin__, hint.__metadata__[0]) for name, hint in hints.items()}


def _flag(name: str) -> str:
    """An option as a flag."""
    return f"--{name.replace('_', '-')}"


def _described(group: str, dashes: str) -> list[str]:
    """The lines of a group of options."""
    rows = []
    for name, (kind, flag) in _flags().items():
        if flag.group != group:
            continue
        more = ""
        if get_origin(kind) is tuple:
            kind, more = get_args(kind)[0], " ..."
        if get_origin(kind) is Literal:
            value = "|".join(v for v in get_args(kind) if v)
        else:
            value = {bool: "", str: "TEXT", float: "NUMBER"}.get(kind, "INT")
        shown = name.replace("_", "-") if dashes else name
        rows.append((f"{dashes}{shown} {value}{more}".rstrip(), flag.help + _default(name, flag)))
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
        "robustness",
        ("execution_error", "motions", "trials_from"),
        "sweeps its own execution errors",
    ),
    (
        "receiver_motion",
        ("motions", "trials_from", "execution_error", "robustness"),
        "plays handovers from poses without errors",
    ),
    (
        "execution_error",
        ("motions", "trials_from"),
        "changes poses, and motions are judged as they are",
    ),
)
"""Options that exclude others, and why."""


def check(options: Options) -> Options:
    """The options, or a `UsageError` about the first that cannot be."""
    if not (options.method or options.predictions or options.motions or options.trials_from):
        flags = "--predictions FILE, --motions FILE or --trials-from FILE"
        raise UsageError(f"nothing to score: give --method {' '.join(METHOD_NAMES)}, {flags}")
    bases = [base_of(name) for name in options.method]
    for name, base in zip(options.method, bases, strict=True):
        if base not in METHOD_NAMES and ":" not in base:
            _check_installed(base)
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
    if options.execution_error:
        execution_error(options.execution_error)
    for name, others, why in EXCLUDED:
        for other in others if getattr(options, name) else ():
            if getattr(options, other):
                raise UsageError(f"{_flag(name)} {why}; leave {_flag(other)} out")
    if options.robustness and options.format == "latex":
        raise UsageError("--robustness writes --format md, csv or json, not latex")
    if options.policy != Options.policy and not options.receiver_motion:
        words = "add --receiver-motion, such as moves or still"
        raise UsageError(f"--policy moves the arm in closed loop; {words}")
    if options.horizon != Options.horizon and not options.receiver_motion:
        raise UsageError("--horizon is of a closed loop; add --receiver-motion, such as moves")
    command_line.check_range("--horizon", options.horizon, 1, 600)
    if options.predictor and "contact" not in bases:
        words = "add that method, or leave it out"
        raise UsageError(f"--predictor is the contact network of --method contact; {words}")
    for name, users in SEEN_BY.items():
        if getattr(options, name) and not any(m in users or ":" in m for m in bases):
            words = f"is seen by --method {', '.join(users)}; add one, or leave it out"
            raise UsageError(f"{_flag(name)} {words}")
    estimated = {"estimated": True, "true": False, "preset": options.preset == "paper"}
    if options.predicted_hands and estimated[options.plan_hand]:
        words = "paths are planned against the error model's hand or the true one"
        raise UsageError(f"--predicted-hands: {words}; add --plan-hand true")
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


def execution_error(text: str, seed: int = 0) -> "ExecutionError":
    """The errors that the option says; empty: none."""
    from r2h_batch.config import ExecutionError

    if not text:
        return ExecutionError()
    number = r"(\d+\.?\d*|\.\d+)"
    found = re.fullmatch(rf"(?:(camera|object|bias):)?{number}mm,{number}deg", text, re.ASCII)
    if not found:
        allowed = "5mm,1deg or camera:5mm,1deg, object:5mm,1deg, bias:5mm,1deg"
        raise UsageError(f"--execution-error is {text!r}; it must be such as {allowed}")
    part, size, none = found[1], (float(found[2]) / 1000, float(found[3])), (0.0, 0.0)
    camera = none if part == "object" else size
    held = none if part in ("camera", "bias") else size
    drawn: Literal["trial", "run"] = "run" if part == "bias" else "trial"
    try:
        error = ExecutionError(*camera, drawn, *held, seed)
        return error if error.any else ExecutionError()
    except ValueError as error:
        raise UsageError(f"--execution-error: {error}") from None


def parse(arguments: Sequence[str], *, prog: str = "python -m r2h_batch.sweep") -> Options:
    """The checked options of a command line.

    Raises:
        UsageError: one line about the first option that cannot be.
        SystemExit: the help is printed.
    """
    if "--help" in arguments or "-h" in arguments:
        sys.stdout.write(help_text(prog))
        raise SystemExit(0)
    arguments, path, chosen = _without_config(arguments)
    default = replace(Options() if path is None else load_config(Path(path)), **chosen)
    more = ["--config", "--set"]
    options: Options = command_line.parse(
        Options, arguments, prog=prog, default=default, more_flags=more
    )
    return check(options)


def load_config(path: Path) -> Options:
    """Options from a YAML file with the flags' names as fields.

    Raises:
        UsageError: a field is unknown or of another type; the message names it.
    """
    import pydantic

    from r2h_batch.base.io.read import read_yaml
    from r2h_batch.base.validate import rule_of

    try:
        data = read_yaml(path)
        _check_names(str(path), "field", data)
        if data.get("trust_code"):  # the file may come from whoever made the network
            words = "trust_code is not an option of a file"
            raise UsageError(f"{path}: {words}; add the flag --trust-code")
        text = json.dumps(data, default=str)
        options = pydantic.TypeAdapter(Options).validate_json(text, strict=True)
        return replace(options, **{k: _expanded(v) for k, v in asdict(options).items()})
    except FileError as error:
        raise UsageError(str(error)) from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        found = repr(first["input"])[:80]
        raise UsageError(f"{path}: {where} is {found}; {rule_of(first)}") from None


def _check_names(where: str, kind: str, names: Iterable[Any]) -> None:
    allowed = [f.name for f in fields(Options)]
    for name in names:
        if name not in allowed:
            hint = nearest(str(name), allowed)
            raise UsageError(f"{where}: unknown {kind} {name!r}{hint}; see --set help")


def _expanded(value: Any) -> Any:
    """A value with ~ written out, as in an argument."""
    if isinstance(value, (tuple, list)):
        return tuple(map(_expanded, value))
    return expand_home(value) if isinstance(value, str) else value


def _without_config(arguments: Sequence[str]) -> tuple[list[str], str | None, dict[str, Any]]:
    """The command line with each `--set NAME=VALUE` as a flag, without `--config FILE`; FILE; and
    what --set says of options that are true or false."""
    rest, path = list(arguments), None
    flags: list[str] = []
    chosen: dict[str, Any] = {}
    switches = [name for name, (kind, _) in _flags().items() if kind is bool]
    while rest:
        argument = rest.pop(0)
        name, equals, value = argument.partition("=")
        if name not in ("--config", "--set"):
            flags.append(argument)
            continue
        value = value if equals else rest.pop(0) if rest else ""
        if name == "--config":
            if not value:
                raise UsageError("--config names no file")
            path = value
            continue
        if value == "help":
            sys.stdout.write(set_help())
            raise SystemExit(0)
        settings = [value]
        while rest and not rest[0].startswith("-"):
            settings.append(rest.pop(0))
        for setting in settings:
            option, equals, value = setting.partition("=")
            if not equals:
                raise UsageError(
                    f"--set is {setting!r}; it must be NAME=VALUE, and `--set help` has them"
                )
            _check_names("--set", "option", [option])
            if option not in switches:
                flags.append(f"--{option.replace('_', '-')}={value}")
            elif value in ("true", "false"):
                chosen[option] = value == "true"
            else:
                raise UsageError(f"--set {option} is {value!r}; allowed are true, false")
    return flags, path, chosen


GIVEN = ("trials", "scene", "seed", "evaluator", "noise", "predictor", "seen", "instructions")
"""Arguments of a method that the sweep passes; its other keyword arguments are its options:
`--method contact,gate=ik`."""


def _check_installed(name: str) -> None:
    """That a package gives this method; `spelled_out` says where."""
    try:
        known = tuple(METHODS)
        if name in known and METHODS.outside(name):
            return
    except PluginError as error:
        raise UsageError(f"--method {name}: {error}") from error
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
