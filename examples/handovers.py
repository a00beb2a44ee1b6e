"""Training data of examples/train_generator.py: clouds, palm frames, and rough handovers that the evaluator lets
pass."""

from dataclasses import dataclass

import numpy as np
import torch
from generator import SEEN, frame_of
from torch import Tensor

from r2h_batch import Evaluator, Trials, load_benchmark
from r2h_batch.base import se3
from r2h_batch.methods import candidates_of, stacked

FIRST_TRAINING_ID = 1_000_000  # the benchmark's own trials stay unseen


@dataclass
class Clouds:
    """Point clouds of all objects: (O, P, 3) points and normals, (O, P) whether a point lies in the receiver's region."""

    points: Tensor
    normals: Tensor
    region: Tensor

    @staticmethod
    def of(evaluator: Evaluator) -> "Clouds":
        objects = evaluator.scene.objects
        rows = ([x[:SEEN] for x in (o.points, o.normals, o.receiver_face[o.point_face])] for o in objects)
        return Clouds(*(torch.from_numpy(np.stack(x)) for x in zip(*rows, strict=True)))

    def rows(self, objects: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        i = objects.long()
        return self.points[i], self.normals[i], self.region[i]

    def point_frames(self, objects: Tensor, point: Tensor) -> Tensor:
        """T_obj_point: z the outward normal, x towards the object's middle."""
        rows = torch.arange(len(point))
        p, n = self.points[objects.long()][rows, point], self.normals[objects.long()][rows, point]
        return frame_of(n, self.points[objects.long()].mean(1) - p, p)

    def middle(self, objects: Tensor) -> Tensor:
        """Anchor of the handover: the middle of the receiver's region, or of the object if it has no region."""
        points, _, region = self.rows(objects)
        use = (region | ~region.any(1, keepdim=True)).float()[..., None]
        return (points * use).sum(1) / use.sum(1)


def palm_frames(evaluator: Evaluator, trials: Trials) -> tuple[Tensor, Tensor]:
    """T_world_palm: at the ball's centre, z out of the palm, x away from the robot; and where it stands (B, 8)."""
    _, normal, center = evaluator.scene.palm(trials.hand_index, trials.T_world_hand)
    out = center * torch.tensor([1.0, 1.0, 0.0])
    T = frame_of(normal, out / out.norm(dim=-1, keepdim=True), center)
    side = (trials.hand_index % 2).float()[:, None]
    return T, torch.cat([center * 2, T[:, 2, :3], out.norm(dim=-1, keepdim=True), side], -1)


def proposals(
    evaluator: Evaluator, trials: Trials, clouds: Clouds, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Rough handovers to filter: a stored candidate, the region's middle near the ball's centre, any approach from behind."""
    grasps, first, count = stacked(candidates_of(evaluator.scene.objects))
    o = trials.object_index.long()
    pick = (torch.rand(len(o), generator=generator) * torch.from_numpy(count)[o]).long()
    T_obj_ee = torch.from_numpy(grasps)[torch.from_numpy(first)[o] + pick]
    T_world_palm, _ = palm_frames(evaluator, trials)
    center, normal, out = T_world_palm[:, :3, 3], T_world_palm[:, :3, 2], T_world_palm[:, :3, 0]
    mix = torch.rand((len(o), 1), generator=generator)
    z = mix * out - (1 - mix) * normal + 0.5 * torch.randn((len(o), 3), generator=generator)
    z = z / z.norm(dim=-1, keepdim=True)
    R = frame_of(z, torch.randn((len(o), 3), generator=generator), center)[:, :3, :3]
    turned = se3.from_rotation(R, torch.zeros_like(center))
    target = center + (0.08 * torch.rand((len(o), 1), generator=generator) - 0.02) * normal
    origin = target - se3.apply(turned, se3.apply(se3.inverse(T_obj_ee), clouds.middle(o)))
    return T_obj_ee.contiguous(), se3.orthonormalise(se3.from_rotation(R, origin)).contiguous()


@dataclass
class Examples:
    """Handovers that pass: trials, poses, and the surface point at the +y pad."""

    trials: Trials
    T_obj_ee: Tensor
    T_world_ee: Tensor
    point: Tensor


def collect(evaluator: Evaluator, clouds: Clouds, count: int, objects: Tensor, generator: torch.Generator) -> Examples:
    """`count` proposals on training objects, those kept that pass the pose stage; each also held the other way round."""
    per = -(-count * len(evaluator.scene.objects) // (10 * len(objects))) * 10
    trials = load_benchmark("r2h-v1").trials_with_ids(FIRST_TRAINING_ID + torch.arange(per * 2))
    trials = trials[torch.isin(trials.object_index, objects.int())][:count]
    T_obj_ee, T_world_ee = proposals(evaluator, trials, clouds, generator)
    scores = evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")
    keep = scores.success
    trials, T_obj_ee, T_world_ee, width = trials[keep], T_obj_ee[keep], T_world_ee[keep], scores.width_m[keep]
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))  # the gripper looks the same after half a turn
    T_obj_ee, T_world_ee = torch.cat([T_obj_ee, T_obj_ee @ turn]), torch.cat([T_world_ee, T_world_ee @ turn])
    trials = trials[torch.arange(len(trials)).repeat(2)]
    points, normals, _ = clouds.rows(trials.object_index)
    x = se3.apply(se3.inverse(T_obj_ee)[:, None], points)
    n = (normals * T_obj_ee[:, None, :3, 1]).sum(-1)
    pad = torch.stack([torch.zeros_like(width), width / 2, torch.zeros_like(width)], -1).repeat(2, 1)[:, None]
    point = ((x - pad).norm(dim=-1) + 0.02 * (1 - n)).argmin(1)
    return Examples(trials, T_obj_ee.contiguous(), T_world_ee.contiguous(), point)
