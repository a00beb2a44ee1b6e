"""Depth and labels of trials at the moment that cameras see, by rays on the scene's own meshes."""

from collections import OrderedDict
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Int32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.observe import rays as kernels
from r2h_batch.observe.robot_mesh import robot_at_home
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

FAR_M = 4.0
"""Nothing is seen beyond this [choice]: stereo of 50 mm has 9 cm of noise there."""
KEPT_HANDS = 512
"""Meshes of hands that stay between calls: 0.3 MB each."""


class Bodies:
    """The meshes of a scene for rays. Hands are made when a trial first needs them.

    Args:
        scene: robot, objects, hands and table.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, place = scene, scene.config.workplace
        vertices, faces = robot_at_home(scene.robot, tuple(place.home_q))
        self._robot = self._mesh(vertices, faces)
        self._hands: OrderedDict[int, wp.Mesh] = OrderedDict()
        self._skin = scene.hands.vertices.numpy()
        self._faces = scene.hands.model.faces_by_side.numpy()
        tables: Any = kernels.Bodies()
        tables.table_center, tables.table_half = (
            wp.vec3(*x) for x in (place.table_center, place.table_half)
        )
        tables.robot = self._robot.id
        tables.object_mesh = scene.object_mesh_ids
        tables.object_ball = self._balls([o.vertices for o in scene.objects])
        tables.hand_ball = self._balls(self._skin)
        self._tables = tables

    def _mesh(self, vertices: NDArray[np.float32], faces: NDArray[Any]) -> wp.Mesh:
        device = self.scene.device
        points: Any = wp.array(
            np.ascontiguousarray(vertices, np.float32), dtype=wp.vec3, device=device
        )
        corners = np.ascontiguousarray(faces, np.int32).ravel()
        return wp.Mesh(points, wp.array(corners, dtype=wp.int32, device=device))

    def _balls(self, meshes: Any) -> wp.array:
        found = np.empty((len(meshes), 4), np.float32)
        for i, v in enumerate(meshes):
            low, high = v.min(0).astype(np.float64), v.max(0).astype(np.float64)
            found[i, :3] = 0.5 * (low + high)
            away = v.astype(np.float64) - found[i, :3]
            found[i, 3] = np.sqrt((away * away).sum(1).max()) + 1e-5
        return wp.array(found, dtype=wp.vec4, device=self.scene.device)

    def tables(self, trials: Trials) -> Any:
        """The struct `Bodies` of the kernels, with the hands of these trials."""
        needed = np.unique(trials.hand_index.cpu().numpy()).tolist()
        side = self.scene.hands.set.side
        for h in needed:
            if h not in self._hands:
                self._hands[h] = self._mesh(self._skin[h], self._faces[int(side[h])])
            self._hands.move_to_end(h)
        while len(self._hands) > max(KEPT_HANDS, len(needed)):
            self._hands.popitem(last=False)
        ids = np.zeros(len(self._skin), np.uint64)
        for h, mesh in self._hands.items():
            ids[h] = mesh.id
        self._tables.hand_mesh = wp.array(ids, dtype=wp.uint64, device=self.scene.device)
        self._tables.person = int(trials.receiver is not None)
        return self._tables

    def placed(self, trials: Trials, T_world_obj: Float32[Tensor, "n 4 4"]) -> dict[str, Any]:
        """The kernels' arguments about trials."""
        receiver = trials.receiver
        if receiver is None:
            receiver = torch.zeros(
                (len(trials), 5, 4), dtype=torch.float32, device=T_world_obj.device
            )
        return {
            "bodies": self.tables(trials),
            "object": trials.object_index.contiguous(),
            "T_world_obj": T_world_obj.contiguous(),
            "hand": trials.hand_index.contiguous(),
            "T_world_hand": trials.T_world_hand.contiguous(),
            "receiver": receiver.contiguous(),
        }

    def near(
        self,
        trials: Trials,
        T_world_obj: Float32[Tensor, "n 4 4"],
        points: Float32[Tensor, "n k 3"],
        *,
        within_m: float,
        resting: bool,
    ) -> UInt8[Tensor, "n k"]:
        """A body (of `LABELS`) that is near each point; 0: none is.

        Args:
            trials: N trials.
            T_world_obj: (N, 4, 4) float32, where the objects lie, m.
            points: (N, K, 3) float32, world, m.
            within_m: how near, m.
            resting: the points are of the object: it and the table are left out.
        """
        n, k = points.shape[:2]
        run = over_trials(kernels.near, n, self.scene.device, sizes={"label": k}, width=k, chunk=4)
        made = run(
            within=within_m,
            resting=int(resting),
            points=points.contiguous(),
            **self.placed(trials, T_world_obj),
        )
        found: Tensor = made["label"]
        return found

    def cast(
        self,
        trials: Trials,
        T_world_obj: Float32[Tensor, "n 4 4"],
        T_world_camera: Float32[Tensor, "c 4 4"],
        corner_px: Int32[Tensor, "n c 2"],
        *,
        focal_px: float,
        sensor_px: tuple[int, int],
        columns: int,
        rows: int,
        stride: int = 1,
    ) -> tuple[Float32[Tensor, "n c h w"], UInt8[Tensor, "n c h w"], Float32[Tensor, "n c h w"]]:
        """Depth along each camera's z axis, m, labels (`LABELS`), and |cosine| of the ray's angle to the surface's normal.

        All three are 0 where nothing is.

        Args:
            trials: N trials.
            T_world_obj: (N, 4, 4) float32, where the objects lie, m.
            T_world_camera: (C, 4, 4) float32, OpenCV axes (x right, y down, z forward), m.
            corner_px: (N, C, 2) int32, column and row of the window's first pixel on the sensor. Pixels beyond the
                sensor see nothing.
            focal_px: of all cameras; the principal point is the sensor's middle.
            sensor_px: its columns and rows.
            columns: of the window's rays.
            rows: of the window's rays.
            stride: pixels between rays.
        """
        n, cameras = corner_px.shape[:2]
        pixels = cameras * columns * rows
        run = over_trials(
            kernels.cast, n, self.scene.device, sizes=dict.fromkeys(("depth", "label", "facing"), pixels),
            width=pixels, chunk=1,
        )  # fmt: skip
        made = run(
            cameras=cameras, columns=columns, rows=rows, stride=stride, focal=focal_px,
            principal=wp.vec2(0.5 * sensor_px[0], 0.5 * sensor_px[1]), far=FAR_M,
            camera=T_world_camera.contiguous(), corner=corner_px.contiguous(), sensor=wp.vec2i(*sensor_px),
            **self.placed(trials, T_world_obj),
        )  # fmt: skip
        shape = (n, cameras, rows, columns)
        return made["depth"].view(shape), made["label"].view(shape), made["facing"].view(shape)


@lru_cache(maxsize=2)
def bodies_of(scene: Scene) -> Bodies:
    """The meshes of a scene, made once."""
    return Bodies(scene)
