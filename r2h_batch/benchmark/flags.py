"""The flags that choose a benchmark. Imports nothing heavy."""

from dataclasses import asdict, dataclass

__all__ = ["BUILT_IN", "BenchmarkFlags"]


@dataclass(frozen=True)
class BenchmarkFlags:
    """Which benchmark, in the words of r2h-batch sweep; all empty: the built-in one."""

    benchmark: str = ""
    """A benchmark file."""
    hands: str = ""
    """A hand set."""
    hand_model: str = ""
    """A hand."""
    objects: str = ""
    """Folder of meshes or benchmark.yaml whose objects take the benchmark's place."""
    object_mesh: tuple[str, ...] = ()
    """The user's own objects, FILE[:S0|S1[:REGION]]."""
    grasps: tuple[str, ...] = ()
    """Grasp candidates of one's own."""
    trials_file: str = ""
    """Trials of one's own."""

    def flags(self) -> list[str]:
        """The flags that are given, as one would type them again."""
        said = asdict(self).items()
        return [
            f"--{k.replace('_', '-')} {v if isinstance(v, str) else ' '.join(v)}"
            for k, v in said
            if v
        ]


BUILT_IN = BenchmarkFlags()
