"""Contact-Handover by what its network trained on: docs/baselines.md.

`python bench/networks.py --json bench/results/networks.json` sweeps `contact` with the network that trained on other instances of
all sixteen categories, and with the four that trained on the other twelve (`contacts=other-categories`), and keeps the rows in
bench/rows/networks (r2h-v2, motion as planned).
"""

import json
import statistics

from _report import ROOT, Report, arguments
from _rows import kept_rows, rates_of

WORDS = {"all_categories": "contact", "other_categories": "contact,contacts=other-categories"}
TRIALS = 500
FLAGS = ("--benchmark", "r2h-v2", "--sim", "none", "--no-poses")
NETWORKS = ROOT / "assets" / "families" / "voxnet_axes.json"
LIES = "as it lies"
MEASURES = (
    *("bench/networks.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *("r2h_batch/trials", "r2h_batch/protocols", "r2h_batch/evaluate.py"),
)


def measure(trials: int) -> Report:
    """Sweeps, keeps the rows, and collects the figures."""
    report = Report(MEASURES)
    report.add("networks.trials", trials)
    words = list(WORDS.values())
    rates = rates_of(kept_rows("networks", words, "--trials", trials, *FLAGS), words)
    for name, word in WORDS.items():
        for split, row in rates[word].items():
            for key in ("sr", "sr_new_categories_low", "sr_new_categories_high", "f_afford"):
                if row[key] is not None:
                    report.add(f"networks.{name}.{split.lower()}.{key}", row[key])
    trained = json.loads(NETWORKS.read_text())
    report.add("networks.all_categories.region_auc", trained["unseen_instances"][LIES]["region"])
    unseen = [own[LIES]["region"] for own in trained["left_out"].values() if "region" in own[LIES]]
    report.add("networks.other_categories.region_auc", statistics.mean(unseen))
    report.add("networks.other_categories.region_auc_low", min(unseen))
    report.add("networks.other_categories.region_auc_high", max(unseen))
    return report


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each split")
    options = parser.parse_args()
    target = options.json and options.json.resolve()
    measure(options.trials).write(target)
