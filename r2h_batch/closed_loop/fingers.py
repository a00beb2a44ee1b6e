"""Hands whose fingers change in the middle of an episode: one for each trial, as distances read them."""

from collections.abc import Iterable
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.judge.distance import HandTables
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.robot.world import World
from r2h_batch.scene.bounds import BLOCK_POINTS
from r2h_batch.scene.scene import Scene

ROUNDING_M = 1e-6
"""Added to radii: what float32 rounds."""


class OwnHands:
    """A hand of its own for each of B trials, of the scene's hand model. `put` gives a trial another one."""

    def __init__(self, scene: Scene, vertices: Float32[Tensor, "b v 3"]) -> None:
        """Args:
        scene: whose hand model they have.
        vertices: in the hands' frames, m.
        """
        b, device = len(vertices), scene.device
        faces, first, _ = scene.hands.faces
        self._faces = torch.from_numpy(faces).long().to(device)
        self._pieces = [piece.long().to(device) for piece in scene.hands.model.pieces]
        # all points of a piece have the hull of its corners
        padded = [torch.cat([p, p[-1:].expand(-len(p) % BLOCK_POINTS)]) for p in self._pieces]
        self._in_blocks = torch.cat(padded)
        others = wp.to_torch(scene.world.points)
        self._points = torch.cat([others, others.new_zeros(b * len(self._in_blocks), 3)])
        self._own_points = self._points[len(others) :].view(b, len(self._in_blocks), 3)
        shapes = {
            "vertices": (*vertices.shape,),
            "face_ball": (b, len(faces), 4),
            "piece_center": (b, len(self._pieces), 3),
            "piece_radius": (b, len(self._pieces)),
            "hand_center": (b, 3),
            "hand_radius": (b,),
        }
        self._arrays = {
            name: torch.zeros(shape, dtype=torch.float32, device=device)
            for name, shape in shapes.items()
        }
        mesh = HandMesh()
        world: Any = scene.sized(World)()
        world.assign(scene.world)  # its arrays are shared
        mesh.n_vertices, mesh.n_faces = vertices.shape[1], len(faces)
        mesh.faces = wp.array(faces, dtype=wp.int32, device=device)
        mesh.piece_face = wp.array(first, dtype=wp.int32, device=device)
        for name, array in self._arrays.items():
            owner = mesh if name in ("vertices", "face_ball") else world
            size = array.shape[-1]
            if name.endswith("radius"):
                setattr(owner, name, wp.from_torch(array.view(-1)))
            else:
                kind = wp.vec4 if size == 4 else wp.vec3
                setattr(owner, name, wp.from_torch(array.view(-1, size), dtype=kind))
        rows = torch.tensor([len(p) for p in padded], dtype=torch.int32, device=device)
        first_of_hand = torch.arange(b, dtype=torch.int32, device=device) * len(self._in_blocks)
        start = len(others) + first_of_hand[:, None] + torch.cumsum(rows, 0) - rows
        world.points = wp.from_torch(self._points, dtype=wp.vec3)
        self._fixed = (
            start.to(torch.int32).flatten(),
            (rows // BLOCK_POINTS).repeat(b),
            torch.zeros(b * len(rows), dtype=torch.float32, device=device),
        )
        for name, array in zip(
            ("piece_start", "piece_blocks", "piece_round"), self._fixed, strict=True
        ):
            setattr(world, name, wp.from_torch(array))
        self.tables = HandTables(world, mesh)
        self.put(torch.arange(b, dtype=torch.int64, device=device), vertices)

    @property
    def vertices(self) -> Float32[Tensor, "b v 3"]:
        """The hands as they are, in their frames, m."""
        return self._arrays["vertices"]

    def put(self, rows: Int64[Tensor, " r"], vertices: Float32[Tensor, "r v 3"]) -> None:
        """Gives some trials other hands.

        Args:
            rows: which trials.
            vertices: in the hands' frames, m.
        """
        if not len(rows):
            return
        new, a = vertices.to(self._faces.device), self._arrays
        a["vertices"][rows] = new
        center, radius = _ball(new[:, self._faces])
        a["face_ball"][rows] = torch.cat([center, radius[..., None]], 2)
        a["hand_center"][rows], a["hand_radius"][rows] = _ball(new)
        blocks = new[:, self._in_blocks].unflatten(1, (-1, BLOCK_POINTS))  # as `point_blocks`
        self._own_points[rows] = blocks.transpose(2, 3).flatten(1).unflatten(1, (-1, 3))
        pieces = [_ball(new[:, piece]) for piece in self._pieces]
        a["piece_center"][rows], a["piece_radius"][rows] = _stacked(pieces)


def _ball(points: Float32[Tensor, "*n k 3"]) -> tuple[Tensor, Tensor]:
    """Centre and radius of balls around points: the middle of their box."""
    center = (points.amin(-2) + points.amax(-2)) / 2
    far = (points - center[..., None, :]).square().sum(-1).sqrt().amax(-1)
    return center, far + ROUNDING_M


def _stacked(parts: Iterable[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    centers, radii = zip(*parts, strict=True)
    return torch.stack(centers, 1), torch.stack(radii, 1)
