"""Transfers after the arm stands still: docs/results/transfer.md.

`python bench/transfer.py` simulates the transfers of the shipped rows of r2h-v2 (the first `--trials` of each split) and of
`oracle,for=reception` with `load-share`, and those of the first `--rows` received ones with five policies, take and touch.
For `STEPS_METHODS` it divides the time step by two and four. For the oracle it varies friction and mass. It asks which objects
the closed gripper holds for 1 s, and measures the cost of a transfer and the memory of `--memory` transfers. It holds MuJoCo-Warp
against MuJoCo C on this CPU over `AGREE` received trials; `--agree N` prints this alone and writes nothing. `--render` writes the
page again from the JSON. `--parts FOLDER` keeps what is done: started again, also with more trials, it goes on with what is
missing.
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
BASELINES = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
BOUND = "oracle,for=reception"
RELEASE = ("never", "timer", "threshold", "load-share", "probe")
SCENARIO = ("take", "touch")
MORE = tuple((r, s) for s in ("pull-early", "weak") for r in ("threshold", "load-share"))
"""Cases beside the policies with `SCENARIO`."""
FORCE_PERCENT = (50, 90, 99)
HELD_HEAD = ("Method", "n", "physically stable", "lost in closing", "under the weight", "undecided", "statics")
HELD_EVERY = 10
"""One in so many trials of each split is asked whether the gripper holds its object."""
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
    "skin friction 0.4": {"skin_friction": 0.4 / 0.6},
    "mass x 1.5": {"mass": 1.5},
    "pad friction 0.5": {"pad_friction": 0.5},
}
COMPARED = (("load-share", "take"), ("threshold", "take"), ("load-share", "touch"))
VARIED_ROWS = 40
"""Received rows of the oracle that the changes are tried on."""
STEPS_METHODS = ("oracle", "FC-Handover (oracle hand + noise)", "Handover-VA (oracle labels + noise)")
"""The mark `undecided` was not chosen on rows of the last two."""
STEPS_ROWS, STEPS_TRIALS = 100, 60
"""Received rows of each that smaller time steps are tried on, among so many trials of each split."""
GROUPS = {
    "6 to 12 years": ("age_years", 0, 13),
    "13 to 49 years": ("age_years", 13, 50),
    "50 to 69 years": ("age_years", 50, 70),
    "70 to 90 years": ("age_years", 70, 200),
    "standing": ("seated", 0, 0.5),
    "seated": ("seated", 0.5, 2),
    "men": ("female", 0, 0.5),
    "women": ("female", 0.5, 2),
    "shorter than 1.5 m": ("stature_m", 0, 1.5),
    "1.5 to 1.75 m": ("stature_m", 1.5, 1.75),
    "taller": ("stature_m", 1.75, 3),
}
WEIGHTS = {"below 1 N": (0, 1), "1 to 4 N": (1, 4), "4 N and more": (4, 1000)}

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

BLOCK = 50
"""Trials of each split that are measured, and kept, at a time."""
ROW_NUMBERS = ("pull_n", "grip_n", "hand_n", "transfer_s", "share_s", "robot_slip_m")

AGREE = 60
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
simulated {trials} trials of each split of r2h-v2 with one person each: {objects} of its {among} objects, people of every size
(bench/results/transfer.json, commit {commit}). The model and `probe` were fitted on 44 trials of r2h-v1. For your method run
`r2h-batch results transfer runs/mine`.

## From success to taken

Percent of all trials, with the default policy `load-share`. `taken and success`: the verdict of the sweep holds too. `undecided`:
percent of the received trials whose end is within the model's uncertainty ([definition](../transfer.md#outcomes)).

{funnel}

## By people

Percent of the received trials that were taken, of all methods together, with `load-share`. Brackets: 95 % (Wilson). A trial
counts once for each method that answers it, so the groups are no independent samples.

{people}

The same by the weight of the object. Heavier objects [take people longer](../transfer.md#people-who-feel-weight).

{weights}

## Policies

Percent of the first {rows} received trials of each method. Brackets: 95 % (Wilson) over trials, each with a person of its
own. `kept`: under a mere touch. `?`: how many percent of the trials of the column before are undecided. Pulls and times, and what
remains of their order, stand with [other persons](persons.md).

{policies}

## Early pulls and weak grips

Percent taken of the received trials when the person pulls at 30 cm/s from the beginning of the grip, or grips and pulls weakly.

{more}

## Force on the person

Percentiles of the largest force of the arm on the hand, N, over the received trials of all methods with `take`. It says nothing
about pain or safety: nothing strikes the hand, and it has no skin.

{force}

## Physically stable

Percent of the grasps past Stability that hold in the simulation of `results held`: after closing, and under the weight for 1 s.
They are those of one in ten trials of each split. `undecided`: too near a limit to say. `statics`: friction balances the weight
on the settled posture.

{held}

## Other ends

Counts of received trials that were not taken, with `take`. Methods, policies and ends that never occur are left out.

{ends}

## Time step

Outcomes that another time step changes ({cases}; the first {steps_rows} received trials of each method at most). `not marked`: of
these, the ones that the mark [undecided](../transfer.md#outcomes) misses at the usual step h. `marked`: of all transfers.

{steps}

Of {stepped} transfers, a half or a quarter of the step changes {steps_changed}. Of these, {steps_missed} {are} not
marked{steps_which}.
An object that slides under the finger may stick to the pads in another place: the finger and the wrist then feel another force.
Share of all transfers that are marked, by policy and scenario: {steps_marked}.

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

A transfer takes {ms:.0f} ms of one core: process time, with policies and scenarios as above. Transfers of a row share the closing
of the gripper. The load of the machine at the start was {load}. {halved}A grasp of `results held` takes {held_ms:.0f} ms.
{memory}
"""


ENGINES = """## Two engines

The same {trials} received trials in MuJoCo C (float64) and in batched MuJoCo-Warp worlds (float32), both on this CPU.
`C decides`: MuJoCo C contradicts the worlds' contacts, a slip or turn is near a limit, or a world failed, so the result is MuJoCo
C's. `differ`: other outcomes among the rest.

{outcomes}

Differences among the rest: the median, the 95th percentile and the largest.

{numbers}

"""


def rows_of(run: Any, judge: Any, name: str, first: int, last: int) -> tuple[Any, dict[int, bool]]:
    """Received handovers of a method in trials `first` to `last` of each split, and whether each of these trials succeeded."""
    from r2h_batch.closed_loop.transfer.handed import handed_of
    from r2h_batch.judge.reception import reception
    from r2h_batch.methods import oracle

    stored = np.sort(run.trials("oracle", ["trial_id"])["trial_id"].to_numpy())
    ids = np.sort(np.concatenate([stored[stored % 2 == split][first:last] for split in (0, 1)]))
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
    return handed_of(found, ids, asked, evaluator.scene), won


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

    about = made_by(MEASURES)
    run = load_run(BASELINES)
    judge = Judge(run)
    scene = judge.evaluator.scene
    simulator = Simulator(scene.robot, tuple(scene.objects), Setting(), 0)
    own = Case("load-share", "take", 0)
    cases = [*(Case(r, s, 0) for s in SCENARIO for r in RELEASE), *(Case(r, s, 0) for r, s in MORE)]
    parts = Parts(options.parts, {"rows": options.rows, "source": digests(MEASURES)})
    names = [*run.methods, BOUND]
    blocks: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    few: dict[str, dict[str, Any]] = {}
    with processes(simulator, options.processes) as transfer:
        for first in range(0, options.trials, BLOCK):
            for name in names:
                last = min(first + BLOCK, options.trials)
                asked = partial(block_of, run, judge, name, (first, last), [own], transfer)
                blocks[name].append(parts.get(f"{name}, trials {first} to {last}", asked))
        for name in names:
            several = partial(block_of, run, judge, name, (0, options.rows), cases, transfer, options.rows)
            few[name] = parts.get(f"{name}, all policies", several)
    received, _ = rows_of(run, judge, "oracle", 0, STEPS_TRIALS)
    steps = {
        name: parts.get(f"steps of {name}", partial(stepped, run, judge, name, simulator)) for name in STEPS_METHODS
    }
    held = {name: parts.get(f"held of {name}", partial(held_of, run, judge, name, simulator)) for name in run.methods}
    sensitivity, compared = parts.get("sensitivity", lambda: varied(simulator, received[:VARIED_ROWS]))
    methods = {name: together(blocks[name], few[name]) | {"held": held.get(name)} for name in names}
    force = {
        r: [
            x
            for one in few.values()
            for c in one["cases"]
            if (c["release"], c["scenario"]) == (r, "take")
            for x in c["hand_n"]
            if x > 0
        ]
        for r in RELEASE
    }
    return {
        "trials": options.trials,
        "rows": options.rows,
        "objects": len(set().union(*(b["objects"] for b in blocks["oracle"]))),
        "among": len(scene.objects),
        "steps": steps,
        "methods": methods,
        "force": {r: [len(x), *np.percentile(x, FORCE_PERCENT).tolist()] for r, x in force.items()},
        "sensitivity": sensitivity,
        "compared": compared,
        "engines": parts.get("engines", lambda: agreement(simulator, received[:AGREE])),
        "core_ms": parts.get("cost", lambda: cost(simulator, received, cases[: len(SCENARIO) * len(RELEASE)])),
        "memory": parts.get(
            "memory", lambda: memory_over(options.memory, lambda done: again(simulator, received, done))
        ),
        **about,
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
        begin = time.time()
        part = measured()
        print(f"{name}: {time.time() - begin:.0f} s", flush=True)
        if path is not None:
            path.write_text(json.dumps({"of": self.of, "part": part}))
        return part


def block_of(
    run: Any,
    judge: Any,
    name: str,
    among: tuple[int, int],
    cases: list[Any],
    transfer: Any,
    most: int | None = None,
) -> dict[str, Any]:
    """Outcomes of a method's received rows in some trials of each split, in each case: a number a row."""
    from r2h_batch.verdicts import PERSON as COLUMNS

    handed, won = rows_of(run, judge, name, *among)
    handed = handed[:most] if most else handed
    made, done = [], 0
    for rows, some in transfer([handed], cases):
        made.append(some)
        done += len(rows)
        print(f"{name}, {among}: {done} of {len(handed)} rows", flush=True)
    person = judge.trials(handed.trial_id).person.cpu().numpy()
    ends = []
    for k, case in enumerate(cases):
        t = [m[k].transfers for m in made]
        numbers = {n: np.concatenate([getattr(one, n) for one in t]).tolist() for n in ROW_NUMBERS}
        outcome = [o for one in t for o in one.outcome]
        marks, halved = (np.concatenate([getattr(one, n) for one in t]) for n in ("undecided", "halved"))
        ends.append(
            {
                "release": case.release,
                "scenario": case.scenario,
                "outcome": outcome,
                "undecided": marks.tolist(),
                "halved": halved.tolist(),
                **numbers,
            }
        )
    names = [judge.evaluator.scene.objects[i].name for i in judge.trials(np.array(list(won))).object_index.tolist()]
    return {
        "won": list(won.values()),
        "objects": sorted(set(names)),
        "won_received": [won[i] for i in handed.trial_id.tolist()],
        "weight_n": handed.weight_n.tolist(),
        "person": {c: person[:, COLUMNS.index(c)].tolist() for c in sorted({g[0] for g in GROUPS.values()})},
        "cases": ends,
    }


def together(blocks: list[dict[str, Any]], few: dict[str, Any]) -> dict[str, Any]:
    """Counts and medians of a method over all of its blocks, and over the rows of all cases."""

    def joined(key: str) -> list[Any]:
        return [x for b in blocks for x in b[key]]

    every = {k: [x for b in blocks for x in b["cases"][0][k]] for k in ("outcome", "undecided", "halved", *ROW_NUMBERS)}
    every |= {k: blocks[0]["cases"][0][k] for k in ("release", "scenario")}
    taken = np.array([o == "taken" for o in every["outcome"]], bool)
    weight = np.array(joined("weight_n"))
    inside = {}
    for name, (column, low, high) in GROUPS.items():
        value = np.array([x for b in blocks for x in b["person"][column]])
        inside[name] = (low <= value) & (value < high)
    for name, (low, high) in WEIGHTS.items():
        inside[name] = (low <= weight) & (weight < high)
    return {
        "trials": len(joined("won")),
        "success": sum(joined("won")),
        "received": len(taken),
        "all": summary(every, joined("won_received")),
        "undecided": sum(every["undecided"]),
        "groups": {name: [int(rows.sum()), int(taken[rows].sum())] for name, rows in inside.items()},
        "first": len(few["weight_n"]),
        "cases": [summary(c, few["won_received"]) for c in few["cases"]],
    }


def stepped(run: Any, judge: Any, name: str, simulator: Any) -> dict[str, Any]:
    """Outcomes of a method that half and a quarter of the time step change, and which of them are marked."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.model import STEPS, Setting

    handed = rows_of(run, judge, name, 0, STEPS_TRIALS)[0][:STEPS_ROWS]
    words_of = [simulator.models.objects[k].name for k in handed.object_index]
    cases = [Case(r, s, 0) for r, s in COMPARED]
    base, found = simulator(handed, cases), {}
    marks = [m.transfers.undecided for m in base]
    for words, times in (("h/2", 2), ("h/4", 4)):
        setting = Setting(steps=times * STEPS)
        other = Simulator(simulator.robot, simulator.models.objects, setting, simulator.seed).once(handed, cases)
        found[words] = [
            {
                "case": f"{one.case.release}, {one.case.scenario}",
                "trial": int(handed.trial_id[i]),
                "object": words_of[i],
                "ends": f"{a} -> {b}",
                "marked": bool(own[i]),
            }
            for one, two, own in zip(base, other, marks, strict=True)
            for i, (a, b) in enumerate(zip(one.transfers.outcome, two.transfers.outcome, strict=True))
            if a != b
        ]
        print(name, words, found[words], flush=True)
    return {
        "rows": len(handed),
        "marked": {f"{r}, {s}": int(m.sum()) for (r, s), m in zip(COMPARED, marks, strict=True)},
        "steps": found,
    }


def steps_text(found: dict[str, Any]) -> dict[str, Any]:
    """The table of `stepped`, and the words below it."""
    lines = []
    for name, m in found.items():
        for words, changed in m["steps"].items():
            missed, pairs = sum(not c["marked"] for c in changed), Counter(c["ends"] for c in changed)
            which = "; ".join(f"{p} ({k})" for p, k in pairs.items())
            n = m["rows"] * len(m["marked"])
            lines.append([name, f"{words} against h", n, len(changed), missed, sum(m["marked"].values()), which or "-"])
    where = {(name, c["case"], c["trial"]): c for name, m in found.items() for s in m["steps"].values() for c in s}
    unmarked = {key: c for key, c in where.items() if not c["marked"]}
    what = "; ".join(
        f"{c['object'].replace('_', ' ')} of {name}, {case}: {c['ends']}" for (name, case, _), c in unmarked.items()
    )
    rows = sum(m["rows"] for m in found.values())
    shares = {case: sum(m["marked"][case] for m in found.values()) for case in next(iter(found.values()))["marked"]}
    return {
        "steps": markdown_table(["Method", "step", "n", "changed", "not marked", "marked", "which"], lines),
        "stepped": rows * len(shares),
        "steps_rows": STEPS_ROWS,
        "steps_changed": len(where),
        "steps_missed": len(unmarked),
        "are": "is" if len(unmarked) == 1 else "are",
        "steps_which": f" ({what})" if unmarked else "",
        "steps_marked": "; ".join(f"{case}: {100 * k / rows:.0f} %" for case, k in shares.items()),
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


def summary(case: dict[str, Any], won: list[bool]) -> dict[str, Any]:
    """Outcomes of one case, and medians over what was taken."""
    taken = np.array([o == "taken" for o in case["outcome"]], bool)

    def median(values: Any) -> float | None:
        x = np.asarray(values, np.float64)[taken]
        x = x[np.isfinite(x)]
        return float(np.median(x)) if len(x) else None

    share = np.asarray(case["share_s"], np.float64).reshape(-1, 3)
    return {
        "release": case["release"],
        "scenario": case["scenario"],
        "outcomes": dict(Counter(case["outcome"])),
        **{k: int(sum(case[k])) for k in ("undecided", "halved")},
        "taken_and_success": int((taken & np.array(won, bool)).sum()),
        **{k: median(case[k]) for k in ("pull_n", "grip_n", "transfer_s")},
        **{f"t{s}_s": median(share[:, k]) for k, s in enumerate((10, 50, 90))},
    }


def varied(simulator: Any, handed: Any) -> tuple[dict[str, Any], int]:
    """How many outcomes a change of the model changes, and of how many."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.model import Setting

    cases = [Case(r, s, 0) for r, s in COMPARED]

    def outcomes(one: Any) -> list[str]:
        return [o for made in one.once(handed, cases) for o in made.transfers.outcome]

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
    for one, (two, doubt) in zip(simulator.once(handed, cases), batched.worlds(handed, cases), strict=True):
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
    handed, _ = rows_of(run, judge, "oracle", 0, trials)
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
    groups: Counter[str] = Counter()
    among: Counter[str] = Counter()
    for name, m in data["methods"].items():
        by = {(c["release"], c["scenario"]): c for c in m["cases"]}
        own, n = m["all"], m["trials"]
        for group, (count, taken) in m["groups"].items():
            among[group] += count
            groups[group] += taken
        taken = own["outcomes"].get("taken", 0)
        shares = (m["success"], m["received"], taken, own["taken_and_success"])
        marked = f"{100 * m['undecided'] / m['received']:.1f}" if m["received"] else "-"
        funnel.append([name, n, *(f"{100 * k / n:.0f}" for k in shares), marked])
        for release in RELEASE:
            take, touch = by[release, "take"], by[release, "touch"]
            got = m["first"]
            rates = [
                cell
                for c, k in ((take, "taken"), (touch, "kept"))
                for cell in (rate(c["outcomes"].get(k, 0), got), f"{100 * c['undecided'] / got:.0f}" if got else "-")
            ]
            policies.append([name, release, got, *rates])
            ends.append([name, release, *(take["outcomes"].get(o, 0) for o in OTHER_ENDS)])
    some = [k for k in range(len(OTHER_ENDS)) if any(e[2 + k] for e in ends)]
    ends = [[*e[:2], *(e[2 + k] for k in some)] for e in ends if any(e[2:])]
    more, held, held_ms = [], [], float("nan")
    for name, m in data["methods"].items():
        by = {(c["release"], c["scenario"]): c for c in m["cases"]}
        more.append([name, m["first"], *(rate(by[k]["outcomes"].get("taken", 0), m["first"]) for k in MORE)])
        if h := m.get("held"):
            lost = ", ".join(f"{w.replace('_', ' ')} {k} of {h['of'][w]}" for w, k in h["lost"].items())
            percents = (f"{100 * h[k] / h['n']:.1f}" for k in ("closing", "weight", "undecided", "statics"))
            held.append([name, h["n"], rate(h["held"], h["n"]), *percents, lost or "-"])
            held_ms = h["ms"]
    force = [[r, int(n), *(f"{x:.1f}" for x in numbers)] for r, (n, *numbers) in data["force"].items()]
    oracle = data["methods"]["oracle"]["all"]
    taken = [[g, among[g], rate(groups[g], among[g])] for g in (*GROUPS, *WEIGHTS)]
    changes = [
        [name, f["changed"], "; ".join(f"{pair} ({k})" for pair, k in f["pairs"].items()) or "-"]
        for name, f in data["sensitivity"].items()
    ]
    return HEAD.format(
        trials=data["trials"],
        commit=str(data["commit"])[:12],
        objects=data["objects"],
        among=data["among"],
        rows=data["rows"],
        people=markdown_table(["receivers", "received", "taken"], taken[: len(GROUPS)]),
        weights=markdown_table(["weight", "received", "taken"], taken[len(GROUPS) :]),
        **steps_text(data["steps"]),
        funnel=markdown_table(["Method", "n", "SR", "received", "taken", "taken and success", "undecided"], funnel),
        policies=markdown_table(["Method", "policy", "received", "taken", "?", "kept", "?"], policies),
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
        halved=halved_text(data["methods"]),
        load=data["hardware"]["load_at_start"],
    )


def halved_text(methods: dict[str, Any]) -> str:
    """How many touches ask for half the step."""
    touches = [c for m in methods.values() for c in m["cases"] if c["scenario"] == "touch" and "halved" in c]
    count, n = sum(c["halved"] for c in touches), sum(sum(c["outcomes"].values()) for c in touches)
    return f"{100 * count / n:.0f} % of the touches are simulated with half the step too. " if n else ""


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
    parser.add_argument("--trials", type=int, default=200, help="of each split")
    parser.add_argument("--rows", type=int, default=30, help="received trials of each method with every policy")
    parser.add_argument("--processes", type=int, default=1, help="that simulate")
    parser.add_argument("--parts", type=Path, help="folder where finished parts are kept: a stopped bench goes on")
    parser.add_argument("--memory", type=int, default=500, help="transfers over which memory is measured")
    parser.add_argument("--agree", type=int, default=0, help="compare the engines on so many received trials")
    if (count := parser.parse_known_args()[0].agree) > 0:
        return agree(count)
    page_from(parser, STORED, PAGE, measure, markdown)


if __name__ == "__main__":
    main()
