"""Which orders of release policies survive other persons: docs/results/persons.md.

`python bench/persons.py` simulates the transfers of the oracle's received trials of r2h-v2 with four policies, and halves and
doubles one range of the person at a time. `--instances` takes the first objects of each family alone: the receiving grasps of
others take a CPU minute each when they are asked for the first time. `--render` writes the page again from the JSON.
"""

import argparse
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from
from transfer import stored_poses

PAGE = ROOT / "docs" / "results" / "persons.md"
STORED = ROOT / "bench" / "results" / "persons.json"
BASELINES = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
MEASURES = (
    "bench/persons.py",
    "r2h_batch/closed_loop/transfer",
    "r2h_batch/judge/grasp_physics.py",
    "r2h_batch/judge/reception.py",
    "r2h_batch/trials/holding/capacity.py",
)
PERSON = {"stiffness": "arm_n_m", "grip": "grip", "pull": "pull_n", "pause": "pause_s", "load time": "load_time"}
"""Fields of `Setting` that are halved and doubled, by the words of the page."""
ORDERED = ("timer", "threshold", "load-share", "probe")
NUMBERS = ("taken", "pull_n", "transfer_s")
SURE = 0.05
"""A policy takes more, or is pulled less, or is faster, if so few pairs would show it by chance (sign test, two sides)."""

HEAD = """# Persons: which orders of release policies survive

See what the numbers of the [simulated person](../transfer.md#people-who-feel-weight) decide. Stiffness, grip, pull, pause and
load time are inputs. If another range reverses the order of two policies, this order is an input too.
`python bench/persons.py --instances {instances} --rows {rows}` took the oracle's first {rows} received trials of r2h-v2, with
{objects} of its {among} objects. Each trial has one person, and people have every size (bench/results/persons.json, commit
{commit}; load of the machine at the start {load}).

## Ranges halved and doubled

One range at a time. A cell has three numbers: the percent taken, then two medians. They are of the largest pull (N) and of the
time until the gripper is free (s). Both medians are of the taken trials.

{ranges}

## What remains

{orders}

{rows} trials are few: an order that is missing here may exist.
"""


def ids_of(run: Any, name: str, instances: int) -> Any:
    """Stored trials of a method, in order: those of the first instances of each family of objects."""
    table = run.trials(name, ["trial_id", "object"])
    kept = [int(o.rsplit("_", 1)[1]) < instances for o in table["object"].to_pylist()]
    return np.sort(table["trial_id"].to_numpy()[np.array(kept, bool)])


def received_of(run: Any, judge: Any, options: argparse.Namespace) -> Any:
    """The oracle's first received handovers."""
    from r2h_batch.closed_loop.transfer.handed import handed_of
    from r2h_batch.judge.reception import reception

    ids, evaluator = ids_of(run, "oracle", options.instances)[: 2 * options.rows], judge.evaluator.kinematic
    poses, asked = stored_poses(run, "oracle", ids), judge.trials(ids)
    scores = evaluator.score(poses["T_obj_ee"], poses["T_world_ee"], asked, stages="pose")
    return handed_of(reception(scores), ids, asked, evaluator.scene)[: options.rows]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures of the page."""
    from r2h_batch.closed_loop.transfer.cases import Simulator
    from r2h_batch.closed_loop.transfer.model import Setting
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reevaluation import Judge

    about = made_by(MEASURES)
    run = load_run(BASELINES)
    judge = Judge(run)
    scene = judge.evaluator.scene
    received = received_of(run, judge, options)
    print(len(received), "received", flush=True)
    simulator = Simulator(scene.robot, tuple(scene.objects), Setting(), 0)
    return {
        "instances": options.instances,
        "objects": len(set(received.object_index.tolist())),
        "among": len(scene.objects),
        "ranges": ranged(simulator, received),
        **about,
    }


def ranged(simulator: Any, handed: Any) -> dict[str, Any]:
    """Outcomes, pulls and times of policies with one range of the person halved or doubled, and the orders that hold in all."""
    from r2h_batch.closed_loop.transfer.cases import Case, Simulator
    from r2h_batch.closed_loop.transfer.model import Setting

    cases = [Case(r, "take", 0) for r in ORDERED]
    changes: dict[str, dict[str, Any]] = {
        "as drawn": {},
        **{f"{w} x {f:g}": {k: f} for w, k in PERSON.items() for f in (0.5, 2.0)},
    }
    found: dict[str, Any] = {"rows": len(handed), "settings": {}}
    orders: dict[str, list[set[str]]] = {number: [] for number in NUMBERS}
    for words, change in changes.items():
        one = Simulator(simulator.robot, simulator.models.objects, Setting(**change), simulator.seed)
        made = {c.release: m.transfers for c, m in zip(cases, one.once(handed, cases), strict=True)}
        taken = {r: np.array([o == "taken" for o in t.outcome], bool) for r, t in made.items()}
        found["settings"][words] = {
            r: {
                "taken": int(taken[r].sum()),
                **{k: float(np.median(getattr(t, k)[taken[r]])) for k in ("pull_n", "transfer_s") if taken[r].any()},
            }
            for r, t in made.items()
        }
        for number in NUMBERS:
            orders[number].append(set())
            for a in ORDERED:
                for b in ORDERED:
                    if number == "taken":
                        more, less = (taken[a] & ~taken[b]).sum(), (taken[b] & ~taken[a]).sum()
                    else:
                        both = taken[a] & taken[b]
                        off = getattr(made[b], number)[both] - getattr(made[a], number)[both]
                        more, less = (off > 1e-6).sum(), (off < -1e-6).sum()
                    if surely(int(more), int(less)):
                        orders[number][-1].add(f"{a}|{b}")
        print(words, found["settings"][words], flush=True)
    found["orders"] = {k: sorted(set.intersection(*v)) for k, v in orders.items()}
    found["once"] = {k: sorted(set.union(*v)) for k, v in orders.items()}
    return found


def surely(more: int, less: int) -> bool:
    """Whether more pairs go one way than chance explains (sign test)."""
    from scipy.stats import binomtest

    return more > less and binomtest(more, more + less).pvalue < SURE


def ranges_text(found: dict[str, Any]) -> str:
    """A row for each setting, a cell for each policy."""
    cells = []
    for words, by in found["settings"].items():
        texts = [
            f"{100 * c['taken'] / found['rows']:.0f} % / {c['pull_n']:.1f} / {c['transfer_s']:.2f}"
            if c["taken"]
            else "0 %"
            for c in (by[r] for r in ORDERED)
        ]
        cells.append([words, *texts])
    return markdown_table(["persons", *ORDERED], cells)


def orders_text(found: dict[str, Any]) -> str:
    """Which orders of two policies hold in every setting, and how many hold in some settings alone."""
    settings, lines = len(found["settings"]), []
    said = {"taken": "takes more than", "pull_n": "is pulled less than", "transfer_s": "is faster than"}
    for number, words in said.items():
        held, once = found["orders"][number], found["once"][number]
        pairs = "; ".join(f"`{a}` {words} `{b}`" for a, b in (p.split("|") for p in held))
        lines.append([words, pairs or "none", len(once) - len(held)])
    head = (
        f"Orders of two policies over the same trials (sign test, p < {SURE:g} in each setting). We do not claim the orders\n"
        "that hold in some settings alone."
    )
    table = markdown_table(["a policy", f"orders in all {settings} settings", "orders in some alone"], lines, left=True)
    return f"{head}\n\n{table}"


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    return HEAD.format(
        rows=data["ranges"]["rows"],
        instances=data["instances"],
        objects=data["objects"],
        among=data["among"],
        commit=str(data["commit"])[:12],
        load=data["hardware"]["load_at_start"],
        ranges=ranges_text(data["ranges"]),
        orders=orders_text(data["ranges"]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200, help="received trials")
    parser.add_argument("--instances", type=int, default=6, help="of each family of objects")
    page_from(parser, STORED, PAGE, measure, markdown)


if __name__ == "__main__":
    main()
