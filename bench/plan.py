"""How many problems does the planner solve, how fast, and are its paths free? Against OMPL's RRTConnect on MuJoCo C.

python bench/plan.py [--problems N] [--device cpu|cuda:0] [--json FILE]
python bench/plan.py --tail 2048 [--json FILE]

Problems: rows of the frozen mix (bench/mix.npz, see throughput.py) whose start and at least one IK branch are free in
MuJoCo C; both planners get the same start and goals. Ours is timed over the batch with everything from placing the
bodies on (goal checks, search, shortcuts, smallest clearance; IK apart); OMPL inside solve() only, without simplification,
its model made beforehand. OMPL's states are checked by MuJoCo C through a Python callback; us_per_check says what one
costs with the callback. Its edges are sampled every 1/64 rad. A problem counts as solved by OMPL if its path passes the
re-check at 1/320 rad. Our paths are certified between samples too, are shortened, and carry their smallest clearance.

detour_*: T_exec over the time of the straight line from home to the path's own end; over_bound_*: to the free goal that a
straight line reaches soonest; over all paths.

ratio_to_ompl: process times, one core each, the median of OMPL over our mean per problem: other work on the machine counts
little. ratio_to_ompl_wall: wall times, ours on all cores.

--tail: instead, how long does the longest problem take, and what does the search miss that plain RRT-Connect finds in 5,000
iterations? The first N trials of r2h-v0 with the predictions of `random`, whose goals are anywhere: one search in a thousand is
hard. longest_ms: process time of all searches and shortcuts of one problem, the largest, that a GPU or the last core waits
for it. searched: problems without a free straight line. lost, gained: trials that have a path with `rounds=(5000,)` (steps of one
length, all goals) and not by default, and the other way round.
"""

import statistics
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import torch
from _mix import load_mix
from _report import Report, arguments
from _twins import Batch, Checker, Problems, checker_of, dense, motion_samples, ompl_solve, recheck, solve
from numpy.typing import NDArray

from r2h_batch.config import HOME_Q, EvalConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import plan
from r2h_batch.judge.ik import home_posture, solve_ik
from r2h_batch.judge.plan import BRANCHES, Planner
from r2h_batch.judge.search import straight_time
from r2h_batch.launch import launch_trials
from r2h_batch.methods import random
from r2h_batch.motion.time_law import time_path
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import trials_with_ids
from r2h_batch.types import PlanReason

REPEATS = 3


def detours(scene: Scene, problems: Problems) -> NDArray[np.float64]:
    """(n, 2) T_exec of each path over the time of the straight line to its own end, and of that to the free goal which a
    straight line reaches soonest; NaN without a path.
    """
    execute, n = scene.config.execute, len(problems.batch)
    home = home_posture(str(scene.device), scene.config.workplace.home_q)
    q, valid = problems.ik.q.reshape(-1, 6), problems.ik.valid.reshape(-1)
    free = Planner(scene, problems.body_poses, None).check(q, valid, BRANCHES)[0].view(n, BRANCHES)
    order = torch.where(free, 0, 1).argsort(dim=1, stable=True)
    rows = torch.arange(n, device=q.device)
    goals = problems.ik.q[rows[:, None], order].reshape(-1, 6)
    line = straight_time(home, goals, free.sum(1).to(torch.int32), execute)
    path, length = problems.plan.path, problems.plan.length
    time = time_path(path, length, execute).t_exec_s
    ends = path[rows, (length - 1).clamp(min=0).long()]
    own = straight_time(home, ends[:, None].expand(n, BRANCHES, 6).reshape(-1, 6), torch.ones_like(length), execute)
    return torch.stack([time / own, time / line], 1).double().cpu().numpy()


def report_detours(report: Report, prefix: str, ratio: NDArray[np.float64]) -> None:
    """Quantiles over all paths: against the line to the path's own end (detour) and to the nearest goal (over_bound)."""
    found = np.isfinite(ratio[:, 0])
    for name, these in (("detour", ratio[found, 0]), ("over_bound", ratio[found, 1])):
        for quantile in (0.5, 0.95, 0.99):
            report.add(f"{prefix}.{name}_p{100 * quantile:.0f}", float(np.quantile(these, quantile)))
        report.add(f"{prefix}.{name}_above_2", int((these > 2).sum()))


def free_rows(scene: Scene, problems: Problems, wanted: int) -> tuple[list[int], list[Checker], list[np.ndarray]]:
    """Rows, judges and goals of the first problems whose start and at least one goal are free in MuJoCo C."""
    rows: list[int] = []
    checkers: list[Checker] = []
    goals: list[np.ndarray] = []
    for row in range(len(problems.batch)):
        if len(rows) == wanted:
            break
        checker = checker_of(scene, problems, row)
        free = [q for q in problems.ik.q[row][problems.ik.valid[row]].double().cpu().numpy() if checker.valid(q)]
        if free and checker.valid(HOME_Q):
            rows.append(row)
            checkers.append(checker)
            goals.append(np.array(free))
    return rows, checkers, goals


def planned(scene: Scene, batch: Batch, threads: int | None, clock) -> tuple[Problems, float]:
    """The batch solved, and the best time of several runs without the IK's (measured apart, subtracted)."""
    best = float("inf")
    for _ in range(REPEATS):
        start = clock()
        problems = solve(scene, batch, threads=threads)
        middle = clock()
        solve_ik(batch.T_world_ee, threads=threads)
        best = min(best, (middle - start) - (clock() - middle))
    return problems, best


@dataclass(frozen=True)
class OwnTimes:
    """Our plans of n problems, and the seconds they took: process time and wall time."""

    problems: Problems
    n: int
    seconds: float
    wall: float
    found: NDArray[np.bool_]


def own_times(report: Report, scene: Scene, batch: Batch) -> OwnTimes:
    """Plans the batch on one core and on all, and says where the time goes."""
    n = len(batch)
    problems, seconds = planned(scene, batch, 1, time.process_time)
    _, wall = planned(scene, batch, None, time.perf_counter)
    report.add("plan.us_per_problem_core", seconds / n * 1e6)
    report.add("plan.problems_per_s_core", n / seconds)
    report.add("plan.problems_per_s_wall", n / wall)
    found = (problems.plan.length > 0).cpu().numpy()
    report.add("plan.solved", int(found.sum()))
    report.add("plan.straight_line_share", float(problems.plan.straight.cpu().numpy()[found].mean()))
    hard = torch.nonzero(~problems.plan.straight.cpu()).flatten()
    if len(hard):
        _, seconds_hard = planned(scene, batch.rows(hard), 1, time.process_time)
        report.add("plan.us_per_searched_problem_core", seconds_hard / len(hard) * 1e6)
    return OwnTimes(problems, n, seconds, wall, found)


def recheck_paths(report: Report, scene: Scene, own: OwnTimes, checkers: list[Checker]) -> None:
    """Our paths at the postures that are executed, by the oracle."""
    problems, found = own.problems, own.found
    config = scene.config.execute
    motion = time_path(problems.plan.path, problems.plan.length, config)
    penetrating = samples = 0
    for row in np.flatnonzero(found):
        k = int(problems.plan.length[row])
        path, times = (x[row, :k].double().cpu().numpy() for x in (problems.plan.path, motion.time_s))
        seen = recheck(checkers[row], motion_samples(path, times, config))
        penetrating += seen.penetrating > 0
        samples += seen.samples
    report.add("plan.penetrating_paths", penetrating)
    report.add("plan.configurations_rechecked", samples)


def compare_with_ompl(
    report: Report,
    scene: Scene,
    batch: Batch,
    own: OwnTimes,
    made: tuple[list[Checker], list[np.ndarray]],
    options: Any,
) -> None:
    """The same problems by OMPL with the oracle's checks. `made`: checker and goals of each problem."""
    checkers, goals = made
    n, seconds, wall, found = own.n, own.seconds, own.wall, own.found
    cpu, walls, checks, solved, invalid, only = [], [], 0, 0, 0, []
    for row in range(n):
        before = time.process_time()
        answer = ompl_solve(
            checkers[row], goals[row], scene.robot.lower, scene.robot.upper,
            budget_s=options.budget_s, resolution_rad=options.resolution_rad,
        )  # fmt: skip
        cpu.append(time.process_time() - before)
        walls.append(answer.seconds)
        checks += answer.checks
        if answer.path is None:
            continue
        if recheck(checkers[row], dense(answer.path)).penetrating:
            invalid += 1
            continue
        solved += 1
        if not found[row]:
            only.append(int(batch.trials.trial_id[row]))
    report.add("plan.ompl_solved", solved)
    report.add("plan.ompl_paths_penetrating", invalid)
    report.add("plan.only_ompl", len(only))
    report.add("plan.only_ompl_trial_ids", " ".join(map(str, only)) or "none")
    report.add("plan.ompl_ms_median", statistics.median(cpu) * 1e3)
    report.add("plan.ompl_ms_mean", statistics.mean(cpu) * 1e3)
    report.add("plan.ompl_checks_per_problem", checks / n)
    report.add("plan.ompl_us_per_check", sum(cpu) / checks * 1e6)
    report.add("plan.ratio_to_ompl", statistics.median(cpu) / (seconds / n))
    report.add("plan.ratio_to_ompl_wall", statistics.median(walls) / (wall / n))


def timed(scene: Scene, batch: Batch) -> tuple[Problems, dict[int, float]]:
    """The batch planned on one thread, and the seconds that each searched problem took by trial id."""
    spent: dict[int, float] = defaultdict(float)

    def one_by_one(kernel: Any, n: int, **kwargs: Any) -> None:
        rows = kwargs["inputs"].get("trial")
        if rows is None:
            launch_trials(kernel, n, **kwargs)
            return
        for i in range(n):
            start = time.process_time()
            launch_trials(kernel, 1, **{**kwargs, "first": i})
            spent[int(batch.trials.trial_id[int(rows[i])])] += time.process_time() - start

    with mock.patch.object(plan, "launch_trials", one_by_one):
        return solve(scene, batch, threads=1), spent


def tail(report: Report, scene: Scene, n: int) -> None:
    """The longest search of the first n trials of `random`, and what plain RRT-Connect finds beside it."""
    spent: dict[int, float] = {}
    lost, gained, ratios, none = [], [], [], []
    for ids in torch.arange(n).split(20_000):
        trials = trials_with_ids(ids, objects=scene.objects, hand_set=scene.hands.set, protocol="r2h-v0")
        answer = random.predict(trials, scene, seed=0)
        batch = Batch(trials, answer.T_obj_ee, answer.T_world_ee)
        if not spent:
            solve(scene, batch.rows(slice(0, 64)), threads=1)  # kernels are compiled or loaded here
        ours, seconds = timed(scene, batch)
        spent |= seconds
        found = ours.plan.length > 0
        hard = torch.nonzero(torch.isin(ids, torch.tensor(sorted(seconds)))).flatten()  # no straight line
        plain = solve(scene, batch.rows(hard), PlanConfig(rounds=(5000,)), threads=1).plan.length > 0
        lost += ids[hard[plain & ~found[hard]]].tolist()
        gained += ids[hard[~plain & found[hard]]].tolist()
        none += ids[ours.plan.reason == int(PlanReason.NO_PATH_IN_BUDGET)].tolist()
        ratios.append(detours(scene, ours))
    longest = max(spent, key=lambda i: spent[i])
    report.add("tail.trials", n)
    report.add("tail.searched", len(spent))
    report.add("tail.longest_ms", 1e3 * spent[longest])
    report.add("tail.longest_trial_id", longest)
    report.add("tail.search_ms_mean", 1e3 * sum(spent.values()) / len(spent))
    for name, those in (("no_path_in_budget", none), ("lost", lost), ("gained", gained)):
        report.add(f"tail.{name}", len(those))
        report.add(f"tail.{name}_trial_ids", " ".join(map(str, those)) or "none")
    report_detours(report, "tail", np.concatenate(ratios))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--budget-s", type=float, default=10.0, help="OMPL's time for one problem")
    parser.add_argument("--resolution-rad", type=float, default=1 / 64, help="OMPL's edge resolution")
    parser.add_argument(
        "--tail", type=int, metavar="N", help="of so many trials: the longest search, and what is missed"
    )
    options = parser.parse_args()
    report = Report()
    scene = Evaluator(EvalConfig(), device=options.device).scene
    if options.tail:
        tail(report, scene, options.tail)
        report.write(options.json)
        return
    (T_obj_ee, T_world_ee, trials), _ = load_mix(scene)
    whole = Batch(trials, T_obj_ee, T_world_ee)
    rows, checkers, goals = free_rows(scene, solve(scene, whole), options.problems)
    batch = whole.rows(torch.tensor(rows))
    report.add("plan.problems", len(batch))

    own = own_times(report, scene, batch)
    report_detours(report, "plan", detours(scene, own.problems))
    recheck_paths(report, scene, own, checkers)
    compare_with_ompl(report, scene, batch, own, (checkers, goals), options)
    report.write(options.json)


if __name__ == "__main__":
    main()
