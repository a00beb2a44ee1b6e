"""Importers of hands beside an own forward pass in float64 over the released numbers: `python tests/support/hand_errors.py`
prints the table of docs/your_data.md."""

import sys
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import torch
import trimesh
from hand_data import (
    FRAMES,
    WIDEST,
    body_truth,
    truth,
    write_arctic,
    write_dexycb,
    write_grab,
    write_h2o,
    write_oakink,
)  # fmt: skip
from mano_files import mano_dictionary, mano_twin, write_mano
from scipy.spatial.transform import Rotation
from smplx_files import SIDES, smplx_twin, write_smplx

from r2h_batch.__main__ import main
from r2h_batch.importers.mano import load_mano

CASES = ("grab", "arctic", "h2o", "h2o as its page has it", "dexycb", "oakink", "oakink in axis-angle")
OAKINK = "pass1/A01001_0004_0001_0002/2021-09-26-19-59-58_alt"


def moving_camera():
    rng = np.random.default_rng(3)
    camera = np.tile(np.eye(4), (FRAMES, 1, 1))
    camera[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (FRAMES, 3))).as_matrix()
    camera[:, :3, 3] = rng.normal(0, 1, (FRAMES, 3))
    return camera


def write_case(folder: Path, case, means, components, camera):
    """The data set as its owners release it."""
    name, _, variant = case.partition(" ")
    if name == "h2o":
        kinds = ("hand_pose_MANO", "obj_pose_RT") if variant else ("hand_pose_mano", "obj_pose_rt")
        write_h2o(folder, camera, kinds=kinds)
    elif name == "dexycb":
        write_dexycb(folder, components[0], means[0])
    elif name == "oakink":
        write_oakink(folder, "abcdef0123", OAKINK, quaternions=not variant)
    elif name == "grab":
        write_grab(folder, subjects=True)
    else:
        write_arctic(folder, means)
    return name


def largest_errors(folder: Path, case, mano):
    """Largest distance (m) of an imported vertex, and of a shoulder, elbow or wrist (0 without bodies), from the data set's
    own recipe. `mano`: the pickles of right and left hands."""
    model = load_mano(*mano).model
    camera = np.tile(moving_camera()[0], (FRAMES, 1, 1))
    means, components = model.pose_mean.double().numpy(), model.pose_components.double().numpy()
    name, body_model = write_case(folder, case, means, components, camera), write_smplx(folder / "smplx")
    line = ["--from", name, "--mano-right", mano[0], "--mano-left", mano[1], "--smplx", folder / "smplx", "--strict"]
    with redirect_stdout(StringIO()):
        assert main(["import", "hands", str(folder), *map(str, line), "--out", str(folder / "hands.npz")]) == 0
    with np.load(folder / "hands.npz", allow_pickle=False) as found:
        hands = dict(found)
    got = model.pose(*(torch.from_numpy(hands[k]) for k in ("pose", "shape", "side"))).vertices.double().numpy()
    T = hands["T_world_hand"].astype(np.float64)
    got = np.einsum("nij,nvj->nvi", T[:, :3, :3], got) + T[:, None, :3, 3]
    off, arm_off = [], [0.0]
    for row, side in enumerate(hands["side"]):
        h, arrays = truth(side), mano_dictionary(side)
        place, turn, beta = h["place"][WIDEST], h["turn"][WIDEST], h["shape"]
        R, t = (camera[WIDEST] if name == "h2o" else np.eye(4))[:3, :3], camera[WIDEST, :3, 3] * (name == "h2o")
        if name == "grab":  # its recipe puts the subject's mesh for v_template
            mesh = folder / f"tools/subject_meshes/male/s1_{('rhand', 'lhand')[side]}.ply"
            arrays, beta = {**arrays, "v_template": trimesh.load(mesh, process=False).vertices}, np.zeros(10)
        turn = Rotation.from_matrix(R.T @ Rotation.from_rotvec(turn).as_matrix()).as_rotvec()
        vertices, joints = mano_twin(arrays, np.concatenate([turn, h["fingers"][WIDEST]]), beta)
        vertices = vertices + R.T @ (place - t) - (joints[0] if name == "oakink" else 0)
        off.append(np.linalg.norm(got[row] - (vertices @ R.T + t), axis=1).max())
        if name in ("grab", "arctic"):
            body = body_truth()
            turns = np.concatenate([body["global_orient"][WIDEST], body["body_pose"][WIDEST]]).reshape(22, 3)
            joints = smplx_twin(body_model, 1.04 * body_model["v_template"], turns, body["transl"][WIDEST])
            arm = joints[list(SIDES[("right", "left")[side]])]
            arm_off.append(np.linalg.norm(hands["arm"][row] - arm, axis=1).max())
    return max(off), max(arm_off)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        files = [write_mano(root / f"MANO_{n}.pkl", mano_dictionary(s)) for s, n in enumerate(("RIGHT", "LEFT"))]
        print("| source | vertices, mm | arm, mm |\n|---|--:|--:|")
        for case in CASES:
            (root / case).mkdir()
            skin, arm = largest_errors(root / case, case, files)
            sys.stdout.write(f"| {case} | {1e3 * skin:.5f} | {f'{1e3 * arm:.5f}' if arm else ''} |\n")
