"""The words of a command line that choose a benchmark and edit it. Imports nothing heavy."""

import shlex
from dataclasses import asdict, dataclass
from typing import Literal


@dataclass(frozen=True)
class BenchmarkChoice:
    """Which benchmark, in the words of r2h-batch sweep; all empty: the default one."""

    benchmark: str = ""
    """A name of ls benchmarks, your benchmark.yaml, or your function (package.module:function)."""
    hands: str = ""
    """A hand set: .npz of import hands."""
    hand_model: str = ""
    """A hand: MANO_RIGHT.pkl, or .npz of import hand."""
    objects: str = ""
    """Objects in place of the benchmark's: a folder of meshes, a benchmark.yaml, or new ones of families
    (`families:cup,hammer x 20 seed 7`)."""
    object_mesh: tuple[str, ...] = ()
    """More objects, FILE[:S0|S1[:REGION]]."""
    grasps: tuple[str, ...] = ()
    """Your grasp candidates: NAME=FILE, a file, or a folder."""
    trials_file: str = ""
    """Your trials, .npz or .parquet."""
    robot: str = ""
    """A built-in robot, or a folder of import robot."""
    persons: Literal["", "for-robot", "as-for-ur5e"] = ""
    """Where persons stand: scaled by the robot's reach (default), or as for the UR5e."""
    people: str = ""
    """Receivers of every size: adults, children, elderly, all, wheelchair, or your own .csv (import people)."""
    receiver: Literal["", "hand", "body"] = ""
    """Whether planning and Safe see the hand, or the person's arm, torso and head too."""
    until: Literal["", "present", "received"] = ""
    """Where trials of r2h-v3 end: present (nobody is asked to take the object), or received."""
    turn: str = ""
    """Turn the objects' frames: half (180 degrees about z), cycled (x to y, y to z, z to x), or degrees about x, y, z
    (`20,40,60`)."""

    def flags(self) -> list[str]:
        """The flags that are given, as one would type them again: a shell's quotes around what has spaces."""
        given = asdict(self).items()
        return [
            f"--{k.replace('_', '-')} {shlex.join([v] if isinstance(v, str) else v)}"
            for k, v in given
            if v
        ]


def words_of(text: str) -> list[str]:
    """The words of a stored flag; at its spaces where older versions wrote it without quotes."""
    try:
        return shlex.split(text)
    except ValueError:
        return text.split()


DEFAULT = BenchmarkChoice()
