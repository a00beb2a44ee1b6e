"""Success of methods that see, by what they are shown: docs/results/sees.md.

`python bench/sees.py` sweeps the built-in methods, a robust search and examples/grasp_seen.py on r2h-v2, told the truth, and
shown what two posts or one see. `--render` writes the page again from the JSON. `--parts FOLDER` keeps what is done: started
again, it goes on with what is missing.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from, swept
from _source import digests
from transfer import Parts

PAGE = ROOT / "docs" / "results" / "sees.md"
MEASURES = (
    "bench/sees.py", "examples/grasp_seen.py", "kernels/observe", "r2h_batch/observe", "r2h_batch/sweep/seeing.py",
    "r2h_batch/protocols/r2h_v2.py", "r2h_batch/methods",
)  # fmt: skip
ONE_POST = """name = "left-post"
[[cameras]]
name = "left"
position = [-0.10, 0.75, 0.80]
target = [0.42, -0.02, 0.15]
"""
SEES = {
    "the truth": "",
    "exact images of two posts": "cell-v1,noise=0",
    "two posts": "cell-v1",
    "two posts, region told": "cell-v1,region=told",
    "two posts, 5 % of masks missed": "cell-v1,labels=missed",
    "two posts, masks grown by 2 pixels": "cell-v1,labels=grown",
    "one post": "left-post.toml",
    "two posts, model known, pose as `lab`": "cell-v1,model=known,object=lab",
    "two posts, model known, pose as `field`": "cell-v1,model=known,object=field",
    "two posts, model known, pose as `rgb`": "cell-v1,model=known,object=rgb",
}
EXAMPLE = f"example={ROOT / 'examples' / 'grasp_seen.py'}:predict"
METHODS = {
    "FC": "fc", "Handover-VA": "handover-va", "Contact": "contact", "Intent": "intent", "Learned": "learned",
    "robust search": "robust", "plain search": "robust,draws=0", "example": EXAMPLE, "random": "random",
}  # fmt: skip
HIDDEN, TOLD = "two posts", "two posts, region told"
ORACLE = {"robust search": "oracle"}
"""Told the truth, a search has no error to reckon with."""
CAUSES = ("stability", "plan", "reach", "affordance", "safe")

HEAD = """# Methods that see

`python bench/sees.py` swept the built-in methods and `examples/grasp_seen.py` on r2h-v2, motion as planned, {trials} trials a
split, by what they were [shown](../observe.md#methods-that-see) (bench/results/sees.json; commit {commit}, load {load:g} at the
start). All rows are of the same trials.

## Success

SR in percent, S0 / S1. Half of the 95 % interval of these trials (Wilson) is at most {half:.0f} points.

{table}
{categories}
`robust search` looks for a grasp and a pose that succeed under 16 drawn errors of what it sees, `plain search` for a pair that
succeeds as believed ([built-in methods](../observe.md#built-in-methods)). Told the truth, the oracle stands in their place.

Where it is not told, no method that sees knows the receiver's region (S1), the searches included: images show no parts. So in S1
Affordance is what stops the searches ([causes](#causes)). With a model known the region is not known either. Nor do the methods
know the person's arm and torso: the world that they believe in has the hand alone, and planning and Safe judge all of the person.

{told}## Causes

Trials of both splits by their first failure: {causes}.

{failures}

## Pick

Percent of all trials in which some posture takes the object up where it lay; the way there is not looked at.

{picks}

## Cost

CPU seconds of a trial, looking and judging included, one method after the other in one process: the next method finds the solids
of the one before it, and those of images that the process has had before. The example's own process does not count.

{costs}
"""


REGION = """## The receiver's region

With `region=told` methods are told which seen points belong to the part that the receiver wants
([definition](../observe.md#methods-that-see)). Trials of S1 that only one of two sights solves, with two posts; the
difference of SR in points and the 95 % interval (Tango 1998, of trials with the same objects).

{table}

In S0 there is no region, and the answers are the same.

"""


def measure(options: argparse.Namespace) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    parts = Parts(options.parts, {"trials": options.trials, "source": digests(MEASURES)})
    with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        found = [pool.submit(parts.get, w, partial(_shown, w, options.trials)) for w in SEES]
        shown = {words: f.result() for words, f in zip(SEES, found, strict=True)}
    return {"trials": options.trials, "shown": shown, **made_by(MEASURES)}


def _shown(words: str, trials: int) -> dict[str, Any]:
    """Method -> what it reached with one sight."""
    from r2h_batch.report.table import table_of
    from r2h_batch.runs.store import load_run

    sees, out = SEES[words], {}
    asked = dict(METHODS)
    if not sees:
        asked = {k: v for k, v in METHODS.items() if k not in ("plain search", "example")} | ORACLE
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        (home / "left-post.toml").write_text(ONE_POST)
        text = str(home / sees) if sees.endswith(".toml") else sees
        more = ("--sees", text) if sees else ()
        for name, method in asked.items():
            begin = time.process_time()
            own = swept(
                home / name, "--method", method, *more, "--sim", "none", "--trials", trials, "--threads", 1, "--quiet"
            )
            seconds = time.process_time() - begin
            run = load_run(own)
            (title,) = run.methods
            rows = run.trials(title)
            outcome = rows["outcome"].to_pylist()
            found: dict[str, Any] = {"causes": {c: Counter(outcome)[c] for c in CAUSES}}
            for line in table_of(run).rows:
                if line.split != "Avg":
                    sr, new = line.rates["sr"], line.sr_new_categories
                    assert sr is not None and new is not None
                    split = [o for o, s in zip(outcome, rows["split"].to_pylist(), strict=True) if s == line.split]
                    found[line.split] = {
                        "won": "".join(str(int(o == "success")) for o in split),
                        "sr": sr.percent / 100, "interval": [sr.low / 100, sr.high / 100],
                        "categories": [new.low / 100, new.high / 100],
                    }  # fmt: skip
            if sees:
                seen = run.sees(title)
                found["pick"] = float(np.mean(seen["pick"].to_pylist()))
                found["seen_share"] = float(np.median(seen["seen_share"].to_numpy()))
            found["cpu_s"] = seconds / len(rows)
            out[name] = found
            print(words, name, found, flush=True)
    return out


def markdown(data: Mapping[str, Any]) -> str:
    """The page."""
    shown = data["shown"]

    def table(say: Callable[[Mapping[str, Any]], str], *, truth: bool = True) -> str:
        some = {k: v for k, v in shown.items() if truth or k != "the truth"}
        lines = [[name, *(say(d[name]) if name in d else "" for d in some.values())] for name in METHODS]
        return markdown_table(["", *some], lines)

    def ends(d: Mapping[str, Any]) -> str:
        return " / ".join("-".join(f"{100 * x:.0f}" for x in d[s]["categories"]) for s in ("S0", "S1"))

    categories = ""
    if "categories" in next(iter(shown["the truth"].values()))["S0"]:
        categories = f"\nThe 95 % interval for the mean of all categories of objects, S0 / S1.\n\n{table(ends)}\n"
    told = ""
    if TOLD in shown:
        told = REGION.format(table=_told_table(shown[HIDDEN], shown[TOLD]))
    widths = [d[s]["interval"] for of in shown.values() for d in of.values() for s in ("S0", "S1")]
    return HEAD.format(
        trials=data["trials"], commit=str(data["commit"])[:12], load=data["hardware"]["load_at_start"],
        half=50 * max(high - low for low, high in widths),
        table=table(lambda d: f"{100 * d['S0']['sr']:.0f} / {100 * d['S1']['sr']:.0f}"),
        categories=categories,
        told=told,
        causes=" / ".join(CAUSES),
        failures=table(lambda d: "/".join(str(d["causes"][c]) for c in CAUSES)),
        picks=table(lambda d: f"{100 * d['pick']:.0f}", truth=False),
        costs=table(lambda d: f"{d['cpu_s']:.2f}"),
    )  # fmt: skip


def _told_table(hidden: Mapping[str, Any], told: Mapping[str, Any]) -> str:
    """A row for each method: trials of S1 that only one of two sights solves, and the paired difference."""
    from r2h_batch.report.statistics.intervals import paired_score_interval

    lines = []
    for name in METHODS:
        before, after = (of[name]["S1"]["won"] for of in (hidden, told))
        pairs = Counter(zip(before, after, strict=True))
        more, less = pairs["0", "1"], pairs["1", "0"]
        low, high = (100 * x for x in paired_score_interval(more, less, len(before)))
        ends = f"{low:+.0f} to {high:+.0f}"
        lines.append([name, str(less), str(more), f"{100 * (more - less) / len(before):+.0f}", ends])
    return markdown_table(["", "hidden alone", "told alone", "told - hidden", "interval"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="of each split")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--parts", type=Path, help="folder where finished parts are kept: a stopped bench goes on")
    page_from(parser, ROOT / "bench" / "results" / "sees.json", PAGE, measure, markdown)


if __name__ == "__main__":
    main()
