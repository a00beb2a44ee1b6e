"""A picture of what each baseline holds: gripper, object (receiver's region orange), the receiving hand it was shown.

    MUJOCO_GL=osmesa python bench/grasps.py docs/baselines_grasps.png

Without the error model; the number after the object is the verdict.
"""

import argparse
from importlib import import_module
from pathlib import Path

METHODS = ("fc", "handover_va", "contact", "intent")
GREY, BLUE, ORANGE, SKIN = (0.3, 0.3, 0.3, 1), (0.25, 0.45, 0.8, 1), (0.95, 0.55, 0.1, 1), (0.9, 0.72, 0.6, 1)


def picture(model, T_obj_ee, opening, hand, hand_faces, size):
    """Rendered from one side, in the object's frame."""
    import mujoco
    import torch
    from scipy.spatial.transform import Rotation

    from r2h_batch.bodies.robot import load_robot
    from r2h_batch.judge.grasp import gripper_poses

    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth = spec.visual.global_.offheight = size
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=8, height=8,
    )  # fmt: skip
    region = model.receiver_face
    surfaces = [
        ("region", model.vertices, model.faces[region], ORANGE),
        ("rest", model.vertices, model.faces[~region], BLUE),
        ("hand", hand, hand_faces, SKIN),
    ]
    for name, vertices, faces, rgba in surfaces:
        if len(faces):
            mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert, mesh.userface = vertices.astype(float).ravel().tolist(), faces.astype(int).ravel().tolist()
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=rgba)
    prims, (R, p) = load_robot().gripper, (x[0].double().numpy() for x in gripper_poses(torch.tensor([opening])))
    shapes = ("SPHERE", "CAPSULE", "CYLINDER", "BOX")
    for g, kind in enumerate(prims.kind):
        q = Rotation.from_matrix(T_obj_ee[:3, :3] @ R[g]).as_quat(scalar_first=True)
        at = T_obj_ee[:3, :3] @ p[g] + T_obj_ee[:3, 3]
        shape = getattr(mujoco.mjtGeom, f"mjGEOM_{shapes[int(kind)]}")
        spec.worldbody.add_geom(type=shape, size=prims.size[g], pos=at, quat=q, rgba=GREY)
    spec.worldbody.add_light(pos=[0.3, -0.3, 1], dir=[-0.3, 0.3, -1])
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = 0, 0.72, 120, -30
    with mujoco.Renderer(compiled, size, size) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render().copy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("png", type=Path)
    parser.add_argument("--trials", type=int, nargs="+", default=[1, 3, 5, 9, 13, 17, 19, 4, 8])
    parser.add_argument("--size", type=int, default=260, help="pixels of a picture")
    given = parser.parse_args()

    import matplotlib
    import torch

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from r2h_batch.evaluate import Evaluator
    from r2h_batch.judge.grasp import close_gripper
    from r2h_batch.predictors import PredictorNoise, predict_receiving, retrieve_receiving
    from r2h_batch.trials.protocol import trials_with_ids
    from r2h_batch.verdicts import Outcome

    evaluator = Evaluator().kinematic
    scene, trials = evaluator.scene, trials_with_ids(torch.tensor(given.trials))
    exact = PredictorNoise().scaled(0)
    figure, axes = plt.subplots(
        len(METHODS), len(trials), figsize=(1.7 * len(trials), 1.95 * len(METHODS)), layout="constrained", squeeze=False
    )
    for i, name in enumerate(METHODS):
        method = import_module(f"r2h_batch.methods.{name}")
        hand = (retrieve_receiving if name == "intent" else predict_receiving)(trials, scene, noise=exact)
        answer = method.predict(trials, scene, evaluator=evaluator, noise=exact)
        outcome = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials).outcome.tolist()
        opening = close_gripper(scene.grasp_tables, answer.T_obj_ee, trials.object_index).opening_m
        for j in range(len(trials)):
            model = scene.objects[int(trials.object_index[j])]
            faces = scene.hands.model.faces_by_side[int(hand.side[j])].numpy()
            image = picture(
                model,
                answer.T_obj_ee[j].double().numpy(),
                float(opening[j]),
                hand.vertices[j].numpy(),
                faces,
                given.size,
            )
            axes[i, j].imshow(image)
            axes[i, j].set_axis_off()
            said = f"{model.name.replace('_', ' ')}: {Outcome(outcome[j]).name.lower()}"
            axes[i, j].set_title(
                f"{method.TITLE} ({method.STAND_IN})\n{said}" if j == 0 else said, fontsize=7, loc="left"
            )
    figure.savefig(given.png, dpi=110)
    print(given.png)


if __name__ == "__main__":
    main()
