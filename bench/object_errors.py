"""Success that methods lose where they see the object off its place: docs/results/object_errors.md.

`python bench/object_errors.py` lets every method answer once and judges its answers, motion as planned, with the object's
frame seen true, at each level of `--object-errors`, and with gross errors. `--render` writes the page again from the JSON.
"""

import argparse
import copy
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any

from _report import ROOT, made_by, markdown_table, page_from

PAGE = ROOT / "docs" / "results" / "object_errors.md"
MEASURES = (
    "bench/object_errors.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/protocols",
    "r2h_batch/scene",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/methods",
    "r2h_batch/trials",
)
GROSS = 0.1
"""Share of trials with a gross error [choice]."""
METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")

HEAD = """# Errors of the object's pose

Methods are told where the object is. Here they are told wrongly
([definition](../choices.md#errors-estimates-candidates)); the judge and the trials stay
true. `python bench/object_errors.py` measured {trials} trials of each split of r2h-v2, `--sim none`
(bench/results/object_errors.json; commit {commit}, load {load:g} at the start). Every column has the same trials and answers.
For your method: `r2h-batch sweep --method mine.py:predict --sim none --object-errors field --out runs/field`.

SR in percent, mean of S0 and S1. In brackets: trials of both splits whose first failure is Stability / Plan / Reach / Affordance.
The 95 % interval of a rate for more trials with these objects reaches up to {half:.0f} points to each side.

{rates}

Gross: {gross:g} % of the trials, without other errors. *half turn*: 180 degrees about one axis of the object's box. *symmetry*:
any angle about the axis about which turns change the surface least.

- Stability takes most of the loss: it comes first in the order, so the other criteria are asked of fewer trials.
- The oracle searches in the world that it sees. With an error that it does not know, it is no upper bound.
"""


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


def measure(options: argparse.Namespace) -> dict[str, Any]:
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
    return {"trials": options.trials, "sizes": sizes, "rates": found, **made_by(MEASURES)}


def markdown(data: Mapping[str, Any]) -> str:
    """The page."""
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
    return HEAD.format(
        trials=data["trials"],
        commit=str(data["commit"])[:12],
        load=data["hardware"]["load_at_start"],
        half=98 / (2 * data["trials"]) ** 0.5,
        rates=markdown_table(["", *head], rates),
        gross=100 * GROSS,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=120, help="of each split")
    page_from(parser, ROOT / "bench" / "results" / "object_errors.json", PAGE, measure, markdown)


if __name__ == "__main__":
    main()
