"""Loggers of experiments: one `log(numbers, step)` for TensorBoard, Weights & Biases, MLflow and
Trackio. All write files on this machine unless their own settings say otherwise."""

import os
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, get_args

from r2h_batch.base.validate import one_of

LoggerName = Literal["tensorboard", "wandb", "mlflow", "trackio"]
LOGGERS: tuple[str, ...] = get_args(LoggerName)
PROJECT = "r2h_batch"


class Logger:
    """One run of an experiment in one logger; a context manager that ends the run.

    Args:
        kind: tensorboard, wandb, mlflow or trackio.
        folder: where the files go. The run has the folder's name.
        config: settings that the logger shows with the run (not TensorBoard).

    Raises:
        ImportError: the logger is not installed; the message says how to install it.
    """

    def __init__(
        self, kind: LoggerName, folder: str | Path, config: Mapping[str, Any] | None = None
    ) -> None:
        folder, settings = Path(folder).absolute(), dict(config or {})
        one_of(*LOGGERS)("kind", kind)
        start: Callable[[Path, dict[str, Any]], None] = getattr(self, f"_{kind}")
        try:
            start(folder, settings)
        except ImportError as error:
            words = f"--log {kind} needs {kind}: pip install 'r2h_batch[{kind}]' ({error})"
            raise ImportError(words) from None

    def log(self, numbers: Mapping[str, float], step: int = 0) -> None:
        """Store numbers by name at a step.

        Args:
            numbers: a number for each name.
            step: count of training steps, sweeps or the like; the x axis of the logger's charts.
        """
        self._log({k: float(v) for k, v in numbers.items()}, step)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end()

    _log: Callable[[dict[str, float], int], None]
    _end: Callable[[], object]

    def _tensorboard(self, folder: Path, config: dict[str, Any]) -> None:
        writer = import_module("torch.utils.tensorboard").SummaryWriter(str(folder / "tensorboard"))

        def log(numbers: dict[str, float], step: int) -> None:
            for name, value in numbers.items():
                writer.add_scalar(name, value, step)

        self._log, self._end = log, writer.close

    def _wandb(self, folder: Path, config: dict[str, Any]) -> None:
        wandb = import_module("wandb")
        mode = os.environ.get("WANDB_MODE", "offline")
        folder.mkdir(parents=True, exist_ok=True)
        run = wandb.init(
            project=PROJECT, name=folder.name, dir=str(folder), config=config, mode=mode
        )
        self._log, self._end = lambda numbers, step: run.log(numbers, step=step), run.finish

    def _mlflow(self, folder: Path, config: dict[str, Any]) -> None:
        mlflow = import_module("mlflow")
        if "MLFLOW_TRACKING_URI" not in os.environ:
            folder.mkdir(parents=True, exist_ok=True)
            mlflow.set_tracking_uri(f"sqlite:///{folder / 'mlflow.db'}")
        mlflow.set_experiment(PROJECT)
        mlflow.start_run(run_name=folder.name)
        mlflow.log_params({k: str(v)[:250] for k, v in config.items()})
        self._log = lambda numbers, step: mlflow.log_metrics(numbers, step=step)
        self._end = mlflow.end_run

    def _trackio(self, folder: Path, config: dict[str, Any]) -> None:
        os.environ.setdefault("TRACKIO_DIR", str(folder / "trackio"))
        trackio = import_module("trackio")
        trackio.init(project=PROJECT, name=folder.name, config=config)
        self._log, self._end = lambda numbers, step: trackio.log(numbers, step=step), trackio.finish
