"""The sight of a run's methods, as one text: `cell-v1,noise=0.5,model=known`."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

from jaxtyping import Float32
from torch import Tensor

from r2h_batch.base.errors import UsageError, nearest
from r2h_batch.base.io.read import printable
from r2h_batch.observe.known import known_moments
from r2h_batch.observe.moment import moments
from r2h_batch.observe.rig import RIGS, Rig, load_rig
from r2h_batch.observe.seeing import Level, Region, look
from r2h_batch.observe.seen import Observation
from r2h_batch.observe.sensor import MASKS, MOST_NOISE, Masks
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

if TYPE_CHECKING:
    from r2h_batch.trials.benchmark import Benchmark

MOST_SEED = 10**12
FORM = (
    "--sees is RIG[,noise=0..5][,labels=exact|eroded|grown|missed][,model=unknown|known][,object=lab|field|rgb|none]"
    "[,region=hidden|told][,seed=N]"
)


@dataclass(frozen=True)
class Sees:
    """Cameras and errors that methods of a run see by.

    Attributes:
        rig: the cameras.
        noise: factor on the errors of the sensor, of the hand's estimate and of the object's.
        labels: errors of masks.
        model: None: objects are not known; else the level of their poses' error.
        seed: of errors, and of moments where the benchmark has none of its own.
        region: whether the receiver's region is told.
        plans: whether arms are planned in what is seen, too: where a benchmark asks for Pick.
    """

    rig: Rig
    noise: float = 1.0
    labels: Masks = "exact"
    model: Level | None = None
    seed: int = 0
    region: Region = "hidden"
    plans: bool = False

    @classmethod
    def parse(cls, text: str) -> "Sees":
        """Read a text.

        Args:
            text: a rig (name or TOML file), then options.

        Raises:
            UsageError: one line about the first part that cannot be.
            FileError: one line about the rig's file.
        """
        name, *parts = (x.strip() for x in text.split(","))
        given: dict[str, str] = {}
        allowed = {
            "noise": (),
            "labels": MASKS,
            "model": ("unknown", "known"),
            "object": get_args(Level),
            "region": get_args(Region),
            "seed": (),
        }
        for part in parts:
            option, _, value = (x.strip() for x in part.partition("="))
            if option not in allowed:
                hint = nearest(option, list(allowed))
                raise UsageError(f"--sees: unknown option {option!r}{hint}; {FORM}")
            if option in given:
                raise UsageError(f"--sees: {option} is given twice; once is enough")
            if (words := allowed[option]) and value not in words:
                hint = nearest(value, words)
                raise UsageError(
                    f"--sees: {option} is {value!r}{hint}; allowed are {', '.join(words)}"
                )
            given[option] = value
        if "object" in given and given.get("model") != "known":
            raise UsageError(
                "--sees: object= is the error of a known object's pose; add model=known, or leave it out"
            )
        noise = _number("noise", given.get("noise", "1"), MOST_NOISE)
        seed = _number("seed", given.get("seed", "0"), MOST_SEED)
        if seed != int(seed):
            raise UsageError(f"--sees: seed is {given['seed']!r}; it must be a whole number")
        model: Any = given.get("object", "lab") if given.get("model") == "known" else None
        labels: Any = given.get("labels", "exact")
        region: Any = given.get("region", "hidden")
        return cls(load_rig(name), noise, labels, model, int(seed), region)

    @property
    def identity(self) -> dict[str, Any]:
        """All that decides the images and estimates, for run.json. A hidden region is not named: runs of before had no other."""
        told = {"region": self.region} if self.region != "hidden" else {}
        return {
            "rig": self.rig.name,
            "rig_digest": self.rig.digest,
            "noise": self.noise,
            "labels": self.labels,
            "object": self.model or "unknown",
            "seed": self.seed,
            **told,
            **({"plans": "seen"} if self.plans else {}),
        }

    @property
    def digest(self) -> str:
        """sha256 (hex) of the identity."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    def on(self, benchmark: "Benchmark") -> "Sees":
        """The same sight, by which arms are planned too where the benchmark asks for Pick.

        Args:
            benchmark: whose trials are seen.
        """
        return replace(self, plans="pick" in benchmark.asks)

    @classmethod
    def planning(cls, header: Mapping[str, Any]) -> "Sees | None":
        """The sight by which a run's arms were planned; None: planning knew the truth.

        Args:
            header: run.json.

        Raises:
            UsageError: one line: the cameras are in a file of the user's, which is not opened.
        """
        said = header.get("sees")
        if not isinstance(said, dict) or said.get("plans") != "seen":
            return None
        found = cls.of_run(header)
        if found is None:
            raise UsageError(
                f"its arms were planned by what the rig {printable(said.get('rig'))} saw, a file that is not opened again;"
                f" only runs of {', '.join(RIGS)} can be judged again"
            )
        return found

    @classmethod
    def of_run(cls, header: Mapping[str, Any]) -> "Sees | None":
        """The sight of a run's methods; None where they were told the truth, or where the cameras are no built-in rig: a folder
        may come from anybody, so files that it names are not opened.

        Args:
            header: run.json.

        Raises:
            UsageError: one line about the first word that cannot be.
        """
        said = header.get("sees")
        if not isinstance(said, dict) or said.get("rig") not in RIGS:
            return None
        words = {k: said.get(k) for k in ("noise", "labels", "region", "seed")}
        if said.get("object", "unknown") != "unknown":
            words |= {"model": "known", "object": said["object"]}
        options = (f"{k}={v}" for k, v in words.items() if v is not None)
        found = cls.parse(",".join([said["rig"], *options]))
        found = replace(found, plans=said.get("plans") == "seen")
        return found if found.rig.digest == said.get("rig_digest") else None

    def look(self, scene: Scene, trials: Trials) -> tuple[Observation, Float32[Tensor, "n 4 4"]]:
        """Look at N trials: what is seen, and where their objects lie in truth (T_world_obj, m).

        Args:
            scene: what is seen.
            trials: N trials.
        """
        # where a benchmark asks for Pick, its own moment is what is seen
        asks = "pick" in scene.benchmark.asks
        T_world_obj = (
            known_moments(scene).of(trials) if asks else moments(scene, trials, seed=self.seed)
        )
        seen = look(
            scene, trials, self.rig, T_world_obj,
            seed=self.seed, noise=self.noise, labels=self.labels, model=self.model, region=self.region,
        )  # fmt: skip
        return seen, T_world_obj


def _number(option: str, text: str, most: float) -> float:
    """A number from 0 to `most`."""
    try:
        found = float(text)
    except ValueError:
        found = -1.0
    if not 0 <= found <= most:
        raise UsageError(f"--sees: {option} is {text!r}; it must be a number from 0 to {most:g}")
    return found
