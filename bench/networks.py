"""Contact-Handover by what its network trained on: docs/baselines.md.

`python bench/networks.py --json bench/results/networks.json` sweeps `contact` with the network that trained on other instances of
all sixteen categories, and with those of r2h-v1 that left the object's category out (`contacts=other-categories`), and keeps the
rows in bench/options/networks (r2h-v2, motion as planned).
"""

import numpy as np
from _report import Report, arguments
from _rows import kept_rows, rates_of

from r2h_batch.methods.predictors import Contacts, predict_contacts

OPTIONS: dict[str, Contacts] = {"all_categories": "left-out", "other_categories": "other-categories"}
"""Which categories a network trained on -> the option `contacts`."""
TRIALS = 500
FLAGS = ("--benchmark", "r2h-v2", "--sim", "none", "--no-poses")
MEASURES = (
    *("bench/networks.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *("r2h_batch/trials", "r2h_batch/protocols", "r2h_batch/evaluate.py", "r2h_batch/prepared.py"),
)


def region_areas(contacts: Contacts) -> list[float]:
    """Area under the curve of the receiver's region, of each object of S1, by the networks of this option."""
    from r2h_batch import load_benchmark
    from r2h_batch.assets.families.train_contacts import area

    benchmark = load_benchmark("r2h-v2")
    evaluator = benchmark.evaluator(threads=1)
    trials = benchmark.trials(len(benchmark.objects), splits=["S1"])
    maps = predict_contacts(trials, evaluator.scene, contacts=contacts).numpy()
    by_object = dict(zip(trials.object_index.tolist(), maps, strict=True))
    objects = evaluator.scene.objects
    return [area(found, objects[o].receiver_face[objects[o].point_face]) for o, found in sorted(by_object.items())]


def measure(trials: int) -> Report:
    """Sweeps, keeps the rows, and collects the figures."""
    report = Report(MEASURES)
    report.add("networks.trials", trials)
    words = {name: f"contact,contacts={option}" for name, option in OPTIONS.items()}
    words["all_categories"] = "contact"  # the option's default
    rates = rates_of(kept_rows("networks", [*words.values()], "--trials", trials, *FLAGS), [*words.values()])
    for name, option in OPTIONS.items():
        for split, row in rates[words[name]].items():
            for key in ("sr", "sr_new_categories_low", "sr_new_categories_high", "f_afford"):
                if row[key] is not None:
                    report.add(f"networks.{name}.{split.lower()}.{key}", row[key])
        areas = region_areas(option)
        report.add(f"networks.{name}.objects", len(areas))
        report.add(f"networks.{name}.region_auc", float(np.mean(areas)))
    return report


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each split")
    options = parser.parse_args()
    target = options.json and options.json.resolve()
    measure(options.trials).write(target)
