"""Images of depth cameras beside three other renderers on the same meshes: docs/results/observe.md.

`python bench/observe.py` draws whole images of cell-v1's left post at two sizes with the package's rays, mujoco_warp's renderer,
MuJoCo C's rays and OpenGL, and compares time, depth and labels.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from _report import Report, markdown_table
from run import Bench

MEASURES = ("bench/observe.py", "kernels/observe", "kernels/options.py", "r2h_batch/observe", "r2h_batch/scene")
SIZES = (128, 64)
HEIGHT_DEG = 58.0
SMALL_PX = 128
"""Side of the two windows of a seen trial whose rate the design asks for."""
NAMES = {
    "rays": "r2h_batch, rays",
    "mujoco_warp": "mujoco_warp's renderer, depth and segmentation",
    "opengl": "MuJoCo C, OSMesa, two passes",
    "multiray": "MuJoCo C, `mj_multiRay`",
}


def clock(call: Callable[[], Any]) -> tuple[Any, float]:
    """A call's result and its process seconds."""
    begin = time.process_time()
    found = call()
    return found, time.process_time() - begin


class Peers:
    """The same trials as one MuJoCo model: meshes, and where each geom of a trial stands."""

    def __init__(self, scene: Any, trials: Any, T_world_obj: np.ndarray, rig: Any) -> None:
        import mujoco
        from scipy.spatial.transform import Rotation

        from r2h_batch.observe.robot_mesh import robot_at_home

        self.scene, self.trials, self.T, place = scene, trials, T_world_obj, scene.config.workplace
        self.T_camera = rig.T_world_camera[0].double().numpy()
        spec, G = mujoco.MjSpec(), mujoco.mjtGeom
        objects, hands = (sorted(set(x.tolist())) for x in (trials.object_index, trials.hand_index))
        skin, faces = scene.hands.vertices.numpy(), scene.hands.model.faces_by_side.numpy()
        meshes = {"robot": robot_at_home(scene.robot, tuple(place.home_q))}
        meshes |= {f"o{o}": (scene.objects[o].vertices, scene.objects[o].faces) for o in objects}
        meshes |= {f"h{h}": (skin[h], faces[int(scene.hands.set.side[h])]) for h in hands}
        for name, (v, f) in meshes.items():
            spec.add_mesh(
                name=name, uservert=np.asarray(v, float).ravel(), userface=np.asarray(f, np.int32).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )  # fmt: skip
        world = spec.worldbody
        world.add_geom(name="table", type=G.mjGEOM_BOX, pos=place.table_center, size=place.table_half)
        for name, mesh in (("robot", "robot"), ("object", f"o{objects[0]}"), ("hand", f"h{hands[0]}")):
            world.add_geom(name=name, type=G.mjGEOM_MESH, meshname=mesh)
        for name in ("forearm", "upper_arm", "head"):
            world.add_geom(name=name, type=G.mjGEOM_CAPSULE, size=[0.05, 0.1, 0])
        world.add_geom(name="torso", type=G.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
        camera = world.add_camera(name="left", fovy=HEIGHT_DEG, pos=self.T_camera[:3, 3])
        # MuJoCo's cameras have y up and look along -z
        turn = Rotation.from_matrix(self.T_camera[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
        camera.quat = np.roll(turn.as_quat(), 1)
        spec.visual.map.znear, spec.visual.map.zfar, spec.stat.extent = 0.05, 10.0, 1.0
        spec.visual.global_.offwidth = spec.visual.global_.offheight = max(SIZES)
        self.model = spec.compile()
        self.geom = {self.model.geom(i).name: i for i in range(self.model.ngeom)}
        from r2h_batch.observe import LABELS

        self.label_of = np.zeros(self.model.ngeom + 1, int)
        for name, i in self.geom.items():
            self.label_of[i] = LABELS.index(name)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        # rays are culled by boxes of the meshes that the model was compiled with; a trial has others
        self.model.geom_aabb[:] = (0.0, 0.0, 0.0, 5.0, 5.0, 5.0)
        self.worlds = [self.world(i) for i in range(len(trials))]

    def _own(self, name: str) -> tuple[int, np.ndarray]:
        """A mesh's number, and its frame in the vertices' (the compiler turns meshes into their principal axes)."""
        from scipy.spatial.transform import Rotation

        i = self.model.mesh(name).id
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(np.roll(self.model.mesh_quat[i], -1)).as_matrix()
        T[:3, 3] = self.model.mesh_pos[i]
        return i, T

    def world(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mesh, pose in the world and size of each geom in a trial."""
        mesh, size = self.model.geom_dataid.copy(), self.model.geom_size.copy()
        X = np.tile(np.eye(4), (self.model.ngeom, 1, 1))
        X[self.geom["table"], :3, 3] = self.scene.config.workplace.table_center
        X[self.geom["robot"]] = self._own("robot")[1]
        for name, own, T in (
            ("object", f"o{int(self.trials.object_index[i])}", self.T[i]),
            ("hand", f"h{int(self.trials.hand_index[i])}", self.trials.T_world_hand[i].double().numpy()),
        ):
            mesh[self.geom[name]], M = self._own(own)
            X[self.geom[name]] = T @ M
        from r2h_batch.scene.person import heads_of

        s, e, w, m, half = self.trials.receiver[i].double().numpy()
        low, high = heads_of(self.trials.receiver[i : i + 1])[0].double().numpy()
        for name, a, b, radius in (("forearm", e, w, e[3]), ("upper_arm", s, e, s[3]), ("head", low, high, low[3])):
            z = b[:3] - a[:3]
            length = np.linalg.norm(z)
            z = z / length
            x = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
            x /= np.linalg.norm(x)
            X[self.geom[name], :3, :3] = np.stack([x, np.cross(z, x), z], 1)
            X[self.geom[name], :3, 3] = 0.5 * (a[:3] + b[:3])
            size[self.geom[name]] = radius, 0.5 * length, 0.0
        X[self.geom["torso"], :3, :3] = [[m[3], -half[3], 0], [half[3], m[3], 0], [0, 0, 1]]
        X[self.geom["torso"], :3, 3], size[self.geom["torso"]] = m[:3], half[:3]
        return mesh, X, size

    def put(self, i: int) -> None:
        mesh, X, size = self.worlds[i]
        self.model.geom_dataid[:], self.model.geom_size[:], self.model.geom_rbound[:] = mesh, size, 5.0
        self.data.geom_xpos[:], self.data.geom_xmat[:] = X[:, :3, 3], X[:, :3, :3].reshape(-1, 9)

    def multiray(self, n: int, side: int, focal: float) -> tuple[np.ndarray, np.ndarray, float]:
        import mujoco

        u = (np.arange(side) + 0.5 - side / 2) / focal
        x, y = np.meshgrid(u, u)
        rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
        scale = 1.0 / np.linalg.norm(rays, axis=1)
        directions = np.ascontiguousarray((rays * scale[:, None]) @ self.T_camera[:3, :3].T).ravel()
        origin = np.ascontiguousarray(self.T_camera[:3, 3])
        geom, far = np.zeros(side * side, np.int32), np.zeros(side * side)
        depth, label, seconds = np.zeros((n, side, side)), np.zeros((n, side, side), int), 0.0
        for i in range(n):
            self.put(i)
            args = (
                self.model,
                self.data,
                origin,
                directions,
                None,
                1,
                -1,
                geom,
                far,
                None,
                side * side,
                mujoco.mjMAXVAL,
            )
            _, took = clock(partial(mujoco.mj_multiRay, *args))
            seconds += took
            label[i] = np.where(geom >= 0, self.label_of[geom], 0).reshape(side, side)
            depth[i] = np.where(label[i] > 0, (far * scale).reshape(side, side), 0)
        return depth, label, seconds

    def opengl(self, n: int, side: int, focal: float) -> tuple[np.ndarray, np.ndarray, float]:
        import mujoco

        from r2h_batch.scene import offscreen

        offscreen.ready()
        depth, label, seconds = np.zeros((n, side, side)), np.zeros((n, side, side), int), 0.0
        with mujoco.Renderer(self.model, side, side) as drawer:

            def both() -> tuple[np.ndarray, np.ndarray]:
                drawer.enable_depth_rendering()
                drawer.update_scene(self.data, "left")
                far = drawer.render().copy()
                drawer.disable_depth_rendering()
                drawer.enable_segmentation_rendering()
                drawer.update_scene(self.data, "left")
                geom = drawer.render()[:, :, 0].copy()
                drawer.disable_segmentation_rendering()
                return far, geom

            for i in range(n):
                self.put(i)
                (depth[i], geom), took = clock(both)
                seconds += took
                label[i] = np.where(geom >= 0, self.label_of[np.clip(geom, 0, self.model.ngeom)], 0)
        return depth, label, seconds

    def mujoco_warp(self, n: int, side: int, focal: float) -> tuple[np.ndarray, np.ndarray, float]:
        import mujoco_warp as mjw
        import warp as wp

        model, data = mjw.put_model(self.model), mjw.put_data(self.model, self.data, nworld=n)
        worlds = self.worlds[:n]
        model.geom_dataid = wp.array(np.stack([a for a, _, _ in worlds]).astype(np.int32), dtype=int)
        model.geom_size = wp.array(np.stack([s for _, _, s in worlds]).astype(np.float32), dtype=wp.vec3)
        data.geom_xpos = wp.array(np.stack([X[:, :3, 3] for _, X, _ in worlds]).astype(np.float32), dtype=wp.vec3)
        data.geom_xmat = wp.array(np.stack([X[:, :3, :3] for _, X, _ in worlds]).astype(np.float32), dtype=wp.mat33)
        context = mjw.create_render_context(
            self.model, nworld=n, cam_res=(side, side), render_rgb=False, render_depth=True, render_seg=True,
            use_textures=False, use_shadows=False,
        )  # fmt: skip
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)  # compiles
        _, seconds = clock(lambda: mjw.render(model, data, context))
        segments = wp.zeros((n, side, side), dtype=wp.vec2i)
        mjw.get_segmentation(context, 0, segments)
        geom = segments.numpy()[..., 0]
        label = np.where(geom >= 0, self.label_of[np.clip(geom, 0, self.model.ngeom)], 0)
        return context.depth_data.numpy().reshape(n, side, side).copy(), label, seconds


def off_border(theirs: np.ndarray, ours: np.ndarray) -> int:
    """The number of pixels whose label none of the nine about it has in the other one's image."""
    wide = np.pad(ours, ((0, 0), (1, 1), (1, 1)), mode="edge")
    h, w = ours.shape[1:]
    about = [wide[:, v : v + h, u : u + w] == theirs for v in range(3) for u in range(3)]
    return int((~np.any(about, axis=0)).sum())


def measure(options: argparse.Namespace, __: Report) -> dict[str, Any]:
    import torch

    from r2h_batch import Evaluator, load_benchmark
    from r2h_batch.observe import load_rig, look, moments
    from r2h_batch.observe.rays import bodies_of

    torch.set_num_threads(1)
    evaluator = Evaluator(load_benchmark("r2h-v2"), threads=1)
    scene, rig, n = evaluator.scene, load_rig("cell-v1"), options.trials
    trials = evaluator.benchmark.trials(n // 2)
    bodies = bodies_of(scene)
    T = moments(scene, trials)
    look(scene, trials, rig, T, labels="grown")  # compiles
    _, t_moment = clock(lambda: moments(scene, trials))
    _, t_exact = clock(lambda: look(scene, trials, rig, T, noise=0))
    _, t_masks = clock(lambda: look(scene, trials, rig, T, labels="grown"))
    seen, t_images = clock(lambda: look(scene, trials, rig, T))
    _, t_cloud = clock(lambda: seen.cloud(2048))
    small = rig.only("left").model_copy(update={"object_px": SMALL_PX, "hand_px": SMALL_PX})
    for _ in range(1 + 50 // n):
        look(scene, trials, small, T)  # until table and robot are drawn and kept
    _, t_small = clock(lambda: look(scene, trials, small, T).cloud(2048))
    out: dict[str, Any] = {
        "trials": n, "few": options.few, "seen_px": [rig.object_px, rig.hand_px], "moment_ms": 1e3 * t_moment / n,
        "exact_ms": 1e3 * t_exact / n, "images_ms": 1e3 * t_images / n,
        "masks_ms": 1e3 * (t_masks - t_images) / n, "cloud_ms": 1e3 * t_cloud / n,
        "small_ms": 1e3 * (t_moment + t_small) / n, "sizes": {},
    }  # fmt: skip
    print({k: v for k, v in out.items() if k.endswith("ms")}, flush=True)
    peers = Peers(scene, trials, T.double().numpy(), rig)
    corner = torch.zeros((n, 1, 2), dtype=torch.int32)
    for side in SIZES:
        focal = 0.5 * side / np.tan(np.radians(HEIGHT_DEG) / 2)

        def ours(side: int = side, focal: float = focal) -> Any:
            camera = rig.T_world_camera[:1]
            how: dict[str, Any] = {"focal_px": focal, "sensor_px": (side, side), "columns": side, "rows": side}
            return bodies.cast(trials, T, camera, corner, **how)

        ours()
        (depth, label, _), seconds = clock(ours)
        own = depth[:, 0].numpy(), label[:, 0].numpy()
        found: dict[str, Any] = {"rays": {"per_s": n / seconds}}
        for name in ("mujoco_warp", "opengl", "multiray"):
            count = n if name == "mujoco_warp" else options.few
            d, what, seconds = getattr(peers, name)(count, side, focal)
            same = (what == own[1][:count]) & (what > 0)
            off = 1e3 * np.abs(d - own[0][:count])[same]
            found[name] = {
                "per_s": count / seconds, "other_label": float((what != own[1][:count]).mean()),
                "off_border": off_border(what, own[1][:count]),
                "median_mm": float(np.median(off)), "p99_mm": float(np.quantile(off, 0.99)), "most_mm": float(off.max()),
            }  # fmt: skip
            print(side, name, found[name], flush=True)
        print(side, "rays", found["rays"], flush=True)
        out["sizes"][str(side)] = found
    return out


def shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    sizes = data["sizes"]
    speed, agreement = [], []
    for name, words in NAMES.items():
        rates = [sizes[s][name]["per_s"] for s in sizes]
        ratios = [sizes[s]["rays"]["per_s"] / r for s, r in zip(sizes, rates, strict=True)]
        speed.append([words, *(f"{r:.0f}" for r in rates), *(f"{x:.1f}" for x in ratios)])
        for s in sizes if name != "rays" else ():
            f = sizes[s][name]
            numbers = (f"{f['median_mm']:.4f}", f"{f['p99_mm']:.3f}", f"{f['most_mm']:.1f}")
            agreement.append([f"{words}, {s} x {s}", f"{100 * f['other_label']:.3f} %", str(f["off_border"]), *numbers])
    total = data["moment_ms"] + data["images_ms"] + data["cloud_ms"]
    wide = [f"{s} x {s}" for s in sizes]
    return {
        "speed": markdown_table(["images a second and core", *wide, *(f"ours is times, {w}" for w in wide)], speed),
        "agreement": markdown_table(
            ["against", "other label", "beyond a pixel", "median", "99 %", "largest"], agreement
        ),
        "windows": " and ".join(f"{p} x {p}" for p in data["seen_px"]),
        "seen_per_s": 1e3 / total,
        "small_px": SMALL_PX,
        "small_per_s": 1e3 / data["small_ms"],
        "share": 100 * data["exact_ms"] / (data["images_ms"] + data["cloud_ms"]),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--trials": {"default": 24, "help": "of both splits"},
        "--few": {"default": 8, "help": "of them for MuJoCo C and OpenGL"},
    },
    peer="mujoco_warp's renderer, MuJoCo C's rays and OpenGL",
    stored="observe",
)

if __name__ == "__main__":
    BENCH.main()
