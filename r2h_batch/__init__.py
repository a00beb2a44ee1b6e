"""Verdicts on robot-to-human handovers, by the thousand: the R2HandoverSim benchmark as a batched
evaluator."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r2h_batch.config import EvalConfig
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.scene.scene import Scene
    from r2h_batch.training import reward
    from r2h_batch.trials.protocol import make_trials
    from r2h_batch.types import CRITERIA, Outcome, PlanReason, Predictions, Scores, Trials
    from r2h_batch.view.page import show

if os.environ.get("MUJOCO_GL", "").lower() == "osmesa":
    # MuJoCo loads OSMesa's LLVM; where triton (it comes with torch for CUDA) is loaded after that,
    # the process ends with signal 11, as soon as a program makes an optimizer. The other order
    # works.
    with suppress(ImportError):
        import triton  # noqa: F401

__version__ = "0.2.0"

__all__ = [
    "CRITERIA",
    "EvalConfig",
    "Evaluator",
    "Outcome",
    "PlanReason",
    "Predictions",
    "Scene",
    "Scores",
    "Trials",
    "make_trials",
    "reward",
    "show",
]

_root = Path(__file__).resolve().parent
# a checkout or an editable install: kernels/ and assets/ stand beside the package
if not (_root / "kernels").exists():
    __path__.append(str(_root.parent))


def lazy_names(
    package: str, home: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that offers names of its modules: imported when
    first used.

    `--help` must not wait for torch and Warp. `home`: public name -> module, relative to the
    package; a module's own name stands for the module. Type checkers read the imports that stand
    under TYPE_CHECKING in the same file.
    """

    def find(name: str) -> object:
        if name not in home:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}; it has {', '.join(sorted(home))}"
            )
        module = import_module(f".{home[name]}", package)
        return module if home[name].rpartition(".")[2] == name else getattr(module, name)

    return find, lambda: sorted(home)


if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "CRITERIA": "verdicts",
            "EvalConfig": "config",
            "Evaluator": "evaluate",
            "Outcome": "verdicts",
            "PlanReason": "verdicts",
            "Predictions": "types",
            "Scene": "scene.scene",
            "Scores": "types",
            "Trials": "types",
            "make_trials": "trials.protocol",
            "reward": "training.reward",
            "show": "view.page",
        },
    )
