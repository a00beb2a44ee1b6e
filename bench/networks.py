"""Contact-Handover by what its predictor learned from: docs/baselines.md.

`python bench/networks.py --json bench/results/networks.json` sweeps `contact` with the network that trained on other instances of
all sixteen categories, and with the predictors that never saw the object's category (`contacts=other-categories`), and keeps the
rows in bench/options/networks (r2h-v2, motion as planned).
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import families
import numpy as np
from _report import Report
from _rows import kept_rows, rates_of
from _source import ROOT
from run import Bench

from r2h_batch.methods.predictors import Contacts, predict_contacts

OPTIONS: dict[str, Contacts] = {"all_categories": "left-out", "other_categories": "other-categories"}
"""Which categories a network trained on -> the option `contacts`."""
WORDS = {"all_categories": "contact", "other_categories": "contact,contacts=other-categories"}
"""The same -> the word of the sweep."""
SHIPPED = "r2h_batch/report/compare/rows/r2h-v2-as-planned"
OTHERS = ("fc", "handover-va", "intent", "learned")
TRIALS = 500
FLAGS = ("--benchmark", "r2h-v2", "--execute.sim", "none", "--no-poses")
MEASURES = (
    *("bench/networks.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/trials",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)


def region_areas(contacts: Contacts, objects: str = "") -> dict[str, float]:
    """Object of S1 -> area under the curve of the receiver's region: of r2h-v2's, or of those that `--objects` names."""
    from r2h_batch import Evaluator
    from r2h_batch.assets.families.train_contacts import area
    from r2h_batch.trials.choice import BenchmarkChoice
    from r2h_batch.trials.edit import edited

    benchmark = edited(BenchmarkChoice(benchmark="r2h-v2", objects=objects))
    scene = Evaluator(benchmark, threads=1).scene
    trials = benchmark.trials(len(scene.objects), splits=["S1"])
    maps = predict_contacts(trials, scene, contacts=contacts).numpy()
    by_object = dict(zip(trials.object_index.tolist(), maps, strict=True))
    found = {scene.objects[k]: answer for k, answer in sorted(by_object.items())}
    return {o.name: area(answer, o.receiver_face[o.point_face]) for o, answer in found.items()}


def beside_the_others(folder: Path) -> list[dict[str, Any]]:
    """The pairs, over all trials, of Contact-Handover that never saw the category with each other method of Table I; Holm's
    correction is for all pairs of the table that has it in Contact-Handover's place."""
    from r2h_batch.report.compare.stored import load_rows, stored_rows
    from r2h_batch.report.statistics.common import common_trials
    from r2h_batch.report.statistics.paired import compare, pair_up
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    (name,) = (e.name for e, word in zip(run.entries, WORDS.values(), strict=True) if word == WORDS["other_categories"])
    runs = [run.only([name]), load_rows(ROOT / SHIPPED).only(OTHERS)]
    paired = pair_up(runs, common_trials(runs, proven=stored_rows()))
    (whole,) = (c for c in compare(paired) if c.group == "all")
    return [asdict(pair) for pair in whole.pairs if pair.a == paired.names[0]]


def measure(options: argparse.Namespace, report: Report) -> None:
    """Sweeps, keeps the rows, and collects the figures."""
    trials = options.trials
    report.add("networks.trials", trials)
    folder = kept_rows("networks", [*WORDS.values()], "--trials", trials, *FLAGS)
    rates = rates_of(folder, [*WORDS.values()])
    for name, option in OPTIONS.items():
        for split, row in rates[WORDS[name]].items():
            for key in ("sr", "sr_new_categories_low", "sr_new_categories_high", "f_afford"):
                if row[key] is not None:
                    report.add(f"networks.{name}.{split.lower()}.{key}", row[key])
        report.add(f"networks.{name}.region_auc", float(np.mean([*region_areas(option).values()])))
    report.add("networks.other_categories.beside", families.beside("Contact", beside_the_others(folder)))


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {"--trials": {"default": TRIALS, "help": "of each split"}},
    peer="networks that knew the categories",
)

if __name__ == "__main__":
    BENCH.main()
