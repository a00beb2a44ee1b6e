"""What a run folder does not hold is computed again: the answer from method and seed, verdict and
motion from the answer.

The built-in methods and the evaluator count instead of drawing from a stream, so one trial alone
gives the bits of its batch; `Again.note` says where a computed verdict is not the stored one
(another machine, another version).
"""

import json
from dataclasses import dataclass, replace
from typing import Any, cast, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from r2h_batch.benchmark import Benchmark
from r2h_batch.command_line import UsageError
from r2h_batch.config import EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.predictors.noise import Errors
from r2h_batch.runs.rows import TrialNames, detail_rows, path_rows, score_rows
from r2h_batch.sweep.answers import AnswerError
from r2h_batch.sweep.jobs import Setting, make_jobs
from r2h_batch.sweep.options import METHODS, Options, check
from r2h_batch.types import Predictions, Scores, Trials
from r2h_batch.verdicts import CRITERIA, SIDES, Outcome

SAME_M = 1e-6
"""Margins that differ by no more than this are the same: float32 of numbers below 10 m."""


class ReplayError(ValueError):
    """A trial that cannot be computed again: the message says what is missing and what to do."""


@dataclass(frozen=True)
class Again:
    """One trial judged again: its rows as a run folder has them, and the posture that its target
    asks for."""

    row: dict[str, Any]  # of trials and details
    path: dict[str, Any] | None  # of paths; None: no path
    asked_q: np.ndarray  # (6,) rad: the goal, or the posture nearest to it where there is no path
    asked_clearance_m: (
        float  # of that posture; negative: bodies overlap, or how far it stays from the target
    )
    scores: Scores


def evaluator_of(header: dict[str, Any], benchmark: Benchmark, where: str) -> Evaluator:
    """An evaluator on the CPU with the configuration of a run folder's header."""
    try:
        config = TypeAdapter(EvalConfig).validate_json(
            json.dumps(header["configuration"]), strict=True
        )
        engine = (
            config.execute.sim
            if config.execute.sim != "mjwarp" or header["device"]["kind"] == "cpu"
            else "mujoco"
        )
        config = replace(config, execute=replace(config.execute, sim=engine))
        return Evaluator.from_benchmark(benchmark, config)
    except (ValidationError, ValueError) as error:
        what = " ".join(str(error).split())[:200]
        raise ReplayError(
            f"{where}: its configuration cannot be judged by this version ({what})"
        ) from None


def names_of(evaluator: Evaluator) -> TrialNames:
    """The words of rows that this evaluator judged."""
    scene = evaluator.scene
    return TrialNames(
        objects=[o.name for o in scene.objects],
        object_splits=[o.split for o in scene.objects],
        hand_sides=[SIDES[s] for s in scene.hands.set.side.tolist()],
        parts=scene.part_names,
    )


def answer_again(
    header: dict[str, Any], entry: dict[str, Any], trial: Trials, evaluator: Evaluator
) -> Predictions:
    """What a built-in method of a run folder (`entry`: its stored source) answers to one trial, as
    it did in the sweep.

    A folder may come from anybody: modules and files that it names are not opened.
    """
    name, module = entry["name"], str(entry["source"].get("function", "")).partition(":")[0]
    word = module.rpartition(".")[2].replace("_", "-")
    predictors = header.get("predictors", {})
    built_in = (
        entry["source"].get("function") == f"r2h_batch.methods.{word.replace('-', '_')}:predict"
        and word in METHODS
    )
    files = [k for k, v in predictors.items() if isinstance(v, dict) and "file" in v]
    if not built_in or files:
        raise ReplayError(
            f"the poses of {name!r} are not stored, and files of its own are not opened; sweep without --no-poses"
        )
    setting = Setting(evaluator, header, lambda *_: trial.trial_id, lambda _: trial)
    try:
        options = check(
            Options(
                method=(word,),
                seed=header["seed"],
                predictor_noise=predictors.get("noise_factor", 1.0),
                hand_errors=_errors_of(predictors),
            )
        )
        return make_jobs(options, [], setting)[0].predict(trial, None)
    except (UsageError, AnswerError) as error:
        raise ReplayError(
            f"{name!r} cannot answer again ({error}); sweep without --no-poses"
        ) from error


def _errors_of(predictors: dict[str, Any]) -> Errors:
    """The error model of the target hand that a run.json names; runs from before there were several
    had normal errors."""
    noise = predictors.get("noise")
    named = noise.get("target_errors", "normal") if isinstance(noise, dict) else "normal"
    if named not in get_args(Errors):
        raise ReplayError(
            f"run.json names the error model {str(named)[:40]!r}; there are {', '.join(get_args(Errors))}"
        )
    return cast(Errors, named)


def judge_again(evaluator: Evaluator, trial: Trials, answer: Predictions) -> Again:
    """The verdict of one answer with the motion that led to it, and where there is no path the
    posture asked for."""
    names = names_of(evaluator)
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trial, keep_motion=True)
    row = (
        score_rows(trial, scores, names).to_pylist()[0]
        | detail_rows(trial, scores, names).to_pylist()[0]
    )
    path = path_rows(scores).to_pylist()
    if path:
        q, clearance = (
            np.array(path[0]["q"][-1], np.float64),
            float(scores.margin[0, CRITERIA.index("plan")]),
        )
    else:
        posed = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trial, stages="pose")
        q, clearance = (
            posed.q_goal[0].double().cpu().numpy(),
            float(posed.margin[0, CRITERIA.index("plan")]),
        )
    return Again(row, path[0] if path else None, q, clearance, scores)


def difference(stored: dict[str, Any], again: dict[str, Any]) -> str:
    """What differs between a stored verdict and the one computed here, in one line; empty where
    nothing does."""
    if stored["outcome"] != again["outcome"]:
        return (
            f"computed again here the outcome is {again['outcome']}, stored is {stored['outcome']}"
        )
    for name in CRITERIA:
        a, b = (row[f"margin_{name}_m"] for row in (stored, again))
        if (a is None) != (b is None) or (a is not None and a != b and abs(a - b) > SAME_M):
            return f"computed again here the margin of {name} is {b} m, stored is {a} m"
    return ""


def was_judged(row: dict[str, Any]) -> bool:
    """Whether there are bodies to show: the answer was a pose."""
    return row["outcome"] not in (Outcome.INVALID_INPUT.name.lower(), "missing")
