"""Small sequences in the exact formats of GRAB, ARCTIC, H2O, DexYCB and OakInk, of a motion that the tests know.

The motion: 80 frames; the hand comes nearer; its grip opens until frame 20 and closes afterwards; the object lies still
until frame 26 and the hand carries it away then. `truth()` holds it in the world, fingers as full turns about the flat hand.
"""

import pickle
from pathlib import Path

import numpy as np
import trimesh
from mano_files import mano_dictionary
from scipy.spatial.transform import Rotation
from smplx_files import smplx_dictionary

FRAMES, WIDEST, LIFTED = 80, 20, 26
UP = np.array([0.0, 0.0, 1.0])


def truth(side=0, seed=0, idle=False):
    """Wrist turns and places, fingers (F, 45), shape (10,), object poses (F, 4, 4), body turns (F, 3)."""
    rng = np.random.default_rng(seed + side)
    t = np.arange(FRAMES)[:, None]
    turn = rng.normal(0, 0.5, 3) + 0.01 * np.minimum(t, LIFTED) * rng.normal(size=3)
    place = np.array([0.4, 0.1, 1.0]) - 0.005 * np.minimum(t, LIFTED) * np.array([1.0, 0.2, 0.3])
    closed = np.abs(t - WIDEST) / FRAMES  # 0: open
    fingers = np.zeros((FRAMES, 15, 3))
    sign = -1.0 if side else 1.0
    fingers[:, :12, 2] = sign * (0.1 + 1.6 * closed)  # MANO's fingers flex about z
    fingers = fingers.reshape(FRAMES, 45) + rng.normal(0, 0.01, 45)
    object_pose = np.tile(np.eye(4), (FRAMES, 1, 1))
    object_pose[:, :3, :3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    object_pose[:, :3, 3] = [0.2, 0.1, 0.8]
    object_pose[LIFTED:, 2, 3] += 0.01 * np.arange(1, FRAMES - LIFTED + 1)
    place[LIFTED:, 2] += 0.0 if idle else 0.01 * np.arange(1, FRAMES - LIFTED + 1)
    body = np.tile(Rotation.from_euler("xz", [np.pi / 2, 0.4]).as_rotvec(), (FRAMES, 1))  # upright: y of the root is up
    return {"turn": turn, "place": place, "fingers": fingers, "shape": rng.normal(0, 0.5, 10),
            "object": object_pose, "body": body}  # fmt: skip


def body_truth():
    """SMPL-X' numbers of the body in the same frames, as GRAB and ARCTIC call them."""
    rng = np.random.default_rng(9)
    pose = rng.normal(0, 0.3, 63) + 0.002 * np.arange(FRAMES)[:, None]
    return {"global_orient": truth()["body"], "transl": rng.normal(0, 0.5, (FRAMES, 3)), "body_pose": pose}


def body_mesh(folder: Path, name):
    """The subject's own body, 4 % larger than the model."""
    vertices = 1.04 * smplx_dictionary()["v_template"]
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    faces = np.arange(len(vertices) // 4 * 4).reshape(-1, 4)[:, :3]
    trimesh.Trimesh(vertices, np.vstack([faces, faces + 1]), process=False).export(folder / name)
    return vertices


def write_grab(folder: Path, name="s1/mug_pass_1", idle=(), subjects=False):
    """One sequence as GRAB stores it: dictionaries in an .npz, the object's turn transposed. Sides in `idle` take no part;
    `subjects`: with the subject's hands and body as meshes."""
    body_mesh(folder, "tools/subject_meshes/male/s1.ply") if subjects else None
    hands = [truth(s, idle=s in idle) for s in (0, 1)]
    for side, part in enumerate(("rhand", "lhand")) if subjects else ():
        mano, mesh = mano_dictionary(side), folder / "tools" / "subject_meshes" / "male" / f"s1_{part}.ply"
        mesh.parent.mkdir(parents=True, exist_ok=True)
        own = mano["v_template"] + mano["shapedirs"][:, :, :10] @ hands[side]["shape"]
        trimesh.Trimesh(own, mano["f"], process=False).export(mesh)
    T = hands[0]["object"]
    path = folder / "grab" / f"{name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)

    def hand(h, side):
        return {"params": {"global_orient": h["turn"].astype(np.float32), "transl": h["place"].astype(np.float32),
                           "hand_pose": np.zeros((FRAMES, 24), np.float32),
                           "fullpose": h["fingers"].astype(np.float32)},
                "vtemp": f"tools/subject_meshes/male/s1_{side}.ply"}  # fmt: skip

    contact = {"body": np.zeros((FRAMES, 10475), np.int8), "object": np.zeros((FRAMES, 50_000), np.int8)}
    np.savez_compressed(
        path, gender="male", sbj_id="s1", obj_name="mug", motion_intent="pass", framerate=120.0, n_frames=FRAMES,
        n_comps=24, body={"params": body_truth(), "vtemp": "tools/subject_meshes/male/s1.ply"},
        rhand=hand(hands[0], "rhand"), lhand=hand(hands[1], "lhand"),
        object={"params": {"global_orient": Rotation.from_matrix(T[:, :3, :3].transpose(0, 2, 1)).as_rotvec(),
                           "transl": T[:, :3, 3]}, "object_mesh": "tools/object_meshes/mug.ply"},
        table={"params": {}, "table_mesh": "x.ply"}, contact=contact,
    )  # fmt: skip
    return path


def write_arctic(folder: Path, mean, name="s01/box_use_01", body=True):
    """One sequence as ARCTIC stores it: postures about the mean hand, millimetres. `mean` (2, 45)."""
    path = folder / "raw_seqs" / f"{name}.mano.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    value = {}
    for key, side in (("right", 0), ("left", 1)):
        h = truth(side)
        value[key] = {"rot": h["turn"], "pose": h["fingers"] - mean[side], "trans": h["place"], "shape": h["shape"],
                      "fitting_err": [0.1] * FRAMES}  # fmt: skip
    np.save(path, value)
    T = truth()["object"]
    rows = np.column_stack([np.zeros(FRAMES), Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), 1000 * T[:, :3, 3]])
    stem = path.name.removesuffix(".mano.npy")
    np.save(path.with_name(f"{stem}.object.npy"), rows)
    if body:
        np.save(path.with_name(f"{stem}.smplx.npy"), body_truth())
        body_mesh(folder, "meta/subject_vtemplates/s01.obj")
        (folder / "meta" / "misc.json").write_text('{"s01": {"gender": "male", "image_size": []}}')
    return path


def write_h2o(folder: Path, camera, name="subject1/h1/0", right_from=0, kinds=("hand_pose_mano", "obj_pose_rt")):
    """One sequence as H2O stores it: text files in the camera's frame. `camera` (F, 4, 4) camera to world. Folders are called
    as its loader calls them; its page says hand_pose_MANO and obj_pose_RT."""
    base = folder / name / "cam4"
    hands = [truth(s) for s in (0, 1)]
    for f in range(FRAMES):
        inverse = np.linalg.inv(camera[f])
        blocks = []
        for h, seen in ((hands[1], 1), (hands[0], int(f >= right_from))):
            R = inverse[:3, :3] @ Rotation.from_rotvec(h["turn"][f]).as_matrix()
            place = inverse[:3, :3] @ h["place"][f] + inverse[:3, 3]
            blocks += [[seen], place, Rotation.from_matrix(R).as_rotvec(), h["fingers"][f], h["shape"]]
        rows = {kinds[0]: np.concatenate(blocks), "cam_pose": camera[f].ravel(),
                kinds[1]: np.concatenate([[3], (inverse @ hands[0]["object"][f]).ravel()])}  # fmt: skip
        for kind, row in rows.items():
            (base / kind).mkdir(parents=True, exist_ok=True)
            (base / kind / f"{f:06d}.txt").write_text(" ".join(f"{x:.9f}" for x in row) + "\n")
        (base / "action_label").mkdir(exist_ok=True)
        (base / "action_label" / f"{f:06d}.txt").write_text("0" if f < LIFTED else "26")
    return base / kinds[0]


def write_dexycb(folder: Path, components, mean, side=0, name="20200709-subject-01/20200709_141754"):
    """One sequence as DexYCB stores it: 45 components about the mean hand, no hand in the first three frames."""
    h, base = truth(side), folder / name
    base.mkdir(parents=True, exist_ok=True)
    coefficients = (h["fingers"] - mean) @ np.linalg.inv(components)
    pose_m = np.concatenate([h["turn"], coefficients, h["place"]], 1)[:, None].astype(np.float32)
    pose_m[:3] = 0.0
    grasped = np.concatenate([Rotation.from_matrix(h["object"][:, :3, :3]).as_quat(), h["object"][:, :3, 3]], 1)
    other = np.tile([0.0, 0, 0, 1, 0, 0, 0.5], (FRAMES, 1))
    np.savez(base / "pose.npz", pose_m=pose_m, pose_y=np.stack([other, grasped], 1).astype(np.float32))
    (base / "meta.yml").write_text(
        f"serials:\n- '836212060125'\nnum_frames: {FRAMES}\nycb_ids:\n- 2\n- 5\nycb_grasp_ind: 1\n"
        f"mano_sides:\n- {('right', 'left')[side]}\nmano_calib:\n- 20200709-subject-01_right\nextrinsics: '20200702_151821'\n"
    )
    calibration = folder / "calibration" / "mano_20200709-subject-01_right" / "mano.yml"
    calibration.parent.mkdir(parents=True, exist_ok=True)
    calibration.write_text("betas:\n" + "".join(f"- {x}\n" for x in h["shape"]))
    return base / "pose.npz"


def write_oakink(folder: Path, tag, source, seed=0, virtual=None, frame=WIDEST, quaternions=True):
    """One grasp as OakInk-Shape stores it: quaternions (wxyz) or axis-angle (48), the wrist joint, in the object's frame."""
    h = truth(0, seed)
    turns = np.concatenate([h["turn"][frame][None], h["fingers"][frame].reshape(15, 3)])
    base = folder / "shape" / "oakink_shape_v2" / "mug" / "A01001" / tag
    path = (base / virtual if virtual else base) / "hand_param.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    value = {
        "pose": Rotation.from_rotvec(turns).as_quat(scalar_first=True) if quaternions else turns.ravel(),
        "shape": h["shape"],
        "tsl": h["place"][frame],
    }
    path.write_bytes(pickle.dumps({k: v.astype(np.float32) for k, v in value.items()}))
    (base / "source.txt").write_text(source)
    return path
