"""Names that a command line takes: benchmarks, presets, engines, methods and questions about stored rows, each an entry here
and a function in its folder. Light.

Criteria are entries of `verdicts.REGISTRY`, policies of `closed_loop.policies.POLICIES`, families of
`scene.families.family.FAMILIES`, robots of `scene.robot_file.ROBOTS`.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from r2h_batch.plugins import Registry


class NamedBenchmark(NamedTuple):
    """A named benchmark. `trials/NAME.py` (- as _) has the function that makes it, of the same name."""

    name: str
    help: str  # of --benchmark
    about: str  # for `ls benchmarks`


RELEASE = "r2h-release"
BENCHMARKS = (
    NamedBenchmark("r2h-v0", "hands alone", "hands alone, any roll about the palm's normal"),
    NamedBenchmark(
        "r2h-v1",
        "hands of people who reach",
        "hands on the arms of people who stand and reach",
    ),
    NamedBenchmark(
        "r2h-v2",
        "96 objects of 16 families, people of every size",
        "as r2h-v1, with six instances of each of 16 object families, and 2,000 people from 6 to 90 years",
    ),
    NamedBenchmark(
        "r2h-v3",
        "as r2h-v2, from the table into the person's hand",
        "as r2h-v2, and the arm picks the object from the table first, and the person must be able to take it",
    ),
    NamedBenchmark(
        RELEASE,
        "palms, objects and table of the authors' release",
        "palms, objects, table and home of the authors' release",
    ),
)
DEFAULT_BENCHMARK = "r2h-v2"
BENCHMARK_NAMES = tuple(entry.name for entry in BENCHMARKS)
LISTED, FOREIGN = "listed", "r2handoversim"
"""In place of a rule: trials of a file; the verdicts of the authors' release, by its own definitions."""

BEFORE = {"r2h-v3-draft": "r2h-v3"}
"""The name of a benchmark in older run folders -> its name."""


def protocol_of(header: Mapping[str, Any]) -> str:
    """The source of a run's trials by its run.json, a benchmark by the name that it has today."""
    said = header["protocol"]
    return BEFORE.get(said, said)


def benchmark_in_words(name: str) -> str:
    """A benchmark's name as text says it."""
    return {LISTED: "trials of a file", FOREIGN: "the release's own verdicts"}.get(name, name)


def is_drawn(header: Mapping[str, Any]) -> bool:
    """Whether a rule drew the trials of a run, by its run.json: of any number of them, the first ones are the same."""
    protocol = protocol_of(header)
    told = {"objects", "hand_set"} <= header["digests"].keys() or protocol in BENCHMARK_NAMES
    return told and protocol not in (LISTED, FOREIGN)


class Preset(NamedTuple):
    """A named configuration. `config.py` has its function, in `MADE_BY`."""

    name: str
    help: str


PRESETS = (
    Preset("default", "certified planning to any IK branch"),
    Preset("paper", "one goal, sampled edges, as in the paper"),
    Preset("release", "the rules of the authors' release"),
)
PRESET_NAMES = tuple(entry.name for entry in PRESETS)


class Engine(NamedTuple):
    """A simulator. `judge/motion/sim_NAME.py` has its `simulate`."""

    name: str
    packages: tuple[str, ...]  # whose versions can change its motions


ENGINES = (
    Engine("mujoco", ("mujoco",)),
    Engine("mjwarp", ("mujoco-warp", "warp-lang")),
)
ENGINE_NAMES = tuple(entry.name for entry in ENGINES)


class Method(NamedTuple):
    """A built-in method. `methods/NAME.py` (- as _) has its `predict(trials, scene, *, seed)`, which may
    also take `evaluator`, `noise`, `predictor` and `seen`."""

    name: str
    sees: tuple[str, ...] = ()  # fields of `predictors.Observations` that it is shown
    files: tuple[str, ...] = ()  # options that name a file of the user's


_OURS = (
    Method("random"),
    Method("oracle"),
    Method("fc", ("receiving", "target")),
    Method("handover-va", ("parts", "target")),
    Method("contact", ("receiving", "target", "contacts")),
    Method("intent", ("receiving", "target")),
    Method("learned", ("parts", "target"), ("weights",)),
    Method("robust"),
)
METHOD_NAMES = tuple(entry.name for entry in _OURS)


def _no_function(name: str, thing: Any) -> str:
    ours = isinstance(thing, Method) or callable(thing)
    return "" if ours else f"is {thing!r:.100}; it must be a function"


METHODS: Registry[Any] = Registry(
    "method", {entry.name: entry for entry in _OURS}, wrong=_no_function
)
"""Built-in methods' entries, and functions that packages name as `method.NAME`."""

READS = {
    "scene": "exact meshes, the receiver's region, the true table of grasps, the hand as it stands",
    "estimates": "estimates of hand, parts or contacts; meshes and the table of grasps are exact",
    "cloud": "points on object and hand; no mesh, no region, no table of grasps",
    "cameras": "what depth cameras see (--sees)",
    "judge": "the evaluator that judges it",
}
"""What a method may read, as tables, run folders and files of answers say it."""
NOT_SAID = "not said"
"""In tables, of answers whose file does not say it."""


def _no_question(name: str, thing: Any) -> str:
    fields: dict[str, Any] = {"name": str, "version": int, "function": Callable, "schema": object}
    right = all(isinstance(getattr(thing, field, None), kind) for field, kind in fields.items())
    return (
        ""
        if right and thing.name == name
        else f"is {thing!r:.100}; it must be a Question of that name"
    )


QUESTIONS: Registry[Any] = Registry(
    "question", names=("reception",), light=True, wrong=_no_question
)
"""Questions about stored rows (`sweep.results.questions.Question`) whose answers lie beside the shards, in RUN/NAME: ours add
themselves when `sweep/results/NAME.py` is imported, and packages name theirs as `question.NAME`."""

TURNS = ("half", "cycled")
"""Turns of the objects' frames that a turn test makes: by 180 degrees about z; x to y, y to z, z to x.
`trials/edit.py` has them."""

if TYPE_CHECKING:
    PresetName: TypeAlias = str
    EngineName: TypeAlias = str
    EngineWord: TypeAlias = str
else:  # in a checked field: one of the names; a word may also be empty, or leave the choice open
    PresetName = Literal[PRESET_NAMES]
    EngineName = Literal[("none", *ENGINE_NAMES)]
    EngineWord = Literal[("auto", "none", *ENGINE_NAMES)]
