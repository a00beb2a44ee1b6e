"""Are exported rows true? Judges them again with other code: MuJoCo C, trimesh, manifold3d, Qhull and float64 NumPy.

python bench/judge_again.py [SET ...] [--trials N] [--json FILE]

Of each set (v1, body, paper, unseen) N trials a split and method are swept, with details and paths. Rows, poses and paths
are read from the run folder. Taken from the project are trials, meshes and numbers of the robot, and of preset paper where
the planner's hand stood; no verdict and no margin comes from it. A margin that is a distance must be right to 0.1 mm, one
that is a bound must be no more than the overlap that is found, one that is a cap must be no more than the clearance. A
verdict is wrong where the other code says the opposite by more than 0.1 mm.

Figures are rows, wrong verdicts, the largest difference of a distance (mm), and bounds and caps that do not bound. What
differs is printed one by one: overlaps are searched for, so of one that a bound exceeds a deeper point may exist.
"""

import contextlib
import io
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import ur_analytic_ik
from _report import Report, arguments
from _twins import MujocoScene, Staged, grasp_cases, oracle, winding_number
from meshes import drawn
from numpy.typing import NDArray

from r2h_batch.config import CLEARANCE_CAP_M, CLOSED_GAP_M, OPEN_GAP_M
from r2h_batch.judge.grasp import CUT_CAP_M
from r2h_batch.judge.ik import one_branch, solve_ik
from r2h_batch.methods.predictors import PredictorNoise
from r2h_batch.runs.store import load_run
from r2h_batch.scene.robot import gripper_primitives_at
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.trials.benchmark.build import BenchmarkFlags, BenchmarkOverrides
from r2h_batch.trials.noise import estimated_hand
from r2h_batch.types import CRITERIA

Array = NDArray[np.float64]
TOLERANCE_M = 1e-4
STEP_RAD = 1 / 160
SETS = {
    "v1": ["--protocol", "r2h-v1"],
    "body": ["--protocol", "r2h-v1", "--receiver", "body"],
    "paper": ["--preset", "paper", "--protocol", "r2h-v0"],
    "unseen": ["--protocol", "r2h-v1"],
}
METHODS = ("fc", "handover-va", "random")


@dataclass
class Tally:
    """Agreement on one criterion in one set; lengths in mm."""

    rows: int = 0
    wrong: int = 0
    largest: float = 0.0
    bounds: int = 0
    loose: list[float] = field(default_factory=list)
    beyond: int = 0

    def add(self, name: str, margin: float, kind: str, true: float, where: str) -> None:
        """One margin (m), beside the clearance `true`: below 0 an overlap by at least so much."""
        self.rows += 1
        faults = []
        if (margin >= 0) != (true >= 0) and abs(true) > TOLERANCE_M and np.isfinite(margin):
            self.wrong += 1
            faults.append("wrong verdict")
        if kind == "distance":
            self.largest = max(self.largest, 1e3 * abs(margin - true))
            if abs(margin - true) > TOLERANCE_M:
                faults.append("not the distance")
        elif np.isfinite(margin):
            self.bounds += 1
            if kind == "bound" and true < -TOLERANCE_M:
                self.loose.append(margin / true)
            if (margin < true if kind == "bound" else margin > true) and abs(margin - true) > TOLERANCE_M:
                self.beyond += 1
                faults.append("does not bound")
        if faults:
            found = f"says {1e3 * margin:.3f} mm ({kind}), found {1e3 * true:.3f}"
            print(f"  {where} {name}: {found}: {', '.join(faults)}", flush=True)


def rigid(T: Any) -> Array:
    """A pose (16 or 4 x 4 numbers) with orthonormal axes, float64: z is kept, y turned to it."""
    T = np.asarray(T, np.float64).reshape(4, 4).copy()
    z = T[:3, 2] / np.linalg.norm(T[:3, 2])
    y = T[:3, 1] - (T[:3, 1] @ z) * z
    y /= np.linalg.norm(y)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], 1)
    return T


def deepest_point(kind: int, size: Array, T: Array, triangles: Array) -> float:
    """How deep (m) some point of the triangles lies in a primitive, 0 outside: parting them takes at least that.

    Depth is concave on a triangle and changes by no more than the way: triangles come in the order of what they may have.
    """
    inverse = np.linalg.inv(T)
    local = triangles @ inverse[:3, :3].T + inverse[:3, 3]
    center = local.mean(1)
    most = np.linalg.norm(local - center[:, None], axis=2).max(1) - oracle.primitive_distance(kind, size, center)
    grid = np.array([[a, b, 4 - a - b] for a in range(5) for b in range(5 - a)]) / 4
    best = 0.0
    for face in np.argsort(-most):
        if most[face] <= best + 1e-6:
            break
        weights = grid
        for k in range(1, 14):
            depth = -oracle.primitive_distance(kind, size, weights @ local[face])
            best = max(best, float(depth.max()))
            weights = np.maximum(weights[depth.argmax()] + 0.6**k * (grid - 1 / 3), 0.0)
            weights /= weights.sum(1, keepdims=True)
    return best


class Again:
    """One row of a run, judged with other code: each method gives a clearance (m), below 0 an overlap by at least so much."""

    def __init__(self, judge: Judge, trials: Any, row: dict[str, Any]) -> None:
        self.scene, self.config, self.row = judge.evaluator.scene, judge.evaluator.config, row
        self.model = self.scene.objects[int(trials.object_index[0])]
        self.mesh = trimesh.Trimesh(self.model.vertices.astype(np.float64), self.model.faces, process=False)
        self.T_obj_ee, self.T_world_ee = rigid(row["T_obj_ee"]), rigid(row["T_world_ee"])
        self.attached = self.T_obj_ee.copy()
        self.attached[:3, 3] += row["grasp_shift_m"] * self.T_obj_ee[:3, 1]
        self.opening = row["opening_m"]
        self.receiver = None if trials.receiver is None else trials.receiver[0].double().numpy()
        hand = trials.T_world_hand
        self.T_hand, seen = rigid(hand[0]), hand
        if self.config.plan.hand == "estimated":
            estimate = self.config.estimate
            noise = PredictorNoise(target_errors=estimate.errors).scaled(estimate.factor)
            seen = estimated_hand(self.scene, trials.trial_id, trials.hand_index, hand, seed=estimate.seed, noise=noise)
        at = int(trials.object_index[0]), int(trials.hand_index[0]), self.attached
        body = self.receiver if self.config.receiver == "body" else None
        self.true = MujocoScene(self.scene, Staged(*at, self.T_hand, self.opening), receiver=self.receiver)
        self.seen = MujocoScene(self.scene, Staged(*at, rigid(seen[0]), self.opening), receiver=body)
        self.q = np.array(row.get("q") or np.zeros((0, 6)), np.float64)  # (W, 6); 0: no path
        self.hand = oracle.hand_triangles(self.scene, self.true.staged)

    def stability(self) -> float:
        """The least of w_max - w, w - w_min and the open gripper's clearance, at most 1 cm."""
        limits, width, T = self.config.thresholds, self.row["width_m"], self.T_obj_ee
        cut = CUT_CAP_M
        gripper, surface = self.scene.robot.gripper, self.mesh.triangles
        placed = T @ gripper_primitives_at(self.scene.robot, OPEN_GAP_M)
        for kind, size, T_obj_prim in zip(gripper.kind, gripper.size, placed, strict=True):
            apart = oracle.mesh_distance(int(kind), size, T_obj_prim, surface, cap=max(cut, 0.0))
            cut = min(cut, apart if apart > 0 else -deepest_point(int(kind), size, T_obj_prim, surface))
        gap = OPEN_GAP_M if width is None else self.opening
        low, high = (grasp_cases.width64(self.mesh, T, gap, grow) for grow in (-1e-5, 1e-5))
        if width is None:  # nothing between the pads, at any opening
            assert max(low, high) < 0, self.row["trial_id"]
            return min(cut, -limits.w_max_m)
        for wider in np.linspace(gap + 2 * TOLERANCE_M, OPEN_GAP_M, 6)[:-1] if gap < OPEN_GAP_M - 1e-3 else ():
            filled = grasp_cases.width64(self.mesh, T, wider, -TOLERANCE_M)
            assert filled < wider + TOLERANCE_M, (self.row["trial_id"], "the pads would have stopped before")
        if width > OPEN_GAP_M:  # too wide for the open pads, or for the gap at which their tips meet a step
            gaps = np.linspace(CLOSED_GAP_M, OPEN_GAP_M, 40)
            high = max(high, *(grasp_cases.width64(self.mesh, T, g, TOLERANCE_M) for g in gaps))
        own = min(
            max(width, min(low, high)), max(low, high)
        )  # where pads graze the material, any width between is right
        return min(limits.w_max_m - own, own - limits.w_min_m, cut)

    def plan(self) -> float:
        """The path's smallest clearance; without a path what start, goal or target lack."""
        reason, twin = self.row["plan_reason"], self.seen
        if len(self.q):
            least = self._along(twin, lambda q: twin.least(q, cap=4 * CLEARANCE_CAP_M)[0])
            if least >= 0:
                return least
            return -oracle.deepest_along(twin.model, twin.data, twin.pairs, self.q)
        if reason == "ik_unreachable":
            return -oracle.out_of_reach(self.T_world_ee)
        if reason == "start_in_collision":
            return self._clearance(np.array(self.config.workplace.home_q))
        if reason == "ik_in_collision":
            return max(self._clearance(q) for q in self._branches())
        return -np.inf

    def _branches(self) -> Array:
        """All solutions of ur-analytic-ik; where the planner has one goal, that one."""
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])  # its base is world turned by half a turn
        target = turn @ self.T_world_ee @ np.linalg.inv(self.scene.robot.T_flange_ee)
        q = np.array(ur_analytic_ik.ur5e.inverse_kinematics(np.ascontiguousarray(target))).reshape(-1, 6)
        if self.config.plan.goals == "one":
            T = torch.from_numpy(self.T_world_ee[None]).float()
            ik = solve_ik(T)
            one = ik.q[0][one_branch(ik, T)[0]].double().numpy()[0]
            q = q[[np.abs(np.sin((q - one) / 2)).max(1).argmin()]]
        return q

    def _clearance(self, q: Array) -> float:
        """Smallest clearance of all pairs at a posture; below 0 the depth of the deepest."""
        twin = self.seen
        least, _ = twin.least(q, cap=CLEARANCE_CAP_M)
        if least >= 0:
            return least
        (a, b), m, x = twin.pairs.T, twin.model, twin.data.geom_xpos
        near = twin.pairs[np.linalg.norm(x[a] - x[b], axis=1) < m.geom_rbound[a] + m.geom_rbound[b]]
        return -max(oracle.geom_depth(m, twin.data, int(i), int(j)) for i, j in near)

    def reach(self) -> float:
        """r_h - dist(c_h, solid of the object)."""
        limits, hands = self.config.thresholds, self.scene.hands
        index, staged = self.true.staged.hand_index, self.true.staged
        joints = hands.joints[index].double().numpy()
        normal = np.cross(joints[1] - joints[0], joints[7] - joints[0])
        normal *= (-1.0 if int(hands.set.side[index]) else 1.0) / np.linalg.norm(normal)
        center = joints[[0, 1, 4, 7, 10]].mean(0) + limits.reach_offset_m * normal
        x = self.attached @ np.linalg.inv(self.T_world_ee) @ staged.T_world_hand @ np.append(center, 1.0)
        inside = abs(winding_number(x[:3], self.mesh.triangles)) > 0.5
        apart = 0.0 if inside else float(trimesh.proximity.closest_point_naive(self.mesh, x[None, :3])[1][0])
        return limits.reach_radius_m - apart

    def affordance(self) -> float:
        """The closed fingers' distance from the receiver's region."""
        region = self.mesh.triangles[self.model.receiver_face]
        limits, robot, best = self.config.thresholds, self.scene.robot, CLEARANCE_CAP_M
        opening, width = self.opening, self.row["width_m"]
        if width is not None and width <= limits.w_max_m:
            opening = max(opening - limits.pad_squeeze_m, 0.0)
        placed = self.attached @ gripper_primitives_at(robot, opening)
        for kind, size, T, motion in zip(
            robot.gripper.kind, robot.gripper.size, placed, robot.gripper_motion, strict=True
        ):
            if motion != "fixed":
                apart = oracle.open_surface_distance(int(kind), size, T, region, max(best, 0.0))
                best = min(best, apart if apart > 1e-9 else -deepest_point(int(kind), size, T, region))
        return best

    def safe(self) -> float:
        """The true hand's distance from the robot along the motion; with bodies that of arm and torso too."""
        with_body = self.config.receiver == "body"

        def apart(q: Array) -> float:
            found = self.true.safe_at(self.hand, q, cap=2 * CLEARANCE_CAP_M)
            return min(found, self.true.person_at(q, cap=2 * CLEARANCE_CAP_M)) if with_body else found

        least = self._along(self.true, apart)
        return least if least > 0 else min(-self._hand_depth(), -self._person_depth() if with_body else 0.0)

    def body_m(self) -> float:
        """The robot's distance from the receiver's arm and torso along the motion."""
        least = self._along(self.true, lambda q: self.true.person_at(q, cap=2 * CLEARANCE_CAP_M))
        return least if least > 0 else -self._person_depth()

    def _along(self, twin: MujocoScene, distance: Callable[[Array], float]) -> float:
        """The smallest distance (m, at most 5 cm) over the path: of all samples, then about the nearest one by thirds."""
        least, nearest = twin.least_sample(self.q, STEP_RAD, CLEARANCE_CAP_M, distance, enough=0.0)
        if not 0 < least < CLEARANCE_CAP_M:
            return least
        postures = np.array(list(oracle.samples(self.q, STEP_RAD)))
        i = int(np.abs(postures - nearest).sum(1).argmin())
        for side in (max(i - 1, 0), min(i + 1, len(postures) - 1)):
            low, high = 0.0, 1.0
            for _ in range(14):
                thirds = low + (high - low) * np.array([1, 2]) / 3
                a, b = (distance(nearest + t * (postures[side] - nearest)) for t in thirds)
                low, high = (low, thirds[1]) if a < b else (thirds[0], high)
                least = min(least, a, b)
        return least

    def _person_depth(self) -> float:
        twin = self.true
        return oracle.deepest_along(twin.model, twin.data, twin.pairs_with_person(), self.q)

    def _hand_depth(self) -> float:
        """The deepest point of the hand's surface in a primitive of the robot along the motion."""
        samples = list(oracle.samples(self.q, STEP_RAD))
        middle = self.hand.mean(1)
        rough = [max(self._depths(q, middle, rough=True)) for q in samples]
        best = 0.0
        for i in np.argsort(rough)[::-1][:6]:
            best = max(best, *self._depths(samples[i], self.hand, rough=False))
        return best

    def _depths(self, q: Array, surface: Array, *, rough: bool) -> Iterator[float]:
        twin = self.true
        twin.safe_at(self.hand, q, cap=0.0)  # puts the model there
        for link in self.scene.robot.links:
            for name in twin.groups[link]:
                g, T = twin.model.geom(name).id, np.eye(4)
                T[:3, :3], T[:3, 3] = twin.data.geom_xmat[g].reshape(3, 3), twin.data.geom_xpos[g]
                kind, size = oracle.kind_of(twin.model, g), twin.model.geom_size[g]
                if rough:
                    yield -float(oracle.primitive_distance(kind, size, (surface - T[:3, 3]) @ T[:3, :3]).min())
                else:
                    yield deepest_point(kind, size, T, surface)


def judge_set(name: str, flags: list[str], folder: Path, meshes: Path, trials: int) -> dict[str, Tally]:
    """Sweeps a set and judges all its rows again; what became of each criterion."""
    own = ["--objects", str(meshes), "--splits", "S0"] if name == "unseen" else []
    line = ["--method", *METHODS, "--trials", str(trials), "--sim", "none", "--save-paths", "--quiet"]
    with contextlib.redirect_stdout(io.StringIO()):
        code = sweep([*line, *flags, *own, "--out", str(folder)])
    if code:
        raise SystemExit(code)
    run = load_run(folder)
    judge = Judge(run, given=BenchmarkOverrides.of(BenchmarkFlags(objects=str(meshes))) if own else None)
    found = {k: Tally() for k in (*CRITERIA, "body_m")}
    for method in run.methods:
        rows: dict[int, dict[str, Any]] = {}
        for table in (run.trials(method), run.details(method), run.poses(method), run.paths(method)):
            for row in table.to_pylist():
                rows.setdefault(row["trial_id"], {}).update(row)
        for trial_id, row in rows.items():
            again = Again(judge, judge.trials([trial_id]), row)
            where = f"{name} {method.split(' ')[0]} {trial_id}"
            for criterion in CRITERIA:
                if row[f"passed_{criterion}"] is not None:
                    said = row[f"margin_{criterion}_m"], row[f"margin_kind_{criterion}"]
                    found[criterion].add(criterion, *said, getattr(again, criterion)(), where)
            if (body := row["body_m"]) is not None:
                kind = "bound" if body < 0 else "distance" if body < CLEARANCE_CAP_M else "cap"
                found["body_m"].add("body_m", body, kind, again.body_m(), where)
    return found


def main() -> None:
    """Prints what differs and the table."""
    parser = arguments(__doc__)
    parser.add_argument("sets", nargs="*", default=list(SETS), help=f"of {', '.join(SETS)}; default: all")
    parser.add_argument("--trials", type=int, default=14, help="of each split and method")
    args, report = parser.parse_args(), Report()
    with tempfile.TemporaryDirectory() as kept:
        meshes = Path(kept) / "meshes"
        meshes.mkdir()
        for thing, mesh in drawn().items():
            mesh.export(meshes / f"{thing}.obj")
        for name in args.sets:
            for criterion, t in judge_set(name, SETS[name], Path(kept) / name, meshes, args.trials).items():
                figures = {"rows": t.rows, "wrong": t.wrong, "largest_difference_mm": round(t.largest, 4)}
                figures |= {"bounds": t.bounds, "bounds_that_do_not": t.beyond}
                figures |= {"median_bound_share": round(float(np.median(t.loose)), 3)} if t.loose else {}
                for figure, value in figures.items() if t.rows else ():
                    report.add(f"judge_again.{name}.{criterion}.{figure}", value)
    report.write(args.json)


if __name__ == "__main__":
    main()
