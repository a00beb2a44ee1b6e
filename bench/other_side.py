"""Objects that the draft r2h-v3 draws again in every trial: does a fuller search find a whole way, as they lie and turned over?

`python bench/other_side.py --json bench/results/other_side.json` takes the trials as they were drawn first. It asks Pick about
the oracle's candidates, then about grasps sampled from above, many more than a search samples, and looks for handover poses as
the oracle does. Then it turns each object over and does the same.
"""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from _report import Report, arguments

MEASURES = (
    "bench/other_side.py",
    "kernels/plan",
    "r2h_batch/evaluate.py",
    "r2h_batch/judge/pick.py",
    "r2h_batch/methods/from_table.py",
    "r2h_batch/methods/grasps.py",
    "r2h_batch/methods/oracle.py",
    "r2h_batch/observe/moment.py",
)
SAMPLED, ENOUGH = 300, 3000
"""Grasps from above, and the number that they are chosen from: ten and 25 times what the robust search takes."""
ROUNDS = 64


def main() -> None:
    parser = arguments(__doc__)
    options = parser.parse_args()
    report = Report(MEASURES)
    from r2h_batch.config import EvalConfig, ExecConfig
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.methods import oracle
    from r2h_batch.protocols.registry import named_benchmark

    draft = named_benchmark("r2h-v3-draft")
    judge = Evaluator(replace(draft, certified=None), EvalConfig(execute=ExecConfig(sim="none")))
    known = draft.certified
    assert known is not None
    trials = judge.benchmark.trials_with_ids(torch.from_numpy(known.trial_id))
    again = Counter(trials.object_index.numpy()[known.redraws > 0].tolist())
    every = Counter(trials.object_index.numpy().tolist())
    never = sorted((k for k in again if again[k] == every[k]), key=lambda k: judge.scene.objects[k].name)
    report.add("other_side.objects", len(never))
    report.add("other_side.trials", sum(every[k] for k in never))
    report.add("other_side.redrawn", sum(again.values()))
    report.add("other_side.sampled", SAMPLED)
    report.add("other_side.enough", ENOUGH)
    usable = oracle.usable_grasps(judge)
    for k in never:
        own = trials[trials.object_index == k]
        name = f"other_side.{judge.scene.objects[k].name}"
        report.add(f"{name}.trials", len(own))
        candidates = usable.T_obj_ee[usable.first[k] : usable.first[k] + usable.number[k]]
        report.add(f"{name}.candidates", len(candidates))
        report.add(f"{name}.candidates_in_table", in_table(judge, own[:1], candidates))
        for side in ("drawn", "turned"):
            if side == "turned":
                turn_over(judge, own, k)
            for field, value in searched(judge, own, k).items():
                report.add(f"{name}.{side}.{field}", value)
    report.write(options.json)


def searched(judge: Any, own: Any, k: int) -> dict[str, Any]:
    """Figures of a search with grasps from above, for trials of one object."""
    from r2h_batch.methods import oracle
    from r2h_batch.methods.from_table import BACKS, PickedGrasps, picked_grasps
    from r2h_batch.methods.grasps import NoGraspError, sample_grasps
    from r2h_batch.methods.oracle import spare_margins
    from r2h_batch.observe.known import known_moments
    from r2h_batch.types import Outcome

    T_world_obj = known_moments(judge.scene).of(own)
    found: dict[str, Any] = {"sampled": 0, "pass": 0, "in_table": 0, "picked": 0, "solved": 0, "ends": "no grasp"}
    try:
        down = -T_world_obj[0, 2, :3].double().numpy()
        grasps = sample_grasps(
            judge.scene.objects[k], judge.scene.robot, count=SAMPLED, enough=ENOUGH, along=down
        ).T_obj_ee
    except NoGraspError:
        return found
    margins = spare_margins(judge, grasps, np.full(len(grasps), k, np.int32))
    passes = grasps[margins > -np.inf]
    found |= {"sampled": len(grasps), "pass": len(passes), "ends": "Affordance"}
    if not len(passes):
        return found
    found["in_table"] = in_table(judge, own[:1], passes)
    picks = picked_grasps(
        judge.scene, own, T_world_obj, lambda i: np.tile(passes[i].astype(float), (len(own), 1, 1)),
        np.full(len(own), len(passes)), kept=len(passes), turns=(1 + BACKS) * len(passes),
    )  # fmt: skip
    some = np.flatnonzero(picks.count)
    found |= {"picked": int(picks.count.max()), "ends": "Pick"}
    kept = PickedGrasps(picks.T_obj_ee[some], picks.draw[some], picks.count[some])
    fan = oracle.Fan(own[torch.from_numpy(some)], judge, 0, kept)
    todo = np.arange(len(some))
    last: Counter[str] = Counter()
    for turn in range(ROUNDS):
        if not len(todo):
            break
        scores = judge.score(*fan.proposals(todo, turn), own[torch.from_numpy(some[todo])])
        last.update(Outcome(int(x)).name.capitalize() for x in scores.outcome if int(x) != int(Outcome.SUCCESS))
        todo = todo[~scores.success.numpy()]
    found["solved"] = len(some) - len(todo)
    found["ends"] = last.most_common(1)[0][0] if len(todo) else "none"
    return found


def in_table(judge: Any, one: Any, T_obj_ee: np.ndarray) -> int:
    """How many grasps would put the open gripper into the table where a trial's object rests."""
    from r2h_batch.judge.pick import picked
    from r2h_batch.observe.known import known_moments
    from r2h_batch.types import CollidingPair
    from r2h_batch.verdicts import PickReason

    rows = torch.zeros(len(T_obj_ee), dtype=torch.int64)
    found = picked(judge.scene, torch.from_numpy(T_obj_ee), known_moments(judge.scene).of(one)[rows], one[rows])
    met = (found.reason == int(PickReason.GRASP_COLLIDES)) & (found.pair == int(CollidingPair.TABLE))
    return int(met.sum())


def turn_over(judge: Any, own: Any, k: int) -> None:
    """Lets an object rest on its other side: turned by half a turn about the world's x axis, its middle where it was."""
    from r2h_batch.observe.known import known_moments

    known = known_moments(judge.scene)
    points = torch.from_numpy(np.asarray(judge.scene.objects[k].points)).double()
    T = known.of(own).double()
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    for one in T:
        before = points @ one[:3, :3].T + one[:3, 3]
        one[:3, :3] = half_turn @ one[:3, :3]
        after = points @ one[:3, :3].T
        middle = [0.5 * (x.amax(0) + x.amin(0)) for x in (before, after)]
        one[:3, 3] = middle[0] - middle[1]
        one[2, 3] = before[:, 2].min() - after[:, 2].min()
    known.tell(own, T.float())


if __name__ == "__main__":
    main()
