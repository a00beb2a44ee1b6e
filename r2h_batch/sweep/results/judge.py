"""The evaluator that a run folder describes: it judges stored poses again."""

import json
from collections.abc import Collection, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch
from pydantic import TypeAdapter

from r2h_batch.base.validate import instance_of, sequence_of
from r2h_batch.config import EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.observe.sees import Sees
from r2h_batch.runs import provenance
from r2h_batch.runs.files import RunError
from r2h_batch.runs.plugged import criteria_since
from r2h_batch.runs.store import Run
from r2h_batch.sweep.rows import TrialNames
from r2h_batch.sweep.scoring import judged_tables
from r2h_batch.trials.of_run import benchmark_of_run
from r2h_batch.trials.predictions import Motions
from r2h_batch.types import Predictions, Trials

if TYPE_CHECKING:
    from r2h_batch.closed_loop.episodes import Loop

LATER_OPTIONS = ("receiver", "estimate", "candidates", "execution_error", "object_errors")
"""Options of `EvalConfig` that older runs do not name, because the option did not exist then. Today's default is what
those runs did."""


class Judge:
    """The evaluator that a run folder describes; objects and hands must have the run's digests.

    `other` names what has changed since the rows were scored: code, versions, processor. If it is
    empty, every bit must agree.

    Args:
        run: what `load_run(FOLDER)` gives.
        code: functions of benchmarks and families that the run names and that may run, such as `FILE.py:function`.
        device: cpu, cuda or cuda:N.
    """

    def __init__(self, run: Run, *, code: Collection[str] = (), device: str = "cpu"):
        instance_of(Run, "what load_run(FOLDER) gives")("run", run)
        sequence_of(str, "functions that may run", least=0)("code", code)
        header, where = run.header, run.folder
        config = configuration(header["configuration"], str(where))
        self.benchmark = benchmark_of_run(header, str(where), code)
        plans_in = Sees.planning(header)
        self.evaluator = Evaluator(self.benchmark, config, device=device, plans_in=plans_in)
        self.other = _other(header, device)
        self.loop, self.played = _loop_of(header["digests"].get("closed_loop"), run)

    def trials(self, trial_id: Any) -> Trials:
        """The trials with these ids, on the evaluator's device.

        Args:
            trial_id: (N,) whole numbers.
        """
        ids = torch.from_numpy(np.array(trial_id, np.int64))
        return self.benchmark.trials_with_ids(ids).to(self.evaluator.scene.device)

    def tables(
        self, trial_id: Any, T_obj_ee: Any, T_world_ee: Any, motions: Motions | None = None,
        stored: Sequence[str] = (),
    ) -> dict[str, pa.Table]:  # fmt: skip
        """Tables of answered trials, as the sweep stores them: `trials` and the kinds of `stored`.

        Args:
            trial_id: (N,) whole numbers.
            T_obj_ee: (N, 4, 4) grasps, metres.
            T_world_ee: (N, 4, 4) handover poses, metres.
            motions: motions to judge in place of planned ones.
            stored: further kinds: details, poses, paths.
        """
        scene, trials = self.evaluator.scene, self.trials(trial_id)
        grasp, handover = (
            torch.from_numpy(np.array(T, np.float32)).to(scene.device)
            for T in (T_obj_ee, T_world_ee)
        )
        answers = Predictions(trials.trial_id, grasp, handover)
        every = torch.arange(len(trials), dtype=torch.int64, device="cpu")
        padded = None if motions is None else motions.padded(every, scene.device)
        names = TrialNames.of(scene)
        return judged_tables(self.evaluator, trials, answers, padded, stored, names, self.loop)


def _loop_of(identity: Any, run: Run) -> tuple["Loop | None", str]:
    """The policy that plays the run's episodes again, or the reason why none does."""
    if "episodes" not in run.header["stored"]:
        return None, ""
    if not isinstance(identity, str):
        raise RunError(f"{run.folder}: run.json does not say how its episodes were played")
    if "pick" in run.header.get("asks", ()):
        return (
            None,
            "; episodes not played again: they began on the table, and r2h_batch 0.3 played those",
        )
    if find_spec("gymnasium") is None:
        return None, "; episodes not played again: pip install 'r2h_batch[env]'"
    from r2h_batch.closed_loop.episodes import Loop

    try:
        return Loop.of(identity), "; episodes played again"
    except ValueError as error:
        return None, f"; episodes not played again: {error}"


def configuration(data: Mapping[str, Any], where: str) -> EvalConfig:
    """The `EvalConfig` of a run.json; `RunError` where this version has other fields, or one is out
    of bounds.

    Args:
        data: the entry `configuration`.
        where: the folder, for the error.
    """
    kind = TypeAdapter(EvalConfig)
    try:
        config = kind.validate_json(json.dumps(data), strict=True)
    except ValueError as error:  # pydantic's ValidationError is one
        what = " ".join(str(error).split())[:200]
        words = f"its configuration cannot be judged by this version ({what})"
        raise RunError(f"{where}: {words}") from None
    again, now = (json.loads(kind.dump_json(c)) for c in (config, EvalConfig()))
    older: dict[str, Any] = json.loads(json.dumps(data))
    if isinstance(older.get("plan"), dict):  # options that came later say what there was before
        older["plan"] = {"hand": now["plan"]["hand"], **older["plan"]}
    older = {k: now[k] for k in LATER_OPTIONS} | older
    if again != older:
        odd = [k for k in {**again, **older} if again.get(k) != older.get(k)]
        raise RunError(f"{where}: its configuration is of another version: {', '.join(odd)[:200]}")
    return config


def _other(header: Mapping[str, Any], device: str) -> tuple[str, ...]:
    """All that could move a last bit: the digest of the code, versions, the kind of processor."""
    criteria = criteria_since(header)
    same_code = header["digests"].get("code") == provenance.code_digest() and not criteria
    other = [] if same_code else ["code", *criteria]
    installed = provenance.versions()
    other += [k for k, v in header["versions"].items() if k != "python" and installed.get(k) != v]
    device_name = provenance.device_name(device)
    # "cpu: MODEL, N cores"
    same = device_name.rpartition(",")[0] == str(header["device"]["name"]).rpartition(",")[0]
    return (*other, *([] if same else ["processor"]))


def check_poses(run: Run) -> None:
    """`RunError` if the run holds no poses.

    Args:
        run: what `load_run(FOLDER)` gives.
    """
    if "poses" not in run.header["stored"]:
        words = "stored without poses; sweep again without no_poses into another --out"
        raise RunError(f"{run.folder}: {words}")
