"""The options of a sweep, from flags and from a YAML file, checked. Imports nothing heavy."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from r2h_batch.command_line import UsageError, nearest, read
from r2h_batch.io.read import FileError
from r2h_batch.sweep.variants import base_of
from r2h_batch.validate import expand_home

__all__ = ["KINDS", "METHODS", "Options", "UsageError", "as_yaml", "check", "load_config", "parse"]

METHODS = ("random", "oracle", "fc", "handover-va", "contact", "intent")
"""Built-in methods: modules of `r2h_batch.methods` (- as _) with a `predict(trials, scene, *,
seed)`, which may also take `evaluator`, `noise`, `predictor` (sweep/jobs.py)."""

SEEN_BY = {
    "predicted_hands": ("fc", "handover-va", "contact", "intent"),
    "predicted_parts": ("handover-va",),
    "predicted_contacts": ("contact",),
}
"""Files of networks' answers -> the methods that are shown them."""

KINDS = ("details", "poses", "paths")
"""What is stored beside the trials when asked for."""

MOST = 10**12
"""Of anything that is counted: a number beyond is a slip, and would be refused much later by
something else."""


@dataclass(frozen=True)
class Options:
    """Score handover methods on the benchmark's trials and print Table I."""

    method: tuple[str, ...] = ()
    """Methods to score: fc, handover-va, contact, intent, random, oracle, or your own
    package.module:function (trials, scene, *, seed) -> Predictions. With options of its own:
    contact,gate=ik (docs/baselines.md lists them)."""
    predictions: tuple[str, ...] = ()
    """Predictions files (.npz, .safetensors, .csv or .json) to score."""
    splits: tuple[Literal["S0", "S1"], ...] = ("S0", "S1")
    """S0 free handover, S1 functional."""
    trials: int = 500
    """Trials of each split."""
    protocol: Literal["", "r2h-v0", "r2h-v1"] = ""
    """How trials are drawn. r2h-v0 (unless the benchmark file says otherwise): hands alone, any
    roll. r2h-v1: hands on the arms of people who reach for the object."""
    receiver: Literal["", "hand", "body"] = ""
    """What planning and Safe see of the receiver. hand (unless the benchmark file says otherwise),
    as the paper; contact with the arm is stored beside Safe (body_m). body, with --protocol r2h-v1:
    forearm, upper arm and torso too."""
    device: str = "cpu"
    """cpu, cuda or cuda:N."""
    out: str = ""
    """Run folder; runs/DATE-TIME unless given. The same command again goes on where the last one
    stopped."""
    force_new: bool = False
    """If --out holds another run, write to OUT-2, OUT-3, ... instead."""
    seed: int = 0
    """Seed of the methods; the trials do not depend on it."""
    predictor: str = ""
    """Your own contact network for --method contact: a TorchScript file, VoxNet weights as
    .safetensors, or package.module:function; the built-in VoxNet unless given."""
    predicted_hands: str = ""
    """Your own networks' hands, .npz or .safetensors, instead of the error model: what fc,
    handover-va, contact, intent see."""
    predicted_parts: str = ""
    """Your own network's part labels or affordances of the objects' points: what handover-va
    sees."""
    predicted_contacts: str = ""
    """Your own network's contact probabilities of the objects' points: what contact sees."""
    predictor_noise: float = 1.0
    """Factor on the error model of what the methods see (hands, part labels); 0: they see the
    truth."""
    hand_errors: Literal["preset", "normal", "frames", "tails"] = "preset"
    """Error model of the target hand. normal: no outliers. frames: what published estimators were
    off by in single frames. tails: both. preset: normal, with --preset paper tails."""
    candidates: Literal["preset", "filtered", "as-generated"] = "preset"
    """Grasps that methods choose from. filtered: those that this evaluator's own gripper can hold.
    as-generated: whatever the sampler proposes, so that methods can fail Stability. preset:
    filtered, with --preset paper as-generated."""
    benchmark: str = ""
    """Your own benchmark, a YAML file: objects, hands, grasps, thresholds, table and home;
    r2h-batch benchmark show."""
    hands: str = ""
    """Another hand set, an .npz of r2h-batch import hands."""
    hand_model: str = ""
    """Another hand, MANO_RIGHT.pkl or an .npz of r2h-batch import hand: whoever uses a hand takes
    this one."""
    objects: str = ""
    """Other objects instead of the benchmark's: a folder of meshes (NAME.yaml beside a mesh says
    its split, parts, region), or a benchmark.yaml."""
    object_mesh: tuple[str, ...] = ()
    """Your own objects, FILE[:S0|S1[:REGION]]: they take turns with the other objects of that
    split. REGION, what the receiver wants: a part's name, a plane such as z<0.3, or an .npy of the
    file's faces (docs/your_data.md)."""
    grasps: tuple[str, ...] = ()
    """Grasp candidates of your own: NAME=FILE, a file called as its object, or a folder of these.
    .npz or .safetensors, .h5 (ACRONYM), .npy (GraspNet), FILE.yaml:GRIPPER (isaac_grasp);
    docs/your_data.md."""
    trials_file: str = ""
    """Trials of your own, .npz or .parquet, instead of the protocol's: object, T_world_hand, and
    hand or pose, shape, side."""
    preset: Literal["default", "paper"] = "default"
    """default: exact planning to any branch. paper: one goal, MoveIt's edge resolution, to compare
    with the paper."""
    width: Literal["pads", "whole"] = "pads"
    """Stability measures the material between the pads, or the whole object's extent along the
    closing axis."""
    stability: Literal["geometric", "physics"] = "geometric"
    """physics: the object must also stay in a friction grasp through its weight and a shake along
    three axes."""
    object_collision: Literal["hull", "pieces"] = "hull"
    """The attached object in planning: its convex hull (as in the paper), or its convex
    decomposition."""
    edge_check: Literal["preset", "exact", "moveit"] = "preset"
    """Path edges: as the preset says, certified, or sampled at MoveIt's resolution."""
    plan_hand: Literal["preset", "true", "estimated"] = "preset"
    """Which hand paths keep clear of: the true one, or the one that the methods see (judged is
    always the true one). preset: true, with --preset paper estimated."""
    ik: Literal["fused", "pytorch-kinematics"] = "fused"
    """Who finds joint angles: a Warp kernel, or pytorch-kinematics' batched Jacobian (slower; the
    same verdicts)."""
    sim: Literal["auto", "none", "mujoco", "mjwarp"] = "auto"
    """Who moves the arm: MuJoCo C, MuJoCo-Warp, nobody (the motion as planned); auto: mujoco on a
    CPU, mjwarp on CUDA."""
    sim_model: Literal["auto", "scene", "arm"] = "auto"
    """What is simulated. scene: everything, with contacts. arm: a rigid gripper, no contacts. auto:
    the arm, and the whole scene again for each trial in which a contact is not ruled out."""
    format: Literal["md", "latex", "csv", "json"] = "md"
    """Format of the table on stdout."""
    save_details: bool = False
    """Also store joint goal, opening, shift and witness of every trial."""
    no_poses: bool = False
    """Do not store the two poses that were scored: 51 to 81 bytes a trial less, and nobody can
    judge the rows again."""
    save_poses: bool = False
    """Store the poses, as is the default: for command lines from before it was. Not with
    --no-poses."""
    save_paths: bool = False
    """Also store waypoints and times of every trial, its details and its poses: all that
    r2h_batch.scene needs."""
    quiet: bool = False
    """Say nothing on stderr but what went wrong, whatever --verbose says."""
    verbose: bool = False
    """Say more on stderr: what is made ready, and every shard. log.txt in the run folder has it
    always."""
    threads: int | None = None
    """CPU threads; all cores unless given."""
    allow_empty_candidates: bool = False
    """Count trials of objects that the gripper can hold nowhere as failures of the built-in methods
    instead of refusing."""
    allow_missing: bool = False
    """Count trials that a predictions file leaves out as failures instead of refusing the file."""
    shard: str = "1/1"
    """I/N: score only part I of N of the shards, for job arrays; every part writes to the same
    --out."""
    shard_trials: int = 0
    """Trials of a shard; 0: 100000 or a minute of work, whichever is smaller."""
    chunk: int = 0
    """Trials scored at once between two looks at the clock; 0: 256 on a CPU, 2048 on a GPU."""
    engine: Literal["local", "ray"] = "local"
    """local: this process. ray: actors of a Ray cluster, one Evaluator each."""
    address: str = ""
    """Ray cluster to join: auto or HOST:PORT; empty: one of its own on this machine, whatever else
    runs there."""
    ray_timeout: float = 30.0
    """Seconds until a Ray cluster that does not answer is given up."""
    workers: int = 0
    """Ray actors; 0: one for each GPU, or one for each 4 CPUs where there is none."""
    gpus_per_worker: float = 0.0
    """GPUs of each actor; 0: 1 with --device cuda."""

    @property
    def stored(self) -> list[str]:
        """What is stored beside the trials; with paths everything, so that any trial can be opened
        elsewhere."""
        asked = {"details": self.save_details, "poses": not self.no_poses, "paths": self.save_paths}
        return [kind for kind in KINDS if self.save_paths or asked[kind]]

    @property
    def part(self) -> tuple[int, int]:
        """(I, N) of --shard I/N."""
        i, _, n = self.shard.partition("/")
        return int(i), int(n)


def check(options: Options) -> Options:
    """The options, or a `UsageError` about the first that cannot be."""
    if not options.method and not options.predictions:
        raise UsageError(
            f"nothing to score: give --method {' '.join(METHODS)} or --predictions FILE"
        )
    bases = [base_of(name) for name in options.method]
    for name in bases:
        if name not in METHODS and ":" not in name:
            raise UsageError(
                f"unknown method {name!r}{nearest(name, METHODS)}; allowed are {', '.join(METHODS)}"
                " or your own package.module:function"
            )
    least = {
        "trials": 1,
        "threads": 1,
        "shard_trials": 0,
        "chunk": 0,
        "workers": 0,
        "gpus_per_worker": 0,
    }
    for name, low in least.items():
        value = getattr(options, name)
        if value is not None and not value >= low:
            raise UsageError(f"--{name.replace('_', '-')} is {value}; it must be {low} or more")
        if value is not None and value > MOST:
            raise UsageError(
                f"--{name.replace('_', '-')} is {str(value)[:40]}; it must be {MOST} or less"
            )
    if not -(1 << 63) <= options.seed < 1 << 63:
        raise UsageError(f"--seed is {str(options.seed)[:40]}; it must fit 64 bits")
    _check_stored(options)
    for name in ("method", "splits", "predictions"):
        given = getattr(options, name)
        if twice := [g for g in given if given.count(g) > 1]:
            raise UsageError(f"--{name} {twice[0]} is given twice; once is enough")
    if not (math.isfinite(options.predictor_noise) and options.predictor_noise >= 0):
        raise UsageError(
            f"--predictor-noise is {options.predictor_noise}; it must be 0 (the truth) or more, 1 is the default"
        )
    if options.predictor and "contact" not in bases:
        raise UsageError(
            "--predictor is the contact network of --method contact; add that method, or leave it out"
        )
    for name, users in SEEN_BY.items():
        if getattr(options, name) and not any(m in users or ":" in m for m in bases):
            raise UsageError(
                f"--{name.replace('_', '-')} is seen by --method {', '.join(users)}; add one, or leave it out"
            )
    if (
        options.predicted_hands
        and (options.plan_hand == "estimated" or options.preset == "paper")
        and options.plan_hand != "true"
    ):
        raise UsageError(
            "--predicted-hands: paths are planned against the error model's hand or the true one; add --plan-hand true"
        )
    if not options.splits:
        raise UsageError("--splits names no split; allowed are S0, S1")
    if options.device not in ("cpu", "cuda") and not (
        options.device.startswith("cuda:")
        and options.device[5:].isascii()
        and options.device[5:].isdigit()
    ):
        raise UsageError(f"--device is {options.device!r}; allowed are cpu, cuda, cuda:N")
    i, slash, n = options.shard.partition("/")
    if not (slash and _count(i) and _count(n) and 1 <= int(i) <= int(n)):
        raise UsageError(
            f"--shard is {options.shard!r}; it must be I/N with I from 1 to N, such as 2/8"
        )
    if options.part[1] > 1 and not options.out:
        raise UsageError("--shard needs --out: all parts write to one folder")
    if not 0 < options.ray_timeout <= 86400:
        raise UsageError(
            f"--ray-timeout is {options.ray_timeout:g}; it must be more than 0 and at most 86400 seconds"
        )
    if options.engine == "local" and (
        options.workers or options.address or options.gpus_per_worker
    ):
        raise UsageError("--workers, --address and --gpus-per-worker belong to --engine ray")
    return options


def _check_stored(options: Options) -> None:
    if options.no_poses and (options.save_poses or options.save_paths):
        why = (
            "--save-poses stores them"
            if options.save_poses
            else "--save-paths stores all that a trial can be opened by"
        )
        raise UsageError(f"--no-poses stores no poses, {why}; leave one of the two out")


def _count(text: str) -> bool:
    """Whether the text is a plain number of at most nine digits (superscripts are digits to Python,
    but no numbers)."""
    return text.isascii() and text.isdigit() and len(text) < 10


def parse(arguments: Sequence[str], *, prog: str = "python -m r2h_batch.sweep") -> Options:
    """The checked options of a command line; raises `UsageError` with one line."""
    arguments, path = _without_config(arguments)
    default = Options() if path is None else load_config(Path(path))
    prog = f"{prog} [--config FILE.yaml]" if "--help" in arguments or "-h" in arguments else prog
    options: Options = read(Options, arguments, prog=prog, default=default, more_flags=["--config"])
    return check(options)


def load_config(path: Path) -> Options:
    """Options from a YAML file with the flags' names as fields; anything unknown or mistyped is
    refused by its path."""
    import pydantic

    try:
        from r2h_batch.io.read import read_yaml
        from r2h_batch.validate import rule_of
    except ImportError:
        raise UsageError("--config needs PyYAML; pip install pyyaml") from None
    try:
        data = read_yaml(path)
    except FileError as error:
        raise UsageError(str(error)) from None
    allowed = [f.name for f in fields(Options)]
    for key in data:
        if key not in allowed:
            raise UsageError(
                f"{path}: unknown field {key!r}{nearest(str(key), allowed)}; allowed are {', '.join(allowed)}"
            )
    config = pydantic.ConfigDict(extra="forbid", strict=True)
    model: Any = pydantic.create_model(
        "Config",
        __config__=config,
        **{f.name: (f.type, f.default) for f in fields(Options)},  # type: ignore[call-overload]
    )
    try:
        checked = model.model_validate_json(json.dumps(data, default=str), strict=True)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise UsageError(
            f"{path}: {where} is {repr(first['input'])[:80]}; {rule_of(first)}"
        ) from None
    return Options(
        **{name: _written_out(path, name, value) for name, value in checked.model_dump().items()}
    )


def _written_out(path: Path, name: str, value: Any) -> Any:
    """A field's value with ~ written out, as in an argument."""
    if isinstance(value, tuple):
        return tuple(_written_out(path, name, v) for v in value)
    if not isinstance(value, str):
        return value
    try:
        return expand_home(value)
    except FileError as error:
        raise UsageError(f"{path}: {name}: {error}") from None


def _without_config(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    """The command line without --config FILE, and FILE."""
    kept, path, rest = [], None, iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        if name != "--config":
            kept.append(argument)
            continue
        path = value if equals else next(rest, "")
        if not path:
            raise UsageError("--config names no file")
    return kept, path


def as_yaml(options: Options) -> str:
    """The options as a file that `load_config` reads back equal."""
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in asdict(options).items())
