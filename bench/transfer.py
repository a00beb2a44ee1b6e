"""Transfers after the arm stands still: docs/results/transfer.md.

`python bench/transfer.py` simulates the transfers of the shipped rows of r2h-v1 (the first `--trials` of each split after those
that the model was fitted on) and of `oracle,for=reception`: five policies, take and touch. It halves the time step and varies
friction and mass for the oracle, asks which objects the closed gripper holds for 1 s, and measures the cost of a transfer and the
memory of `--memory` transfers. It holds MuJoCo-Warp against MuJoCo C on this CPU over `AGREE` received trials; `--agree N` prints
this alone and writes nothing. `--render` writes the page again from the JSON. `--trials 200 --processes 2 --parts FOLDER` takes
half an hour or more; started again, it goes on with what is missing in the folder.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, memory_over, page_from
from _source import digests

PAGE = ROOT / "docs" / "results" / "transfer.md"
STORED = ROOT / "bench" / "results" / "transfer.json"
BASELINES = ROOT / "bench" / "rows" / "v1"
BOUND = "oracle,for=reception"
STUDIED = 44
"""Trials that the model or `probe` was tuned on: 22 of each split. Figures are of others."""
RELEASE = ("never", "timer", "threshold", "load-share", "probe")
SCENARIO = ("take", "touch")
MORE = tuple((r, s) for s in ("pull-early", "weak") for r in ("threshold", "load-share"))
"""Cases beside the policies with `SCENARIO`."""
FORCE_PERCENT = (50, 90, 99)
HELD_HEAD = ("Method", "n", "physically stable", "lost in closing", "under the weight", "undecided", "statics")
HELD_EVERY = 2
"""Every second trial of each split is asked whether the gripper holds its object."""
MEASURES = (
    "bench/transfer.py",
    "r2h_batch/closed_loop/transfer",
    "r2h_batch/judge/closed_pose.py",
    "r2h_batch/judge/grasp_physics.py",
    "r2h_batch/judge/reception.py",
    "r2h_batch/trials/holding/capacity.py",
    "r2h_batch/trials/holding/contact_forces.py",
)
CHANGES: dict[str, dict[str, Any]] = {
    "half the time step": {"steps": 12},
    "skin friction 0.4": {"skin_friction": 0.4 / 0.6},
    "mass x 1.5": {"mass": 1.5},
    "pad friction 0.5": {"pad_friction": 0.5},
}
COMPARED = (("load-share", "take"), ("threshold", "take"), ("load-share", "touch"))
VARIED_ROWS = 100
"""Received rows of the oracle that the changes are tried on."""

OTHER_ENDS = (
    "robot_dropped",
    "badly_held",
    "dropped",
    "torn_out",
    "hand_slipped_off",
    "not_released",
    "stuck",
    "exploded",
)

AGREE = 100
"""Received trials on which the engines are compared."""
AGREE_IN = {
    "pull": ("pull_n", 1.0, "N"),
    "force on the person": ("hand_n", 1.0, "N"),
    "grip": ("grip_n", 1.0, "N"),
    "transfer time": ("transfer_s", 1e3, "ms"),
    "t50": ("share_s", 1e3, "ms"),
    "slip in the hand": ("slip_m", 1e3, "mm"),
    "slip in the gripper": ("robot_slip_m", 1e3, "mm"),
    "turn in the hand": ("turn_deg", 1.0, "deg"),
}
"""Numbers of a transfer whose differences are shown: attribute, factor, unit."""

HEAD = """# Transfers: who takes the object, and when the gripper lets go

See what a release policy changes ([definitions, and what may not be claimed](../transfer.md)). `python bench/transfer.py`
simulated {trials} trials of each split of r2h-v1 with one person each (bench/results/transfer.json, commit {commit}). The
model and `probe` were fitted on 44 other trials. For your method run `r2h-batch results transfer runs/mine`. These persons
did not yet [feel weight](../transfer.md#people-who-feel-weight): they took every object in 0.3 s, and had no age.

## From success to taken

Percent of all trials, with the default policy `load-share`. `taken and success`: the verdict of the sweep holds too.

{funnel}

## Policies

Percent of the received trials. Brackets: 95 % (Wilson) over trials, each with a person of its own. `kept`: under a mere touch.
Medians are of the taken trials: the largest force along the pull, and the time from the beginning of the grip until the gripper
is free. Of their orders only [those that survive other persons](persons.md) may be claimed.

{policies}

## Early pulls and weak grips

Percent taken of the received trials when the person pulls at 30 cm/s from the beginning of the grip, or grips and pulls weakly.

{more}

## Force on the person

Percentiles of the largest force of the arm on the hand, N, over the received trials of all methods with `take`. It says nothing
about pain or safety: nothing strikes the hand, and it has no skin.

{force}

## Physically stable

Percent of the grasps past Stability that hold in physics (`results held`: after closing, and under the weight for 1 s), of every
second trial of each split. `undecided`: too near a limit to say. `statics`: friction balances the weight on the settled posture.

{held}

## Other ends

Counts of received trials that were not taken, with `take`. Methods, policies and ends that never occur are left out.

{ends}

## Sensitivity

Outcomes of the oracle's received trials that change, of {compared} ({cases}).

{sensitivity}

{engines}## Beside people

Shares of the weight over time. Times are inputs, not validated: we chose how fast the simulated person takes the weight.

| | 10 % | 50 % | 90 % of the weight | transfer | grip of the person, one side |
|---|--:|--:|--:|--:|--:|
| load-share (medians, taken) | {t10:.2f} s | {t50:.2f} s | {t90:.2f} s | {transfer:.2f} s | {grip:.0f} N |
| one sample of Handovers@RPL | 0.05 s | 0.34 s | 0.58 s | 0.42 s | 35 N (giver 18 N) |

## Cost

A transfer takes {ms:.0f} ms of one core (process time, policies and scenarios as above, with the closing of the gripper shared;
load of the machine at the start {load}). A grasp of `results held` takes {held_ms:.0f} ms. {memory}
"""


ENGINES = """## Two engines

The same {trials} received trials in MuJoCo C (float64) and in batched MuJoCo-Warp worlds (float32), both on this CPU.
`C decides`: MuJoCo C contradicts the worlds' contacts, a slip or turn is near a limit, or a world failed, so the result is MuJoCo
C's. `differ`: other outcomes among the rest.

{outcomes}

Differences among the rest: the median, the 95th percentile and the largest.

{numbers}

"""


def rows_of(run: Any, judge: Any, name: str, trials: int) -> tuple[Any, dict[int, bool], int]:
    """Received handovers of a method in the fresh trials, whether each trial of these succeeded, and how many there are."""
    from r2h_batch.closed_loop.transfer.handed import handed_of
    from r2h_batch.judge.reception import reception
    from r2h_batch.methods import oracle

    stored = run.trials("oracle", ["trial_id"])["trial_id"].to_numpy()
    ids = np.sort(stored)[STUDIED : STUDIED + 2 * trials]
    asked, evaluator = judge.trials(ids), judge.evaluator.kinematic
    if name == BOUND:
        answer = oracle.predict(asked, evaluator.scene, evaluator=evaluator, for_="reception")
        scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, asked)
        won = dict(zip(ids.tolist(), scores.success.tolist(), strict=True))
    else:
        poses = stored_poses(run, name, ids)
        scores = evaluator.score(poses["T_obj_ee"], poses["T_world_ee"], asked, stages="pose")
        table = run.trials(name, ["trial_id", "outcome"]).to_pylist()
        won = {r["trial_id"]: r["outcome"] == "success" for r in table}
        won = {i: won[i] for i in ids.tolist()}
    found = reception(scores)
    return handed_of(found, ids, asked, evaluator.scene), won, len(ids)


def stored_poses(run: Any, name: str, ids: Any) -> dict[str, Any]:
    """Poses of some trials of a method, in the order of the ids."""
    import torch

    rows: dict[int, Any] = {}
    for index in sorted(run.entry(name).shards):
        for row in run.shard("poses", name, index).to_pylist():
            rows[row["trial_id"]] = row
    return {
        k: torch.tensor(np.array([rows[i][k] for i in ids.tolist()], np.float32)).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    }


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures of the page."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator, processes
    from r2h_batch.closed_loop.transfer.model import Setting
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reevaluation import Judge

    run = load_run(BASELINES)
    judge = Judge(run)
    scene = judge.evaluator.scene
    simulator = Simulator(scene.robot, tuple(scene.objects), Setting(), 0)
    cases = [*(Case(r, s, 0) for s in SCENARIO for r in RELEASE), *(Case(r, s, 0) for r, s in MORE)]
    parts = Parts(options.parts, {"trials": options.trials, "source": digests(MEASURES)})
    methods: dict[str, Any] = {}
    forces: dict[str, list[float]] = {release: [] for release in RELEASE}
    with processes(simulator, options.processes) as transfer:
        for name in [*run.methods, BOUND]:
            made = parts.get(
                f"transfers of {name}", partial(transfers_of, run, judge, name, options.trials, cases, transfer)
            )
            for release, found in made.pop("forces").items():
                forces[release] += found
            methods[name] = made
            if name != BOUND:
                made["held"] = parts.get(f"held of {name}", partial(held_of, run, judge, name, simulator))
    received, _, _ = rows_of(run, judge, "oracle", options.trials)
    sensitivity, compared = parts.get("sensitivity", lambda: varied(simulator, received[:VARIED_ROWS]))
    return {
        "trials": options.trials,
        "methods": methods,
        "force": {r: [len(x), *np.percentile(x, FORCE_PERCENT).tolist()] for r, x in forces.items()},
        "sensitivity": sensitivity,
        "compared": compared,
        "engines": parts.get("engines", lambda: agreement(simulator, rows_of(run, judge, "oracle", AGREE)[0][:AGREE])),
        "core_ms": parts.get("cost", lambda: cost(simulator, received, cases)),
        "memory": parts.get(
            "memory", lambda: memory_over(options.memory, lambda done: again(simulator, received, done))
        ),
        **made_by(MEASURES),
    }


class Parts:
    """Figures that are measured once: a bench that was stopped goes on with those that are missing.

    Args:
        folder: where they are kept; None: nowhere.
        of: what they depend on. A part of anything else is measured again.
    """

    def __init__(self, folder: Path | None, of: dict[str, Any]) -> None:
        self.folder, self.of = folder, of
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, measured: Callable[[], Any]) -> Any:
        """A part as it is kept, or measured and kept."""
        path = None if self.folder is None else self.folder / f"{name.replace('/', '_')}.json"
        if path is not None and path.is_file():
            kept = json.loads(path.read_text())
            if kept["of"] == self.of:
                print(name, "is kept in", path, flush=True)
                return kept["part"]
        part = measured()
        print(name, {k: v for k, v in part.items() if k not in ("cases", "forces")} if isinstance(part, dict) else part)
        if path is not None:
            path.write_text(json.dumps({"of": self.of, "part": part}))
        return part


def transfers_of(run: Any, judge: Any, name: str, trials: int, cases: list[Any], transfer: Any) -> dict[str, Any]:
    """Outcomes of a method's transfers in all cases, and the forces on the persons who took."""
    handed, won, n = rows_of(run, judge, name, trials)
    begin, parts, done = time.time(), [], 0
    for rows, made in transfer([handed], cases):
        parts.append(made)
        done += len(rows)
        print(f"{name}: {done} of {len(handed)} received rows, {time.time() - begin:.0f} s", flush=True)
    found: dict[str, list[float]] = {release: [] for release in RELEASE}
    for k, case in enumerate(cases):
        if case.scenario == "take":
            found[case.release] += [x for p in parts for x in p[k].transfers.hand_n.tolist() if x > 0]
    return {
        "trials": n,
        "received": len(handed),
        "success": sum(won.values()),
        "cases": [summary(c, [p[k].transfers for p in parts], handed.trial_id, won) for k, c in enumerate(cases)],
        "forces": found,
    }


def cost(simulator: Any, handed: Any, cases: list[Any]) -> float:
    """Core milliseconds of a transfer in this process (median of three groups), with the closing shared by all cases."""
    from r2h_batch.closed_loop.transfer.cases import ROWS

    times = []
    for k in range(3):
        rows = handed[np.arange(k * ROWS, (k + 1) * ROWS) % len(handed)]
        begin = time.process_time()
        simulator(rows, cases)
        times.append(1e3 * (time.process_time() - begin) / (len(rows) * len(cases)))
    return float(np.median(times))


def again(simulator: Any, handed: Any, done: int) -> int:
    """Some more transfers, with persons that are not met before; how many."""
    from r2h_batch.closed_loop.transfer.cases import Case

    rows = handed[:32]
    simulator(rows, [Case("load-share", "take", 1 + done // len(rows))])
    return len(rows)


def held_of(run: Any, judge: Any, name: str, simulator: Any) -> dict[str, Any]:
    """Which grasps of every `HELD_EVERY`th row hold in physics, and core milliseconds a grasp."""
    from r2h_batch.closed_loop.transfer.handed import gripped_of
    from r2h_batch.closed_loop.transfer.held import Lost

    every = np.sort(run.trials(name, ["trial_id"])["trial_id"].to_numpy())
    ids = every[every // 2 % HELD_EVERY == 0]  # the splits take turns
    poses = stored_poses(run, name, ids)
    scores = judge.evaluator.kinematic.score(poses["T_obj_ee"], poses["T_world_ee"], judge.trials(ids), stages="pose")
    gripped = gripped_of(scores, ids)
    begin = time.process_time()
    found = simulator.hold(gripped)
    ms = 1e3 * (time.process_time() - begin) / len(gripped)
    words = [simulator.models.objects[k].name for k in gripped.object_index]
    lost = Counter(word for word, h in zip(words, found.held, strict=True) if not h)
    return {
        "n": len(words),
        "held": int(found.held.sum()),
        **{str(end): found.lost.count(end) for end in Lost},
        "undecided": int(found.undecided.sum()),
        "statics": int((found.carries >= 1.0).sum()),
        "lost": dict(lost.most_common(4)),
        "of": dict(Counter(words)),
        "ms": ms,
    }


def summary(case: Any, parts: list[Any], trial_id: Any, won: dict[int, bool]) -> dict[str, Any]:
    """Outcomes and medians of one case."""
    outcome = [o for p in parts for o in p.outcome]
    taken = np.array([o == "taken" for o in outcome], bool)

    def median(values: list[Any]) -> float | None:
        x = np.concatenate(values)[taken] if len(values) else np.zeros(0)
        x = x[np.isfinite(x)]
        return float(np.median(x)) if len(x) else None

    both = sum(t and won[int(i)] for t, i in zip(taken, trial_id, strict=True))
    return {
        "release": case.release,
        "scenario": case.scenario,
        "outcomes": dict(Counter(outcome)),
        "taken_and_success": int(both),
        "pull_n": median([p.pull_n for p in parts]),
        "grip_n": median([p.grip_n for p in parts]),
        "transfer_s": median([p.transfer_s for p in parts]),
        **{f"t{s}_s": median([p.share_s[:, k] for p in parts]) for k, s in enumerate((10, 50, 90))},
    }


def varied(simulator: Any, handed: Any) -> tuple[dict[str, Any], int]:
    """How many outcomes a change of the model changes, and of how many."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.model import Setting

    cases = [Case(r, s, 0) for r, s in COMPARED]

    def outcomes(one: Any) -> list[str]:
        return [o for made in one(handed, cases) for o in made.transfers.outcome]

    base, found = outcomes(simulator), {}
    for name, change in CHANGES.items():
        other = outcomes(Simulator(simulator.robot, simulator.models.objects, Setting(**change), simulator.seed))
        pairs = Counter(f"{a} -> {b}" for a, b in zip(base, other, strict=True) if a != b)
        found[name] = {"changed": sum(pairs.values()), "pairs": dict(pairs)}
        print(name, found[name], flush=True)
    return found, len(base)


def agreement(simulator: Any, handed: Any) -> dict[str, Any]:
    """How far MuJoCo-Warp's transfers are from MuJoCo C's, case by case."""
    from r2h_batch.closed_loop.transfer.batched import BatchedSimulator
    from r2h_batch.closed_loop.transfer.cases import Case

    cases = [Case(r, s, 0) for r, s in COMPARED]
    batched = BatchedSimulator(simulator.robot, simulator.models.objects, simulator.setting, simulator.seed)
    found: dict[str, Any] = {"trials": len(handed), "cases": {}}
    for one, (two, doubt) in zip(simulator(handed, cases), batched.worlds(handed, cases), strict=True):
        a, b, sure = one.transfers, two.transfers, ~doubt
        pairs = [(x, y) for x, y, s in zip(a.outcome, b.outcome, sure, strict=True) if s and x != y]
        same = sure & np.array([x == y for x, y in zip(a.outcome, b.outcome, strict=True)], bool)
        numbers = {}
        for words, (name, factor, _) in AGREE_IN.items():
            x, y = (getattr(t, name)[same] for t in (a, b))
            off = factor * np.abs(x - y if x.ndim == 1 else x[:, 1] - y[:, 1])
            off = off[np.isfinite(off)]
            numbers[words] = [*np.percentile(off, (50, 95)).tolist(), float(off.max())] if len(off) else None
        found["cases"][f"{one.case.release}, {one.case.scenario}"] = {
            "decided": int(doubt.sum()),
            "differ": {f"{x} -> {y}": k for (x, y), k in Counter(pairs).items()},
            "numbers": numbers,
        }
        print(one.case, found["cases"][f"{one.case.release}, {one.case.scenario}"], flush=True)
    return found


def engines_text(found: dict[str, Any]) -> str:
    """The section of `agreement`."""
    outcomes, numbers = [], []
    for case, c in found["cases"].items():
        which = "; ".join(f"{pair} ({k})" for pair, k in c["differ"].items())
        outcomes.append([case, c["decided"], sum(c["differ"].values()), which or "-"])
    for words, (_, _, unit) in AGREE_IN.items():
        cells = [c["numbers"][words] for c in found["cases"].values()]
        texts = ["-" if x is None else " / ".join(f"{v:.2g}" for v in x) for x in cells]
        numbers.append([f"{words}, {unit}", *texts])
    return ENGINES.format(
        trials=found["trials"],
        outcomes=markdown_table(["case", "C decides", "differ", "which (C -> MuJoCo-Warp)"], outcomes),
        numbers=markdown_table(["", *found["cases"]], numbers),
    )


def agree(trials: int) -> None:
    """Prints the section of `agreement` over the oracle's first received trials that nothing was tuned on."""
    from r2h_batch.closed_loop.transfer.cases import Simulator
    from r2h_batch.closed_loop.transfer.model import Setting
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reevaluation import Judge

    run = load_run(BASELINES)
    judge = Judge(run)
    scene = judge.evaluator.scene
    handed, _, _ = rows_of(run, judge, "oracle", trials)
    simulator = Simulator(scene.robot, tuple(scene.objects), Setting(), 0)
    print(engines_text(agreement(simulator, handed[:trials])))


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    from r2h_batch.report.statistics.aggregate import wilson_interval

    def rate(count: int, n: int) -> str:
        low, high = wilson_interval(count, n)
        return f"{100 * count / n:.0f} [{100 * float(low):.0f}, {100 * float(high):.0f}]" if n else "-"

    def number(x: float | None, digits: int) -> str:
        return "-" if x is None else f"{x:.{digits}f}"

    funnel, policies, ends = [], [], []
    for name, m in data["methods"].items():
        by = {(c["release"], c["scenario"]): c for c in m["cases"]}
        own, n = by["load-share", "take"], m["trials"]
        taken = own["outcomes"].get("taken", 0)
        shares = (m["success"], m["received"], taken, own["taken_and_success"])
        funnel.append([name, n, *(f"{100 * k / n:.0f}" for k in shares)])
        for release in RELEASE:
            take, touch = by[release, "take"], by[release, "touch"]
            got = m["received"]
            rates = [rate(c["outcomes"].get(k, 0), got) for c, k in ((take, "taken"), (touch, "kept"))]
            policies.append([name, release, got, *rates, number(take["pull_n"], 1), number(take["transfer_s"], 2)])
            ends.append([name, release, *(take["outcomes"].get(o, 0) for o in OTHER_ENDS)])
    some = [k for k in range(len(OTHER_ENDS)) if any(e[2 + k] for e in ends)]
    ends = [[*e[:2], *(e[2 + k] for k in some)] for e in ends if any(e[2:])]
    more, held, held_ms = [], [], float("nan")
    for name, m in data["methods"].items():
        by = {(c["release"], c["scenario"]): c for c in m["cases"]}
        more.append([name, m["received"], *(rate(by[k]["outcomes"].get("taken", 0), m["received"]) for k in MORE)])
        if h := m.get("held"):
            lost = ", ".join(f"{w.replace('_', ' ')} {k} of {h['of'][w]}" for w, k in h["lost"].items())
            percents = (f"{100 * h[k] / h['n']:.1f}" for k in ("closing", "weight", "undecided", "statics"))
            held.append([name, h["n"], rate(h["held"], h["n"]), *percents, lost or "-"])
            held_ms = h["ms"]
    force = [[r, int(n), *(f"{x:.1f}" for x in numbers)] for r, (n, *numbers) in data["force"].items()]
    oracle = {(c["release"], c["scenario"]): c for c in data["methods"]["oracle"]["cases"]}["load-share", "take"]
    changes = [
        [name, f["changed"], "; ".join(f"{pair} ({k})" for pair, k in f["pairs"].items()) or "-"]
        for name, f in data["sensitivity"].items()
    ]
    return HEAD.format(
        trials=data["trials"],
        commit=str(data["commit"])[:12],
        funnel=markdown_table(["Method", "n", "SR", "received", "taken", "taken and success"], funnel),
        policies=markdown_table(["Method", "policy", "received", "taken", "kept", "pull, N", "time, s"], policies),
        ends=markdown_table(["Method", "policy", *(OTHER_ENDS[k].replace("_", " ") for k in some)], ends),
        more=markdown_table(["Method", "received", *(f"{r}, {w}" for r, w in MORE)], more),
        force=markdown_table(["policy", "n", *(f"{p} %" for p in FORCE_PERCENT)], force),
        held=markdown_table([*HELD_HEAD, "lost most (of)"], held),
        held_ms=held_ms,
        memory=memory_text(data["memory"]),
        compared=data["compared"],
        cases=", ".join(f"{r} with {s}" for r, s in COMPARED),
        sensitivity=markdown_table(["change", "outcomes", "which"], changes),
        engines=engines_text(data["engines"]) if "engines" in data else "",
        **{k: oracle[f"{k}_s"] for k in ("t10", "t50", "t90", "transfer")},
        grip=oracle["grip_n"],
        ms=data["core_ms"],
        load=data["hardware"]["load_at_start"],
    )


def memory_text(memory: dict[str, Any]) -> str:
    """How the resident memory grows over the second half of the transfers."""
    mib, n = memory["mib"], memory["trials"]
    half = len(mib) // 2
    grows = 1e3 * (mib[-1] - mib[half - 1]) / (n * (len(mib) - half) / len(mib))
    return (
        f"The memory of one process after each tenth of {n:,} transfers: {', '.join(map(str, mib))} MiB. In the second half it"
        f" grows by {grows:.1f} MiB a thousand."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="of each split")
    parser.add_argument("--processes", type=int, default=1, help="that simulate")
    parser.add_argument("--parts", type=Path, help="folder where finished parts are kept: a stopped bench goes on")
    parser.add_argument("--memory", type=int, default=2000, help="transfers over which memory is measured")
    parser.add_argument("--agree", type=int, default=0, help="compare the engines on so many received trials")
    if (count := parser.parse_known_args()[0].agree) > 0:
        return agree(count)
    page_from(parser, STORED, PAGE, measure, markdown)


if __name__ == "__main__":
    main()
