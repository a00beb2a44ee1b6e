"""Numbers of a sweep or a training loop in TensorBoard, and in the loggers of others by their own calls."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from fake_bench import set_up as set_up_fake
from needs import needs

from r2h_batch.base.loggers import LOGGERS, Logger
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs


@needs("tensorboard")
def test_a_sweep_writes_its_table_into_tensorboard(tmp_path, monkeypatch, capsys):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(jobs, "set_up", set_up_fake)
    line = ["--benchmark", "r2h-v1", "--method", "fake_bench:best", "--trials", "4", "--out", str(tmp_path / "run")]
    assert sweep.main([*line, "--log", "tensorboard"]) == 0
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    stored = EventAccumulator(str(events))
    stored.Reload()
    assert stored.Scalars("fake_bench:best/S0/n")[0].value == 4
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("S0")]
    assert f"{stored.Scalars('fake_bench:best/S0/sr')[0].value:.1f}" in rows[0]


@pytest.mark.parametrize("kind", [k for k in LOGGERS if k != "tensorboard"])
def test_each_logger_gets_numbers_steps_name_and_settings_and_stays_on_this_machine(kind, tmp_path, monkeypatch):
    calls = []

    def call(name):
        return lambda *args, **kwargs: calls.append((name, args, kwargs)) or fake

    names = "init log finish set_tracking_uri set_experiment start_run log_params log_metrics end_run"
    fake = SimpleNamespace(**{name: call(name) for name in names.split()})
    monkeypatch.setitem(sys.modules, kind, fake)
    for name in ("WANDB_MODE", "MLFLOW_TRACKING_URI", "TRACKIO_DIR"):
        monkeypatch.delenv(name, raising=False)
    with Logger(kind, tmp_path / "mine", {"protocol": "r2h-v1"}) as logger:
        logger.log({"success": np.float32(0.5)}, step=3)
    text = repr(calls)
    assert "'success': 0.5" in text and "'step': 3" in text and "'mine'" in text and "r2h-v1" in text
    assert [name for name, *_ in calls][-1] in ("finish", "end_run")
    local = {"wandb": "'mode': 'offline'", "mlflow": f"sqlite:///{tmp_path}"}
    assert local.get(kind, "") in text
