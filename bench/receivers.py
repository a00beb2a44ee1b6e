"""The people of protocol r2h-v1, looked at: `python bench/receivers.py` writes docs/receivers.png (12 of them from the side) and
docs/receivers_angles.png (how hands point and where they are), and prints percentiles. MUJOCO_GL=osmesa without a display."""

import argparse
from pathlib import Path

import mujoco
import numpy as np
import torch

from r2h_batch.bodies.hand import load_hand_set, palm_frame
from r2h_batch.bodies.robot import Kind, forward_kinematics, gripper_primitives_at, load_robot
from r2h_batch.config import HOME_Q, OPEN_GAP_M, TABLE_CENTER, TABLE_HALF
from r2h_batch.trials.protocol import make_trials, trials_digest
from r2h_batch.types import Trials

DOCS = Path(__file__).parents[1] / "docs"
GEOMS = {Kind.SPHERE: "SPHERE", Kind.CAPSULE: "CAPSULE", Kind.CYLINDER: "CYLINDER", Kind.BOX: "BOX"}
SKIN, CLOTH, STEEL, WOOD = (0.85, 0.65, 0.5, 1), (0.35, 0.45, 0.6, 1), (0.7, 0.72, 0.75, 1), (0.55, 0.45, 0.35, 1)


def angles(trials: Trials) -> dict[str, np.ndarray]:
    """Degrees and metres of N trials, by what they measure."""
    hands = load_hand_set()
    joints = hands.model.pose(hands.pose, hands.shape, hands.side).joints.double()
    point, normal = palm_frame(joints, hands.side)
    rows = trials.hand_index.long()
    T = trials.T_world_hand.double()

    def turned(x: torch.Tensor) -> np.ndarray:
        return (T[:, :3, :3] @ x[rows][:, :, None])[:, :, 0].numpy()

    palm, along = turned(normal), turned(joints[:, 4] - joints[:, 0])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    center = turned(point) + T[:, :3, 3].numpy() + 0.12 * palm
    robot = -center * [1, 1, 0] / np.linalg.norm(center[:, :2], axis=1, keepdims=True)
    out = {
        "fingers from the robot, deg": between(along, robot),
        "palm from the robot, deg": between(palm, robot),
        "palm from up, deg": between(palm, np.array([[0.0, 0, 1]])),
        "height of c_h, m": center[:, 2],
        "c_h from the robot's axis, m": np.linalg.norm(center[:, :2], axis=1),
    }
    if trials.receiver is not None:
        shoulder, elbow, wrist = (trials.receiver[:, k, :3].double().numpy() for k in range(3))
        out["elbow bent, deg"] = between(elbow - shoulder, wrist - elbow)
        out["wrist bent, deg"] = between(wrist - elbow, along)
        arm = sum(np.linalg.norm(a, axis=1) for a in (elbow - shoulder, wrist - elbow))
        out["wrist's share of the arm's length"] = np.linalg.norm(wrist - shoulder, axis=1) / arm
    return out


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (n,) in degrees between vectors (n, 3)."""
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def scene_of(trials: Trials, row: int) -> mujoco.MjModel:
    """A trial with its receiver, the robot at home."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 640, 560
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=8, height=48,
    )  # fmt: skip
    world = spec.worldbody

    def add(kind: str, pos: np.ndarray, size: list[float], rgba: tuple, R: np.ndarray | None = None) -> None:
        geom = world.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), pos=pos, size=size, rgba=rgba)
        if R is not None:
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, R.ravel())
            geom.quat = quat

    def capsule(a: np.ndarray, b: np.ndarray, radius: float, rgba: tuple) -> None:
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*a, *b], size=[radius, 0, 0], rgba=rgba
        )  # fmt: skip

    add("PLANE", np.array([0, 0, -0.74]), [2, 2, 0.1], (0.9, 0.9, 0.88, 1))
    add("BOX", np.array(TABLE_CENTER), list(TABLE_HALF), WOOD)
    robot = load_robot()
    links = forward_kinematics(robot, HOME_Q)
    grip = links[6] @ robot.T_wrist3_flange @ robot.T_flange_ee @ gripper_primitives_at(robot, OPEN_GAP_M)
    for table, poses in ((robot.arm, links[robot.arm.link] @ robot.arm.T_link_prim), (robot.gripper, grip)):
        for kind, size, T in zip(table.kind, table.size, poses, strict=True):
            add(GEOMS[Kind(int(kind))], T[:3, 3], list(size), STEEL, np.ascontiguousarray(T[:3, :3]))
    assert trials.receiver is not None
    r = trials.receiver[row].double().numpy()
    capsule(r[0, :3], r[1, :3], r[0, 3], SKIN)
    capsule(r[1, :3], r[2, :3], r[1, 3], SKIN)
    c, s = r[3, 3], r[4, 3]
    add("BOX", r[3, :3], list(r[4, :3]), CLOTH, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
    add("SPHERE", r[3, :3] + [0, 0, r[4, 2] + 0.17], [0.1, 0, 0], SKIN)  # for the eye alone: nothing knows of a head
    hands = load_hand_set()
    i = int(trials.hand_index[row])
    posed = hands.model.pose(hands.pose[i : i + 1], hands.shape[i : i + 1], hands.side[i : i + 1])
    T = trials.T_world_hand[row].double().numpy()
    v = posed.vertices[0].double().numpy() @ T[:3, :3].T + T[:3, 3]
    faces = hands.model.faces.numpy()
    faces = faces if int(hands.side[i]) == 0 else faces[:, ::-1]
    spec.add_mesh(name="hand", uservert=v.ravel(), userface=faces.ravel().astype(np.int32))
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hand", rgba=SKIN)
    return spec.compile()


def people(trials: Trials, rows: list[int], path: Path) -> None:
    """Pictures of trials from the side, four in a line."""
    from PIL import Image

    images = []
    for row in rows:
        model = scene_of(trials, row)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        camera = mujoco.MjvCamera()
        left = int(load_hand_set().side[trials.hand_index[row].long()]) == 1  # seen from the arm's side
        camera.lookat[:], camera.distance, camera.elevation = [0.4, 0, 0.15], 2.4, -12
        camera.azimuth = 112 if left else -112
        with mujoco.Renderer(model, 420, 480) as renderer:
            renderer.update_scene(data, camera)
            images.append(renderer.render())
    lines = [np.concatenate(images[k : k + 4], 1) for k in range(0, len(images), 4)]
    Image.fromarray(np.concatenate(lines, 0)).quantize(128).save(path, optimize=True)


def histograms(found: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Both protocols, one measure a panel."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(found["r2h-v1"])
    figure, axes = plt.subplots(2, 4, figsize=(13, 5.2))
    for axis, name in zip(axes.flat, names, strict=True):
        values = [found[p][name] for p in found if name in found[p]]
        bins = np.linspace(min(v.min() for v in values), max(v.max() for v in values), 40)
        for protocol in found:
            if name in found[protocol]:
                axis.hist(found[protocol][name], bins, density=True, histtype="step", label=protocol)
        axis.set_xlabel(name)
        axis.set_yticks([])
    axes[0, 0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2000, help="of each split")
    parser.add_argument("--out", type=Path, default=DOCS)
    given = parser.parse_args()
    found = {}
    for protocol in ("r2h-v0", "r2h-v1"):
        trials = make_trials(trials=given.trials, protocol=protocol)
        found[protocol] = angles(trials)
        print(f"{protocol}: digest of {given.trials} trials a split {trials_digest(trials)}")
        for name, x in found[protocol].items():
            print(f"  {name:36s} " + " ".join(f"{q:8.2f}" for q in np.percentile(x, [5, 50, 95])))
    people(trials, list(range(12)), given.out / "receivers.png")
    histograms(found, given.out / "receivers_angles.png")


if __name__ == "__main__":
    main()
