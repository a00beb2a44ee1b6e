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
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from _report import ROOT, Report, markdown_table, swept
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
SHARD = 128
"""Trials that a process takes through all sights before it takes the next ones: their solids stay
(`believed_object.KEPT_SOLIDS`)."""


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Success of all methods with all sights."""
    of = {"trials": options.trials, "source": digests(MEASURES)}
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        # rows that other code made are not gone on with
        name = hashlib.sha256(json.dumps(of).encode()).hexdigest()[:12]
        runs = (options.parts or Path(folder)) / f"runs-{name}"
        runs.mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
            for each in [pool.submit(_swept, runs, options.trials, k) for k in range(_shards(options.trials))]:
                each.result()
        shown = {words: _reached(runs / _slug(words), words) for words in SEES}
    return {"trials": options.trials, "shown": shown}


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
        rows, found = run.trials(title, ["split", "outcome"]).to_pylist(), dict[str, Any]()
        for line in lines:
            if line.method == title and line.split != "Avg":
                sr = line.rates["sr"]
                assert sr is not None
                found[line.split] = {
                    "won": "".join(str(int(r["outcome"] == "success")) for r in rows if r["split"] == line.split),
                    "sr": sr.percent / 100, "interval": [sr.low / 100, sr.high / 100],
                }  # fmt: skip
        out[name] = found
    return out


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    sights = data["shown"]

    def rates(d: Mapping[str, Any]) -> str:
        return f"{100 * d['S0']['sr']:.0f} / {100 * d['S1']['sr']:.0f}"

    def of_trials(words: str) -> str:
        own = _trials(words, data["trials"])
        return words if own == data["trials"] else f"{words}; {own} trials a split"

    def half(fewer: bool) -> float:
        """Half of the widest interval of the sights with fewer trials, or of the others; points."""
        some = (of for words, of in sights.items() if (_trials(words, data["trials"]) < data["trials"]) == fewer)
        widths = [d[s]["interval"] for of in some for d in of.values() for s in ("S0", "S1")]
        return 50 * max((high - low for low, high in widths), default=0.0)

    lines = [[name, *(rates(d[name]) if name in d else "" for d in sights.values())] for name in METHODS]
    return {
        "half": half(fewer=False),
        "wide": half(fewer=True),
        "table": markdown_table(["", *map(of_trials, sights)], lines),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--trials": {"default": 40, "help": "of each split"},
        "--processes": {"default": 2},
        "--parts": {"type": Path, "help": "folder where rows are kept: a stopped bench goes on"},
    },
    stored="sees",
)

if __name__ == "__main__":
    BENCH.main()
