"""Verdicts on robot-to-human handovers, by the thousand: the R2HandoverSim benchmark as a batched
evaluator."""

import os
from contextlib import suppress
from typing import TYPE_CHECKING

from r2h_batch.base.imported import if_it_fails, when_imported
from r2h_batch.base.opengl import CONTEXT, unbind
from r2h_batch.base.package import FOLDERS, VERSION, lazy_names

if TYPE_CHECKING:
    from r2h_batch.config import EvalConfig
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.scene.scene import Scene
    from r2h_batch.training import reward
    from r2h_batch.trials.benchmark import Benchmark
    from r2h_batch.trials.load import load_benchmark
    from r2h_batch.types import CRITERIA, Outcome, PlanReason, Predictions, Scores, Trials
    from r2h_batch.view.page import show

if os.environ.get("MUJOCO_GL", "").lower() == "osmesa":
    # MuJoCo loads OSMesa's LLVM; where triton (it comes with torch for CUDA) is loaded after that,
    # the process ends with signal 11, as soon as a program makes an optimizer. The other order
    # works.
    with suppress(ImportError):
        import triton  # noqa: F401


def _register() -> None:
    from r2h_batch.closed_loop.registered import register

    register()


when_imported("gymnasium", _register)  # a second to import, so who did not is not made to wait

# MuJoCo binds OpenGL when it is imported; without the library, or with a misspelt MUJOCO_GL, it would
# not be imported at all. What draws nothing needs none of it, and `scene.offscreen` looks for one that works.
if_it_fails(CONTEXT, unbind)

__version__ = VERSION

__all__ = [
    "CRITERIA",
    "Benchmark",
    "EvalConfig",
    "Evaluator",
    "Outcome",
    "PlanReason",
    "Predictions",
    "Scene",
    "Scores",
    "Trials",
    "load_benchmark",
    "reward",
    "show",
]

__path__[:] = map(str, FOLDERS)

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Benchmark": "trials.benchmark",
            "CRITERIA": "verdicts",
            "EvalConfig": "config",
            "Evaluator": "evaluate",
            "Outcome": "verdicts",
            "PlanReason": "verdicts",
            "Predictions": "types",
            "Scene": "scene.scene",
            "Scores": "types",
            "Trials": "types",
            "load_benchmark": "trials.load",
            "reward": "training.reward",
            "show": "view.page",
        },
    )
