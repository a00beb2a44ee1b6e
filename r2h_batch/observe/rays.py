"""Depth and labels of trials at the moment that cameras see, by rays on the scene's own meshes."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Float64, Int32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.observe import rays as kernels
from r2h_batch.observe.robot_mesh import robot_at_home
from r2h_batch.observe.seen import LABELS
from r2h_batch.scene.person import heads_of
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

FAR_M = 4.0
"""Nothing is seen beyond this [choice]: stereo of 50 mm has 9 cm of noise there."""
KEPT_HANDS = 512
"""Meshes of hands that stay between calls: 0.3 MB each."""


def mesh_on(device: str, vertices: NDArray[Any], faces: NDArray[Any]) -> wp.Mesh:
    """A mesh for rays.

    Args:
        device: cpu, cuda or cuda:N.
        vertices: (V, 3), m.
        faces: (F, 3).
    """
    points: Any = wp.array(np.ascontiguousarray(vertices, np.float32), dtype=wp.vec3, device=device)
    corners = np.ascontiguousarray(faces, np.int32).ravel()
    return wp.Mesh(points, wp.array(corners, dtype=wp.int32, device=device))


def balls_of(meshes: Sequence[NDArray[Any]] | NDArray[Any], device: str) -> wp.array:
    """A ball for each mesh that holds its vertices: centre and radius, m.

    Args:
        meshes: (V, 3) vertices of each, m.
        device: cpu, cuda or cuda:N.
    """
    found = np.empty((len(meshes), 4), np.float32)
    for i, v in enumerate(meshes):
        low, high = v.min(0).astype(np.float64), v.max(0).astype(np.float64)
        found[i, :3] = 0.5 * (low + high)
        away = v.astype(np.float64) - found[i, :3]
        found[i, 3] = np.sqrt((away * away).sum(1).max()) + 1e-5
    return wp.array(found, dtype=wp.vec4, device=device)


FIXED = {"t": torch.float32, "label": torch.uint8, "facing": torch.float32}
"""The outputs of the kernel `background`."""
MOST_PIXELS = 1 << 24
"""Sensors with more pixels have no background: 9 bytes each."""


class Bodies:
    """The meshes of a scene for rays. Hands are made when a trial first needs them.

    Args:
        scene: robot, objects, hands and table.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, place = scene, scene.config.workplace
        vertices, faces = robot_at_home(scene.robot, tuple(place.home_q))
        self._robot = mesh_on(scene.device, vertices, faces)
        self._robot_balls = _balls_of_cells(vertices, faces, CELL_M)
        self._hands: OrderedDict[int, wp.Mesh] = OrderedDict()
        self._skin = scene.hands.vertices.numpy()
        self._faces = scene.hands.model.faces_by_side.numpy()
        tables: Any = kernels.Bodies()
        tables.table_center, tables.table_half = (
            wp.vec3(*x) for x in (place.table_center, place.table_half)
        )
        tables.robot = self._robot.id
        tables.object_mesh = scene.object_mesh_ids
        tables.object_ball = balls_of([o.vertices for o in scene.objects], scene.device)
        tables.hand_ball = balls_of(self._skin, scene.device)
        self._tables = tables
        self._asked: dict[Any, int] = {}
        self._backgrounds: dict[Any, dict[str, Tensor]] = {}

    def tables(self, trials: Trials) -> Any:
        """The struct `Bodies` of the kernels, with the hands of these trials."""
        needed = np.unique(trials.hand_index.cpu().numpy()).tolist()
        side = self.scene.hands.set.side
        for h in needed:
            if h not in self._hands:
                self._hands[h] = mesh_on(
                    self.scene.device, self._skin[h], self._faces[int(side[h])]
                )
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
            "head": heads_of(receiver),
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

    def _tiles(
        self,
        trials: Trials,
        T_world_camera: Float32[Tensor, "c 4 4"],
        corner_px: Int32[Tensor, "n c 2"],
        *,
        focal_px: float,
        sensor_px: tuple[int, int],
        window_px: tuple[int, int],
    ) -> Int32[Tensor, "n c t"]:
        """The labels of robot and person that a ray may meet in each tile of each window, as bits: the rectangle of a ball that
        holds the body, or a part of it, meets the tile."""
        device = corner_px.device
        steps = torch.arange(TILES + 1, dtype=torch.float64, device=device) / TILES
        edges = [
            corner_px[..., axis].double()[..., None] + steps * size
            for axis, size in enumerate(window_px)
        ]
        found = torch.zeros((*corner_px.shape[:2], TILES * TILES), dtype=torch.int32, device=device)

        def mark(label: str, center: Tensor, radius: Tensor) -> None:
            """`center` (m, k, 3), `radius` (m, k): k balls of m trials, or of all."""
            rect = _rects_of_balls(center, radius, T_world_camera.double(), focal_px, sensor_px)
            met = [
                (rect[..., axis, None] <= edges[axis][:, :, None, 1:])
                & (rect[..., 2 + axis, None] >= edges[axis][:, :, None, :-1])
                for axis in range(2)
            ]
            tiles = (met[1][..., :, None] & met[0][..., None, :]).any(2).flatten(2)
            found.add_(tiles.to(torch.int32) << LABELS.index(label))

        robot = torch.from_numpy(self._robot_balls).to(device)
        mark("robot", robot[None, :, :3], robot[None, :, 3])
        if (body := trials.receiver) is not None:
            shoulder, elbow, wrist, middle, half = body.double().to(device).unbind(1)
            for label, a, b in (("upper_arm", shoulder, elbow), ("forearm", elbow, wrist)):
                # a ball about each of the pieces of the segment
                along = (b - a)[:, :3] / PIECES
                step = torch.arange(PIECES, dtype=torch.float64, device=device) + 0.5
                middles = a[:, None, :3] + step[:, None] * along[:, None]
                size = 0.5 * se3.dot(along, along).sqrt() + a[:, 3]
                mark(label, middles, size[:, None].expand(-1, PIECES))
            size = se3.dot(half[:, :3], half[:, :3]).sqrt()
            mark("torso", middle[:, None, :3], size[:, None])
            ends = heads_of(body).double().to(device)
            along = (ends[:, 1] - ends[:, 0])[:, :3]
            size = 0.5 * se3.dot(along, along).sqrt() + ends[:, 0, 3]
            mark("head", ends.mean(1, keepdim=True)[..., :3], size[:, None])
        return found

    def _covered(
        self, placed: Mapping[str, Any], body: str, faces: int, window: Mapping[str, Any]
    ) -> UInt8[Tensor, "n k"]:
        """The cells of windows that a mesh's faces may be seen in.

        Args:
            placed: of `placed`.
            body: object or hand.
            faces: the most that one of its meshes has.
            window: of the kernels.
        """
        n, cameras = window["corner"].shape[:2]
        blocks = -(-faces // FACES)
        cells = [-(-window[k] // CELL) for k in ("rows", "columns")]
        T = placed["T_world_obj" if body == "object" else "T_world_hand"]
        run = over_trials(
            kernels.cover, n, self.scene.device, sizes={"cell": cameras * cells[0] * cells[1]},
            width=cameras * blocks, chunk=1,
        )  # fmt: skip
        found: Tensor = run(
            mesh=getattr(placed["bodies"], f"{body}_mesh"),
            row=placed[body],
            T=T,
            blocks=blocks,
            **window,
        )["cell"]
        return found

    def _background(
        self,
        T_world_camera: Float32[Tensor, "c 4 4"],
        focal_px: float,
        sensor_px: tuple[int, int],
        rays: int,
    ) -> dict[str, Tensor] | None:
        """Table and robot in each pixel of the sensors, which are the same in all trials; None until as many rays were asked for
        as the sensors have pixels."""
        pixels = sensor_px[0] * sensor_px[1]
        key = (T_world_camera.cpu().numpy().tobytes(), focal_px, sensor_px)
        self._asked[key] = self._asked.get(key, 0) + rays
        if not (self._asked[key] >= len(T_world_camera) * pixels <= MOST_PIXELS):
            return None
        if key not in self._backgrounds:
            self._backgrounds.clear()
            run = over_trials(
                kernels.background, len(T_world_camera), self.scene.device,
                sizes=dict.fromkeys(FIXED, pixels), width=pixels, chunk=1,
            )  # fmt: skip
            self._backgrounds[key] = run(
                columns=sensor_px[0], focal=focal_px, principal=wp.vec2(0.5 * sensor_px[0], 0.5 * sensor_px[1]),
                far=FAR_M, bodies=self._tables, camera=T_world_camera.contiguous(),
            )  # fmt: skip
        return self._backgrounds[key]

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
        pixels, device = cameras * columns * rows, T_world_obj.device
        placed = self.placed(trials, T_world_obj)
        tiles = self._tiles(
            trials, T_world_camera, corner_px,
            focal_px=focal_px, sensor_px=sensor_px, window_px=(stride * columns, stride * rows),
        )  # fmt: skip
        window: dict[str, Any] = {
            "focal": focal_px, "principal": wp.vec2(0.5 * sensor_px[0], 0.5 * sensor_px[1]),
            "camera": T_world_camera.contiguous(), "corner": corner_px.contiguous(),
            "cameras": cameras, "columns": columns, "rows": rows, "stride": stride,
        }  # fmt: skip
        objects, hand = self.scene.objects, self._faces.shape[1]
        faces = max((len(objects[i].faces) for i in set(trials.object_index.tolist())), default=1)
        cells = {
            "object_cell": self._covered(placed, "object", faces, window),
            "hand_cell": self._covered(placed, "hand", hand, window),
        }
        # a thread of a CPU takes a row: half of its time went into where each pixel lies
        several = columns if self.scene.device == "cpu" else 1
        fixed = None
        if stride == 1:
            fixed = self._background(T_world_camera, focal_px, sensor_px, n * pixels)
        shown = fixed or {k: torch.empty((0, 0), dtype=t, device=device) for k, t in FIXED.items()}
        run = over_trials(
            kernels.cast, n, self.scene.device, sizes=dict.fromkeys(("depth", "label", "facing"), pixels),
            width=pixels // several, chunk=1,
        )  # fmt: skip
        made = run(
            several=several, far=FAR_M, sensor=wp.vec2i(*sensor_px), tile=tiles, **window, **cells,
            known=int(fixed is not None), **{f"fixed_{k}": x for k, x in shown.items()},
            **placed,
        )  # fmt: skip
        shape = (n, cameras, rows, columns)
        return made["depth"].view(shape), made["label"].view(shape), made["facing"].view(shape)


@lru_cache(maxsize=2)
def bodies_of(scene: Scene) -> Bodies:
    """The meshes of a scene, made once."""
    return Bodies(scene)


TILES = 16
"""Tiles of a window each way, as in the kernel."""
CELL, FACES = 2, 64
"""Rays of a cell each way, and faces that a thread looks at, as in the kernel."""
PIECES = 6
"""Pieces of an arm's segment, each with a ball of its own."""
CELL_M, SLACK_M, SLACK_PX = 0.05, 1e-3, 2.0
"""Side of the pieces of the robot that rectangles are made of; what bounds are too large by, for rounding."""


def _balls_of_cells(
    vertices: NDArray[np.float32], faces: NDArray[Any], cell_m: float
) -> NDArray[np.float64]:
    """(k, 4) balls, centre and radius, that hold a mesh: one for the faces that begin in each cell of a grid."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces).reshape(-1, 3)]
    cell = np.floor(corners[:, 0] / cell_m).astype(np.int64)
    _, of = np.unique(cell, axis=0, return_inverse=True)
    found = []
    for k in range(int(of.max()) + 1):
        own = corners[of.ravel() == k].reshape(-1, 3)
        middle = 0.5 * (own.min(0) + own.max(0))
        away = own - middle
        found.append([*middle, np.sqrt((away * away).sum(1).max())])
    return np.array(found)


def _rects_of_balls(
    center: Float64[Tensor, "m k 3"],
    radius: Float64[Tensor, "m k"],
    T_world_camera: Float64[Tensor, "c 4 4"],
    focal_px: float,
    sensor_px: tuple[int, int],
) -> Float64[Tensor, "m c k 4"]:
    """Rectangles that hold the projections of balls; from inf to -inf for what no pixel shows. A ball beside the camera's plane
    may be anywhere."""
    local = se3.apply(se3.inverse(T_world_camera)[None, :, None], center[:, None])
    r = radius[:, None] + SLACK_M
    near = local[..., 2] - r
    anywhere = (near <= SLACK_M) & (local[..., 2] + r > 0)
    gone = local[..., 2] + r <= 0
    lows, highs = [], []
    for axis, size in enumerate(sensor_px):
        low, high = local[..., axis] - r, local[..., axis] + r
        z_low = torch.where(low < 0, near, local[..., 2] + r).clamp(min=SLACK_M)
        z_high = torch.where(high > 0, near, local[..., 2] + r).clamp(min=SLACK_M)
        a = focal_px * low / z_low + 0.5 * size - SLACK_PX
        b = focal_px * high / z_high + 0.5 * size + SLACK_PX
        lows.append(a.where(~anywhere, -torch.inf))
        highs.append(b.where(~anywhere, torch.inf))
        gone = gone | (highs[-1] < 0) | (lows[-1] > size)
    lows = [a.where(~gone, torch.inf) for a in lows]
    highs = [b.where(~gone, -torch.inf) for b in highs]
    return torch.stack([*lows, *highs], 3)
