"""Success of methods that see, by what they are shown: docs/results/questions.md.

`python bench/sees.py` sweeps the built-in methods, a robust search and examples/grasp_seen.py on r2h-v2, told the truth, and
shown what two posts or one see. `--trials 500 --processes 2 --parts FOLDER` is for two hours: it keeps what is done, and started
again it goes on with what is missing.

A process takes a piece of the trials through all sights: images that are the same show the same solids. All methods of a sight
are one sweep, so they look once.
"""

import argparse
import hashlib
import json
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, Parts, Report, markdown_table, swept
from _source import digests
from run import Bench

MEASURES = (
    "bench/sees.py", "examples/grasp_seen.py", "kernels/observe", "r2h_batch/observe", "r2h_batch/sweep/seeing.py",
    "r2h_batch/trials/r2h_v2.py", "r2h_batch/methods",
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
FEWER = ("exact images of two posts", "two posts, 5 % of masks missed", "two posts, masks grown by 2 pixels")
FEWER_TRIALS = 128
"""Trials a split of these sights at most: each needs solids of its own."""
ORACLE = {"robust search": "oracle"}
"""Told the truth, a search has no error to reckon with."""
CAUSES = ("stability", "plan", "reach", "affordance", "safe")

SHARD = 128
"""Trials that a process takes through all sights before it takes the next ones: their solids stay
(`believed_object.KEPT_SOLIDS`)."""
COSTS = ("the truth", HIDDEN, "one post", "two posts, model known, pose as `lab`")
"""Sights whose cost is measured; the others cost what two posts do."""
FEW, MORE = 2, 12
"""Trials a split of two sweeps. The difference is the cost of a trial, without that of a sweep's start."""
WORLD = "solid, grasps, hands"


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Success of all methods with all sights, and what some sights cost."""
    of = {"trials": options.trials, "source": digests(MEASURES)}
    parts = Parts(options.parts, of)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        # rows that other code made are not gone on with
        name = hashlib.sha256(json.dumps(of).encode()).hexdigest()[:12]
        runs = (options.parts or Path(folder)) / f"runs-{name}"
        runs.mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(options.processes, mp_context=context, max_tasks_per_child=1) as pool:
            found = [pool.submit(parts.get, f"cost of {w}", partial(_costs, w)) for w in COSTS]
            costs = {words: f.result() for words, f in zip(COSTS, found, strict=True)}
        with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
            for each in [pool.submit(_swept, runs, options.trials, k) for k in range(_shards(options.trials))]:
                each.result()
        shown = {words: _reached(runs / _slug(words), words) for words in SEES}
    return {"trials": options.trials, "shown": shown, "cost": costs}


def _asked(words: str) -> dict[str, str]:
    """Name -> method, of those that one sight is asked of."""
    if SEES[words]:
        return METHODS
    return {k: v for k, v in METHODS.items() if k not in ("plain search", "example")} | ORACLE


def _slug(words: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in words)


def _sweep(folder: Path, words: str, methods: Iterable[str], trials: int, *more: object) -> Path:
    """A run of methods with one sight."""
    rig = folder.parent / f"rig-{_slug(words)}" / "left-post.toml"
    sees = SEES[words]
    if sees.endswith(".toml"):
        rig.parent.mkdir(exist_ok=True)
        if not rig.exists():
            rig.write_text(ONE_POST)
        sees = str(rig)
    own = ("--sees", sees) if sees else ()
    return swept(
        folder,
        "--method",
        *methods,
        *own,
        "--execute.sim",
        "none",
        "--trials",
        trials,
        "--threads",
        1,
        "--quiet",
        *more,
    )


def _trials(words: str, trials: int) -> int:
    """Trials a split of a sight: the first ones."""
    return min(trials, FEWER_TRIALS) if words in FEWER else trials


def _shards(trials: int) -> int:
    return -(-2 * trials // SHARD)


def _swept(runs: Path, trials: int, k: int) -> None:
    """One shard of the trials through all sights."""
    for words in SEES:
        shards = _shards(own := _trials(words, trials))
        if k >= shards:
            continue
        begin = time.process_time()
        piece = ("--shard-trials", SHARD, "--shard", f"{k + 1}/{shards}")
        _sweep(runs / _slug(words), words, _asked(words).values(), own, *piece)
        print(f"{words}, shard {k + 1} of {shards}: {time.process_time() - begin:.0f} CPU s", flush=True)


def _reached(folder: Path, words: str) -> dict[str, Any]:
    """Method -> what it reached with one sight."""
    from r2h_batch.report.table import table_of
    from r2h_batch.runs.store import load_run

    run, out = load_run(folder), {}
    lines = table_of(run).rows
    for name, title in zip(_asked(words), run.methods, strict=True):
        rows = run.trials(title)
        outcome = rows["outcome"].to_pylist()
        found: dict[str, Any] = {"causes": {c: Counter(outcome)[c] for c in CAUSES}}
        for line in lines:
            if line.method == title and line.split != "Avg":
                sr, new = line.rates["sr"], line.sr_new_categories
                assert sr is not None and new is not None
                split = [o for o, s in zip(outcome, rows["split"].to_pylist(), strict=True) if s == line.split]
                found[line.split] = {
                    "won": "".join(str(int(o == "success")) for o in split),
                    "sr": sr.percent / 100, "interval": [sr.low / 100, sr.high / 100],
                    "categories": [new.low / 100, new.high / 100],
                }  # fmt: skip
        if SEES[words]:
            seen = run.sees(title)
            found["pick"] = float(np.mean(seen["pick"].to_pylist()))
            found["seen_share"] = float(np.median(seen["seen_share"].to_numpy()))
        out[name] = found
    return out


def _costs(words: str) -> dict[str, float]:
    """Method -> CPU seconds of a trial in a sweep of its own; `WORLD`: of what the methods share."""
    asked = _asked(words)
    with tempfile.TemporaryDirectory() as folder:

        def seconds(name: str, *, cold: bool) -> float:
            took = []
            for trials in (FEW, FEW, MORE):  # the first loads what is used
                _forget() if cold else CONTACTS.clear()
                begin = time.process_time()
                _sweep(Path(folder) / f"{name} {len(list(Path(folder).iterdir()))}", words, [asked[name]], trials)
                took.append(time.process_time() - begin)
            return (took[2] - took[1]) / (2 * (MORE - FEW))

        from r2h_batch.methods.believed import CONTACTS

        first = next(iter(asked))
        cold = seconds(first, cold=True)
        found = {name: seconds(name, cold=False) for name in asked}
        if SEES[words]:
            found[WORLD] = cold - found[first]
    return found


def _forget() -> None:
    """No believed object comes from memory."""
    from r2h_batch.methods import believed
    from r2h_batch.observe import believed_object

    believed_object.SOLIDS.clear()
    believed_object.known_mesh.cache_clear()
    believed.CONTACTS.clear()
    for kept in (believed.holds_on, believed.with_grasps):
        kept.cache_clear()


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    sights = data["shown"]

    def table(say: Callable[[Mapping[str, Any]], str], *, truth: bool = True) -> str:
        some = {k: v for k, v in sights.items() if truth or k != "the truth"}
        lines = [[name, *(say(d[name]) if name in d else "" for d in some.values())] for name in METHODS]
        return markdown_table(["", *map(of_trials, some)], lines)

    def of_trials(words: str) -> str:
        own = _trials(words, data["trials"])
        return words if own == data["trials"] else f"{words}; {own} trials a split"

    def half(fewer: bool) -> float:
        """Half of the widest interval of the sights with fewer trials, or of the others; points."""
        some = (of for words, of in sights.items() if (_trials(words, data["trials"]) < data["trials"]) == fewer)
        widths = [d[s]["interval"] for of in some for d in of.values() for s in ("S0", "S1")]
        return 50 * max((high - low for low, high in widths), default=0.0)

    return {
        "half": half(fewer=False),
        "wide": half(fewer=True),
        "table": table(lambda d: f"{100 * d['S0']['sr']:.0f} / {100 * d['S1']['sr']:.0f}"),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--trials": {"default": 40, "help": "of each split"},
        "--processes": {"default": 2},
        "--parts": {"type": Path, "help": "folder where finished parts are kept: a stopped bench goes on"},
    },
    stored="sees",
)

if __name__ == "__main__":
    BENCH.main()
