"""Every public function with every argument of the wrong kind: an error that names the argument, or its obvious meaning."""

import copy
import dataclasses
import pickle
import re
from functools import cache
from pathlib import Path

import numpy as np
import pydantic
import pytest
import torch
from made_runs import write_run
from problems import default_evaluator, make_batch

from r2h_batch import Benchmark, EvalConfig, Evaluator, Predictions, Scene, load_benchmark, reward, show
from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.soft import soft_success
from r2h_batch.closed_loop.env import LoopConfig
from r2h_batch.config import EstimateConfig, ExecConfig, ExecutionError, IkConfig, PlanConfig, Thresholds, Workplace
from r2h_batch.data.people import built_in_people
from r2h_batch.methods.ranker.observe import Seen
from r2h_batch.report.statistics import aggregate, paired
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.report.statistics.thresholds import rank_stability, rethreshold
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.options import parse
from r2h_batch.sweep.request import requested
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate
from r2h_batch.training.rank import Recipe
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.trials.noise import PredictorNoise
from r2h_batch.trials.predictions import load_predictions, write_predictions

WRONG = {
    "None": None, "text": "a", "bytes": b"a", "a float": 1.5, "infinity": float("inf"), "NaN": float("nan"), "minus one": -1,
    "a number of NumPy": np.float32(2.5), "a whole number of NumPy": np.int64(2), "an empty list": [], "a list of words": ["a"],
    "a list of nothing": [None], "an empty tensor": torch.empty(0), "a tensor": torch.ones(3, 2),
    "a sparse tensor": torch.eye(4).to_sparse(), "an array": np.zeros((2, 2)), "an array of objects": np.array([None, "a"]),
    "a dictionary": {"a": 1}, "a function": len, "an object": object(),
}  # fmt: skip


@cache
def batch():
    return make_batch(default_evaluator().scene, 4)


@cache
def scores():
    b = batch()
    return default_evaluator().score(b.T_obj_ee, b.T_world_ee, b.trials, "pose")


def scored() -> dict:
    b = batch()
    return {"T_obj_ee": b.T_obj_ee, "T_world_ee": b.T_world_ee, "trials": b.trials}


CALLS = {
    "load_benchmark": (load_benchmark, lambda _: {"benchmark": "r2h-v0", "pieces": False}),
    "Benchmark": (Benchmark, lambda _: {f: getattr(_benchmark(), f) for f in Benchmark.__dataclass_fields__}),
    "Benchmark.trials": (lambda **k: _benchmark().trials(**k), lambda _: {"splits": ("S0",), "trials": 2}),
    "Benchmark.trials_with_ids": (lambda **k: _benchmark().trials_with_ids(**k), lambda _: {"trial_id": torch.arange(2)}),
    "Benchmark.on": (lambda **k: _benchmark().on(**k), lambda _: {"robot": _benchmark().robot, "persons": "for-robot"}),
    "Benchmark.with_objects": (lambda **k: _benchmark().with_objects(**k), lambda _: {"objects": _benchmark().objects}),
    "Benchmark.with_people": (lambda **k: _benchmark().with_people(**k), lambda _: {"people": built_in_people("adults")}),
    "Benchmark.config": (lambda **k: _benchmark().config(**k), lambda _: {"base": None}),
    "trials_digest": (trials_digest, lambda _: {"trials": batch().trials}),
    "Evaluator": (Evaluator, lambda _: {"benchmark": None, "config": None, "device": "cpu", "threads": None}),
    "Evaluator.score": (lambda **k: default_evaluator().score(**k), lambda _: {**scored(), "stages": "pose"}),
    "Evaluator.rows_at_once": (lambda **k: default_evaluator().rows_at_once(**k), lambda _: {"stages": "pose"}),
    "Scene": (Scene, lambda _: {"benchmark": _benchmark(), "device": "cpu", "config": None}),
    "Scene.palm": (lambda **k: default_evaluator().scene.palm(**k), lambda _: {
        "hand_index": batch().trials.hand_index, "T_world_hand": batch().trials.T_world_hand}),
    "Scene.model": (lambda **k: default_evaluator().scene.model(**k), lambda _: {"hand_indices": [0], "execute": None}),
    "Trials[...]": (lambda rows: batch().trials[rows], lambda _: {"rows": 0}),
    "Trials.to": (lambda device: batch().trials.to(device), lambda _: {"device": "cpu"}),
    "Trials.named": (lambda objects: batch().trials.named(objects), lambda _: {"objects": default_evaluator().scene.objects}),
    "Scores.by_trial": (lambda k: scores().by_trial(k), lambda _: {"k": 2}),
    "Scores.soft": (lambda **k: scores().soft(**k), lambda _: {"temperature_m": 0.01, "log": False}),
    "Scores.concatenate": (lambda parts: type(scores()).concatenate(parts), lambda _: {"parts": [scores()]}),
    "show": (show, lambda _: {"scores": scores()[0], "height": 300}),
    "reward.success": (reward.success, lambda _: {"scores": scores()}),
    "reward.margin_vector": (reward.margin_vector, lambda _: {"scores": scores(), "limit_m": 0.05}),
    "reward.first_failure": (reward.first_failure, lambda _: {"scores": scores()}),
    "reward.quality": (reward.quality, lambda _: {"scores": scores(), "limit_m": 0.05}),
    "reward.rank_of_k": (reward.rank_of_k, lambda _: {"value": torch.ones(4), "k": 2}),
    "reward.best_of_k": (reward.best_of_k, lambda _: {"value": torch.ones(4), "k": 2}),
    "soft_success": (soft_success, lambda _: {"margin": scores().margin, "evaluated": scores().evaluated,
        "success": scores().success, "temperature_m": 0.01, "log": False}),
    "load_predictions": (load_predictions, lambda tmp: {"path": _file(tmp)}),
    "write_predictions": (write_predictions, lambda tmp: {"path": tmp / "p.npz", "predictions": _answers(), "benchmark": ""}),
    "load_run": (load_run, lambda tmp: {"folder": _run(tmp).folder, "verify": True}),
    "Run.named": (lambda word, run: run.named(word), lambda tmp: {"word": "a", "run": _run(tmp)}),
    "Run.only": (lambda methods, run: run.only(methods), lambda tmp: {"methods": ["a"], "run": _run(tmp)}),
    "Run.entry": (lambda method, run: run.entry(method), lambda tmp: {"method": "a", "run": _run(tmp)}),
    "Run.missing": (lambda method, run: run.missing(method), lambda tmp: {"method": "a", "run": _run(tmp)}),
    "Run.digest": (lambda method, run: run.digest(method), lambda tmp: {"method": "a", "run": _run(tmp)}),
    "common_trials": (common_trials, lambda tmp: {"runs": [_run(tmp)], "proven": ()}),
    "pair_up": (paired.pair_up, lambda tmp: {"runs": [_run(tmp)], "common": None}),
    "compare": (paired.compare, lambda tmp: {"paired": paired.pair_up([_run(tmp)]), "draws": 50, "seed": 0}),
    "mcnemar": (paired.mcnemar, lambda _: {"only_a": 3, "only_b": 5}),
    "holm": (paired.holm, lambda _: {"p": [0.1, 0.2]}),
    "rank_probabilities": (paired.rank_probabilities, lambda _: {"rates": np.ones((3, 2))}),
    "wilson_interval": (aggregate.wilson_interval, lambda _: {"count": 3, "total": 5, "confidence": 0.9}),
    "clustered_rate": (aggregate.clustered_rate, lambda _: {"success": np.ones(4, int), "total": np.ones(4, int)}),
    "mean_rate": (aggregate.mean_rate, lambda _: {"rates": [aggregate.Rate(1.0, 0.0, 2.0)]}),
    "summarise": (aggregate.summarise, lambda tmp: {"methods": [_tally(tmp)]}),
    "average_row": (aggregate.average_row, lambda tmp: {"rows": aggregate.summarise([_tally(tmp)])[:2]}),
    "split_row": (aggregate.split_row, lambda tmp: {"counted": _tally(tmp), "split": "S0"}),
    "object_rows": (aggregate.object_rows, lambda tmp: {"counted": _tally(tmp), "split": "S0"}),
    "rethreshold": (
        rethreshold,
        lambda tmp: {"run": _run(tmp), "reach_radius_m": [0.1], "w_max_m": [0.08], "safe_margin_m": [0.0]},
    ),
    "rank_stability": (rank_stability, lambda tmp: {"points": rethreshold(_run(tmp), reach_radius_m=[0.1]), "methods": ["a"]}),
    "Judge": (Judge, lambda tmp: {"run": _run(tmp), "code": ()}),
    "reevaluate": (reevaluate, lambda tmp: {"run": _run(tmp), "method": "a", "n": 2, "judge": _Judge(), "seed": 0}),
    "EvalConfig.preset": (EvalConfig.preset, lambda _: {"name": "paper"}),
    **{c.__name__: (c, lambda _, c=c: {f: getattr(c(), f) for f in c.__dataclass_fields__})
       for c in (EvalConfig, Thresholds, IkConfig, PlanConfig, EstimateConfig, ExecutionError, ExecConfig, Workplace)},
}  # fmt: skip
"""Public function -> what it is called with: `r2h_batch.__all__`, and what docs/reference/python.md lists."""

LIMITS = {"reach_radius_m": 0.1, "w_max_m": 0.085, "safe_margin_m": 0.0}


class Taken(Exception):
    """The arguments were taken, and the work has begun."""


class _Judge(Judge):
    def __init__(self):
        self.other = ()

    def __getattr__(self, name):
        raise Taken


@cache
def _run(tmp):
    outcome = np.zeros(12, int)
    methods = {"a": outcome, "b": np.where(np.arange(12) % 2, 3, 0)}
    return write_run(
        tmp / "run", methods, 6, 6, configuration={"name": "default", "thresholds": LIMITS}, stored=["poses"]
    )


@cache
def _benchmark():

    return load_benchmark("r2h-v1")


def _answers():
    b = batch()
    return Predictions(b.trials.trial_id, b.T_obj_ee, b.T_world_ee, method="m")


def _file(tmp) -> Path:
    write_predictions(tmp / "given.npz", _answers())
    return tmp / "given.npz"


def _tally(tmp):
    from r2h_batch.report.statistics.tally import tally

    return tally(_run(tmp), "a")


def raw(call, name, values, arguments) -> list[str]:
    """Wrong values of an argument that are neither taken nor refused by its name, and what they raise."""
    found = []
    for what, value in values.items():
        try:
            call(**{**arguments, name: value})
        except Taken:
            continue
        except (TypeError, ValueError, IndexError, KeyError) as error:
            said = str(error)
            if isinstance(error, FileError) and name == "code":
                continue  # the words are right, and the run is of another protocol
            named = re.search(rf"\b{re.escape(name.removesuffix('s'))}s?\b", said) or said.startswith(
                f"{value}: "
            )  # a path
            if not named or "\n" in said or isinstance(error, KeyError):
                found.append(f"{name}={what}: {type(error).__name__}: {said[:150]}")
        except Exception as error:
            found.append(f"{name}={what}: {type(error).__name__}: {str(error)[:150]}")
    return found


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_of_the_wrong_kind_is_named(name, tmp_path):
    call, make = CALLS[name]
    arguments = make(tmp_path)
    own = {"run", "judge"} if name.startswith("Run.") else set()
    found = [x for argument in arguments if argument not in own for x in raw(call, argument, WRONG, arguments)]
    assert found == [], "\n".join(found)


@pytest.mark.check
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: EvalConfig(stabilty="physics"), "EvalConfig() has no argument 'stabilty', did you mean stability?"),
        (lambda: dataclasses.replace(PlanConfig(), shortcut=3), "'shortcut', did you mean shortcuts?"),
        (
            lambda: load_benchmark("r2h-v0").trials(trial=3),
            "Benchmark.trials() has no argument 'trial', did you mean trials?",
        ),
        (
            lambda: Evaluator(load_benchmark("r2h-v0"), divice="cpu"),
            "did you mean device?; it has benchmark, config, device, threads, plans_in",
        ),
        (lambda: default_evaluator().score(keep_motions=True), "'keep_motions', did you mean keep_motion?"),
        (lambda: default_evaluator().score_motion(times_s=3), "'times_s', did you mean time_s?"),
    ],
)
def test_a_misspelt_keyword_gets_the_nearest_name(call, words):
    with pytest.raises(TypeError, match=re.escape(words)):
        call()


NAN, INFINITE = float("nan"), float("inf")
OUTSIDE = [
    (LoopConfig, {"rate_hz": 9}, "LoopConfig.rate_hz is 9; it must be 10 or more"),
    (LoopConfig, {"rate_hz": 51}, "LoopConfig.rate_hz is 51; it must be 50 or less"),
    (LoopConfig, {"rate_hz": 20.5}, "LoopConfig.rate_hz is 20.5; it must be a whole number"),
    (LoopConfig, {"horizon_s": 0.9}, "LoopConfig.horizon_s is 0.9; it must be 1 or more"),
    (LoopConfig, {"horizon_s": 601}, "LoopConfig.horizon_s is 601; it must be 600 or less"),
    (LoopConfig, {"horizon_s": NAN}, "LoopConfig.horizon_s is nan; it must be"),
    (LoopConfig, {"latency_s": -1}, "LoopConfig.latency_s is -1; it must be 0 or more"),
    (LoopConfig, {"latency_s": 6}, "LoopConfig.latency_s is 6; it must be 5 or less"),
    (LoopConfig, {"noise": INFINITE}, "LoopConfig.noise is inf; it must be 100 or less"),
    (LoopConfig, {"noise": -1}, "LoopConfig.noise is -1; it must be 0 or more"),
    (LoopConfig, {"dropout": 0.96}, "LoopConfig.dropout is 0.96; it must be 0.95 or less"),
    (LoopConfig, {"dropout": -0.1}, "LoopConfig.dropout is -0.1; it must be 0 or more"),
    *(
        (Recipe, {name: 0}, f"Recipe.{name} is 0; it must be 1 or more")
        for name in ("items", "steps", "mined_items", "mined_steps")
    ),
    *((Recipe, {name: -1}, f"Recipe.{name} is -1; it must be 0 or more") for name in ("regions", "rounds", "seed", "renew")),
    (Recipe, {"steps": True}, "Recipe.steps is True; it must be a whole number"),
    (Recipe, {"leave_out": "cup"}, "Recipe.leave_out is 'cup'; it must be a list: categories or names of instances"),
    (Recipe, {"leave_out": (3,)}, "Recipe.leave_out[0] is 3; it must be text: categories or names of instances"),
    (Seen, {"cloud": 0}, "Seen.cloud is 0; it must be 1 or more"),
    (Seen, {"cloud": 2049}, "Seen.cloud is 2049; it must be 2048 or less"),
    (Seen, {"cloud": 96.0}, "Seen.cloud is 96.0; it must be a whole number"),
    (Seen, {"hand": 0}, "Seen.hand is 0; it must be 1 or more"),
    (Seen, {"contacts": 1}, "Seen.contacts is 1; it must be true or false"),
    (Seen, {"spread": "no"}, "Seen.spread is 'no'; it must be true or false"),
    (Seen, {"noise": 0.5}, "Seen.noise is 0.5; it must be a PredictorNoise"),
    (PredictorNoise, {"target_errors": "x"}, "PredictorNoise.target_errors is 'x'; allowed are 'normal', 'frames' or 'tails'"),
    *(
        (PredictorNoise, {field.name: value}, f"PredictorNoise.{field.name} is {value}; it must be")
        for field in dataclasses.fields(PredictorNoise)
        if field.name != "target_errors"
        for value in (-1, NAN, INFINITE)
    ),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), OUTSIDE)
def test_a_field_outside_of_its_annotation_is_refused_in_a_line(kind, given, words):
    with pytest.raises((TypeError, ValueError), match=re.escape(words)) as error:
        kind(**given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("value", "words"), [("0.9", "1 or more"), ("601", "600 or less")])
def test_a_horizon_that_no_loop_has_is_refused_by_its_flag(value, words, tmp_path):
    options = parse(
        ["--method", "random", "--receiver-motion", "still", "--horizon", value, "--out", str(tmp_path / "run")]
    )
    with pytest.raises(UsageError, match=rf"^--horizon is {float(value):g}(\.0)?; it must be {words}$"):
        requested(options)
    assert not (tmp_path / "run").exists()


def test_configurations_are_copied_pickled_and_read_as_before():
    config = EvalConfig(plan=PlanConfig(shortcuts=3))
    assert pickle.loads(pickle.dumps(config)) == copy.deepcopy(config) == config
    assert pydantic.TypeAdapter(EvalConfig).validate_python(dataclasses.asdict(config)) == config
