"""Safe level by level (a GPU's form), on a CPU: the distances of one thread a trial, in any batch, on any number of lanes."""

from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from unittest import mock

import pytest
import torch

from r2h_batch import evaluate, load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import SAFE_TOLERANCE_M, NearestApproach, hand_distance
from r2h_batch.judge.frontier.form import planning_form
from r2h_batch.judge.motion.execute import Executed
from r2h_batch.methods import oracle, random
from r2h_batch.scene.scene import BodyPoses, Scene


@dataclass(frozen=True)
class Moved:
    """Inputs of Safe."""

    scene: Scene
    body_poses: BodyPoses
    executed: Executed
    active: torch.Tensor

    def touch(self) -> NearestApproach:
        return hand_distance(self.scene, self.body_poses, self.executed, self.active)

    def by_frontier(self) -> NearestApproach:
        with planning_form("frontier"):
            return self.touch()

    def off_its_path(self, by_rad: float) -> "Moved":
        """Every waypoint moved at random: motions that nobody has certified, some through the hand."""
        noise = torch.randn(self.executed.path.shape, generator=torch.Generator().manual_seed(5))
        return replace(self, executed=replace(self.executed, path=self.executed.path + by_rad * noise))


@cache
def moved(method: ModuleType, n: int) -> Moved:
    """Motions as planned of a method's first n trials."""
    evaluator = Evaluator(load_benchmark("r2h-v0"), EvalConfig(execute=ExecConfig(sim="none"), chunk=n))
    trials = load_benchmark("r2h-v0").with_objects(evaluator.scene.objects).trials_with_ids(torch.arange(n))
    poses = method.predict(trials, evaluator.scene, seed=0)
    with mock.patch.object(evaluate, "hand_distance", wraps=hand_distance) as asked:
        evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
    return Moved(*asked.call_args_list[0].args[:4])


def compare(asked: Moved) -> int:
    """The same verdicts, margins within the tolerance of both, the same witness where margins have the same bits.

    The depth of an overlap is searched from the moment that was found (kernels/judge/overlap.py), which may be another one: a
    few overlaps are as deep at two moments. Gives how many motions meet the hand.
    """
    touch, touch_there = asked.touch(), asked.by_frontier()
    rows = ~touch.distance_m.isnan()
    a, b = touch.distance_m[rows], touch_there.distance_m[rows]
    assert torch.equal(rows, ~touch_there.distance_m.isnan()) and torch.equal(a > 0, b > 0)
    apart, same = a > 0, a == b
    assert ((a - b).abs() <= (0.002 * a).clamp(min=SAFE_TOLERANCE_M) + 1e-6)[apart].all()
    assert (~same).sum() <= max(3, 0.05 * len(a)) and ((a - b).abs() <= 1e-5)[~apart].sum() >= 0.9 * (~apart).sum()
    for name in ("body", "segment", "fraction", "point"):
        x, y = (getattr(t, name)[rows].double().reshape(len(a), -1) for t in (touch, touch_there))
        other = same & (x != y).any(1)
        assert (other & apart).sum() <= 0.001 * len(a), name  # two moments may be equally near
        assert (other & ~apart).sum() <= 0.02 * (~apart).sum(), name
    return int((~apart).sum())


@pytest.mark.parametrize(
    ("method", "n", "least"),
    [
        pytest.param(random, 160, 5, marks=pytest.mark.check),
        *(pytest.param(m, 2048, 100, marks=pytest.mark.slow) for m in (random, oracle)),
    ],
    ids=["160", "random", "oracle"],
)
def test_the_frontier_finds_the_distances_of_one_thread(method: ModuleType, n: int, least: int) -> None:
    asked = moved(method, n)
    assert int(asked.executed.length.count_nonzero()) >= 0.4 * n
    assert compare(asked) == 0 or n > 160  # paths are certified
    assert compare(asked.off_its_path(0.3)) >= least
    assert n == 160 or compare(asked.off_its_path(0.1)) >= least


def test_a_long_motion_is_halved_block_by_block_from_its_end() -> None:
    """As recorded sample by sample: 150 segments a motion, nearest at its end or at its start."""
    asked = moved(oracle, 24)
    path, length = asked.executed.path, asked.executed.length
    ends = path[torch.arange(24), length.long() - 1]
    s = torch.linspace(0, 1, 151)[None, :, None]
    there = path[:, :1] + s * (ends[:, None] - path[:, :1])
    for shape in (there, there.flip(1)):
        length = torch.full((24,), shape.shape[1], dtype=torch.int32)
        compare(replace(asked, executed=replace(asked.executed, path=shape.contiguous(), length=length)))
