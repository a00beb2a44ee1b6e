"""Seconds that each baseline needs for 1,000 trials x 100 candidates (goal: 60 on two cores), and candidates a second.

Warm: kernels compiled, tables of objects made (`first_s` is what that took, from an empty cache minutes of compiling).
Candidates: 100 a trial; for Handover-VA its own, every grasp point at every azimuth.
"""

import resource
import time
from importlib import import_module
from math import pi

from _report import Report, arguments

METHODS = ("fc", "handover_va", "contact", "intent")


def core_seconds() -> float:
    """CPU time of this process, all threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def own_candidates(trials, scene) -> int:
    """Grasp points of Handover-VA times its azimuths."""
    from r2h_batch.methods import handover_va as va
    from r2h_batch.methods.box_grasps import box_grasps
    from r2h_batch.predictors import predict_parts

    total = 0
    for first in range(0, len(trials), 500):
        part = trials[first : first + 500]
        role = va.point_roles(scene, part.object_index, predict_parts(part, scene))
        own = box_grasps(
            scene, part.object_index, role,
            voxel_m=va.VOXEL_M, azimuth_step=va.AZIMUTH_STEP, depths_m=[0.0], crop_m=va.CROP_M,
        )  # fmt: skip
        total += int(own.used.sum()) * round(pi / va.AZIMUTH_STEP)
    return total


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="in all, half of each split")
    parser.add_argument("--repeats", type=int, default=3, help="the fastest counts")
    given = parser.parse_args()

    from r2h_batch.evaluate import Evaluator
    from r2h_batch.trials.protocol import make_trials

    report = Report()
    evaluator = Evaluator(device=given.device)
    trials = make_trials(trials=given.trials // 2)
    report.add("methods.trials", len(trials))
    for name in METHODS:
        predict = import_module(f"r2h_batch.methods.{name}").predict
        start = time.perf_counter()
        predict(trials[:32], evaluator.scene, evaluator=evaluator)
        report.add(f"methods.{name}.first_s", time.perf_counter() - start)
        walls, cores = [], []
        for _ in range(given.repeats):
            start, spent = time.perf_counter(), core_seconds()
            predict(trials, evaluator.scene, evaluator=evaluator)
            walls.append(time.perf_counter() - start)
            cores.append(core_seconds() - spent)
        count = own_candidates(trials, evaluator.scene) if name == "handover_va" else 100 * len(trials)
        scale = 1000 / len(trials)
        report.add(f"methods.{name}.wall_s_per_1000_trials", scale * min(walls))
        report.add(f"methods.{name}.core_s_per_1000_trials", scale * min(cores))
        report.add(f"methods.{name}.candidates_per_s", count / min(walls))
        report.add(f"methods.{name}.within_60_s", scale * min(walls) <= 60)
    report.write(given.json)


if __name__ == "__main__":
    main()
