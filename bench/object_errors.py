"""Success that methods lose where they see the object off its place: docs/results/object_errors.md.

`python bench/object_errors.py` lets every method answer once and judges its answers, motion as planned, with the object's
frame seen true, at each level of `--object-errors`, and with gross errors.
"""

import argparse
import copy
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any

from _report import Report, markdown_table
from run import Bench

MEASURES = (
    "bench/object_errors.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/trials",
    "r2h_batch/scene",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/methods",
)
GROSS = 0.1
"""Share of trials with a gross error [choice]."""
METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")


def measured(answers: Any, trials: Any, evaluator: Any) -> dict[str, float | int]:
    """SR (percent, mean of the splits) and first failures of poses."""
    from r2h_batch.types import Outcome

    outcome = evaluator.score(answers.T_obj_ee, answers.T_world_ee, trials).outcome
    won, functional = outcome == int(Outcome.SUCCESS), trials.trial_id % 2 == 1
    rates = [100 * float(won[rows].float().mean()) for rows in (~functional, functional)]
    failed = (Outcome.STABILITY, Outcome.PLAN, Outcome.REACH, Outcome.AFFORDANCE, Outcome.SAFE)
    return {
        "sr": sum(rates) / 2,
        "s0": rates[0],
        "s1": rates[1],
        **{o.name.lower(): int((outcome == int(o)).sum()) for o in failed},
    }


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Every method with every error."""
    from r2h_batch import Evaluator, load_benchmark
    from r2h_batch.config import OBJECT_ERRORS, EvalConfig, ExecConfig, ObjectErrors

    benchmark = load_benchmark("r2h-v2")
    trials = benchmark.trials(options.trials)
    evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    cases = {name: ObjectErrors(*size) for name, size in OBJECT_ERRORS.items()}
    cases["gross, half turn"] = ObjectErrors(gross=GROSS)
    cases["gross, symmetry"] = ObjectErrors(gross=GROSS, gross_turn="symmetry")
    judges = {name: copy.copy(evaluator) for name in cases}
    for name, errors in cases.items():
        judges[name].config = replace(evaluator.config, object_errors=errors)
    found: dict[str, dict[str, Any]] = {}
    for method in METHODS:
        predict = import_module(f"r2h_batch.methods.{method.replace('-', '_')}").predict
        more = {"evaluator": evaluator} if method == "oracle" else {}
        answers = predict(trials, evaluator.scene, **more)
        found[method] = {name: measured(answers, trials, judge) for name, judge in judges.items()}
        print(method, {name: round(cell["sr"], 1) for name, cell in found[method].items()}, flush=True)
    sizes = {name: [e.translation_m, e.rotation_deg] for name, e in cases.items()}
    return {"trials": options.trials, "sizes": sizes, "rates": found}


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    from r2h_batch.methods.contact import TITLE as CONTACT
    from r2h_batch.methods.fc import TITLE as FC
    from r2h_batch.methods.handover_va import TITLE as VA
    from r2h_batch.methods.intent import TITLE as INTENT

    titles = {"fc": FC, "handover-va": VA, "contact": CONTACT, "intent": INTENT}

    def cell(c: Mapping[str, Any]) -> str:
        return f"{c['sr']:.1f} ({c['stability']}/{c['plan']}/{c['reach']}/{c['affordance']})"

    head = [
        f"{name}, {1000 * m:g} mm, {d:g} deg" if m else {"none": "true"}.get(name, name)
        for name, (m, d) in data["sizes"].items()
    ]
    rates = [[titles.get(m, m), *map(cell, cells.values())] for m, cells in data["rates"].items()]
    return {
        "half": 98 / (2 * data["trials"]) ** 0.5,
        "rates": markdown_table(["", *head], rates),
        "gross": 100 * GROSS,
    }


BENCH = Bench(
    __doc__, measure, MEASURES, {"--trials": {"default": 120, "help": "of each split"}}, stored="object_errors"
)

if __name__ == "__main__":
    BENCH.main()
