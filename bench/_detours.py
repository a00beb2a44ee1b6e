"""How much longer planned motions are than the straight lines of joint space that their goals allow."""

import numpy as np
import torch
from _report import Report
from _twins import Problems
from numpy.typing import NDArray

from r2h_batch.judge.ik import home_posture
from r2h_batch.judge.plan import BRANCHES, Planner
from r2h_batch.judge.search import straight_time
from r2h_batch.motion.time_law import time_path
from r2h_batch.scene.scene import Scene


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
