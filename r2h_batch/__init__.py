"""Verdicts on robot-to-human handovers, by the thousand: the R2HandoverSim benchmark as a batched evaluator."""

from pathlib import Path

_root = Path(__file__).resolve().parent
if not (_root / "kernels").exists():  # a checkout or an editable install: kernels/ and assets/ stand beside the package
    __path__.append(str(_root.parent))

__version__ = "0.1.0"

__all__ = ["EvalConfig", "Evaluator", "Predictions", "Scene", "Scores", "Trials", "make_trials"]

_HOME = {
    "EvalConfig": "config",
    "Evaluator": "evaluate",
    "Predictions": "types",
    "Scene": "scene",
    "Scores": "types",
    "Trials": "types",
    "make_trials": "trials",
}


def __getattr__(name: str) -> object:
    """The public names, imported when first used: ``--help`` must not wait for torch and Warp."""
    if name not in _HOME:
        raise AttributeError(f"module 'r2h_batch' has no attribute {name!r}; it has {', '.join(__all__)}")
    from importlib import import_module

    return getattr(import_module(f"r2h_batch.{_HOME[name]}"), name)
