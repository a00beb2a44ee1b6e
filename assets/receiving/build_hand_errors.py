"""Makes hand_errors.npz and hand_errors_report.json: how far published estimators were off, frame by frame.

``python -m r2h_batch.assets.receiving.build_hand_errors FOLDER``, FOLDER holding ``nyu_test_groundtruth_label.txt`` and the
files of ``ESTIMATORS`` from the repository xinghaochen/awesome-hand-pose-estimation (evaluation/), which collects the labels
that authors predicted for the test frames of the NYU hand pose dataset (Tompson et al. 2014): bare hands before a depth
camera, 8,252 frames of two people. None of those labels is kept, only how they differ from the true ones: for a sample of
frames the rigid motion that takes the true hand to the predicted one, in a hand's own directions.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.read import read_file
from r2h_batch.scene.arrays import arrays_digest

HERE = Path(__file__).resolve().parent
ESTIMATORS = {  # published 2017 to 2022, each once; older ones are what nobody would use any more
    "CVPR17_NYU_3DCNN.txt": "3DCNN (Ge et al. 2017)",
    "ICIP17_NYU_Guo_Basic.txt": "basic network (Guo et al. 2017)",
    "ICIP17_NYU_REN_4x6x6.txt": "REN 4x6x6 (Guo et al. 2017)",
    "ICCVW17_NYU_DeepPrior++.txt": "DeepPrior++ (Oberweger and Lepetit 2017)",
    "JVCI18_NYU_REN_9x6x6.txt": "REN 9x6x6 (Wang et al. 2018)",
    "NEUCOM18_NYU_Pose_REN.txt": "Pose-REN (Chen et al. 2018)",
    "CVPR18_NYU_denseReg.txt": "DenseReg (Wan et al. 2018)",
    "CVPR18_NYU_V2V_PoseNet.txt": "V2V-PoseNet (Moon et al. 2018)",
    "CVPR18_NYU_DeepPrior++_FM.txt": "Feature Mapping (Rad et al. 2018)",
    "Access18_NYU_SHPR_Net_frontal.txt": "SHPR-Net (Chen et al. 2018)",
    "CVPR18_NYU_HandPointNet.txt": "HandPointNet (Ge et al. 2018)",
    "ECCV18_NYU_Point-to-Point.txt": "Point-to-Point (Ge et al. 2018)",
    "WACV19_NYU_murauer_n72757_uvd.txt": "MURAUER (Poier et al. 2019)",
    "TPAMI19_NYU_Generalized_Feedback.txt": "Generalized Feedback (Oberweger et al. 2019)",
    "CVPR19_NYU_CrossInfoNet.txt": "CrossInfoNet (Du et al. 2019)",
    "Sensors19_NYU_WHSP-Net.txt": "WHSP-Net (Malik et al. 2019)",
    "TMM21_NYU_SRNet.txt": "SRNet (Zhang and Zhang 2021)",
    "ArXiv_NYU_TriHorn_Net.txt": "TriHorn-Net (Rezaei et al. 2022)",
}
FOCAL_X, FOCAL_Y, MIDDLE_X, MIDDLE_Y = 588.03, -587.07, 320.0, 240.0
"""Intrinsics of NYU's camera, pixels; labels are (u, v, depth in mm)."""
JOINTS, WRIST_A, WRIST_B, PALM = 14, 11, 12, 13
"""Number of compared joints, and rows of some of them: two on the wrist, B on the thumb's side, and the palm's
middle."""
KEPT = 4096
PERCENTILES = (50, 90, 99, 99.9)
MAX_BYTES = 1 << 24

Array = NDArray[np.float64]


def positions(path: Path) -> Array:
    """(F, 14, 3) joints in metres. The camera's axes are right, up and away: a mirrored frame, in which all of this is done."""
    rows = [list(map(float, line.split())) for line in read_file(path, MAX_BYTES).decode("ascii").splitlines()]
    x = np.array(rows).reshape(len(rows), JOINTS, 3)
    x[..., 0] = (x[..., 0] - MIDDLE_X) * x[..., 2] / FOCAL_X
    x[..., 1] = (x[..., 1] - MIDDLE_Y) * x[..., 2] / FOCAL_Y
    return 1e-3 * x


def hand_directions(x: Array) -> Array:
    """(F, 3, 3) columns: from wrist to palm, out of the palm, to the thumb's side: improper where the frame is mirrored."""
    along = x[:, PALM] - 0.5 * (x[:, WRIST_A] + x[:, WRIST_B])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    thumb = x[:, WRIST_B] - x[:, WRIST_A]
    thumb -= (thumb * along).sum(1, keepdims=True) * along
    thumb /= np.linalg.norm(thumb, axis=1, keepdims=True)
    return np.stack([along, np.cross(along, thumb), thumb], 2)


def rigid(true: Array, found: Array) -> tuple[Array, Array]:
    """Rotations (F, 3, 3) about the palm and its shifts (F, 3) that take the true joints nearest to the found ones (Kabsch)."""
    a, b = true - true.mean(1, keepdims=True), found - found.mean(1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.einsum("fki,fkj->fij", a, b))
    proper = np.tile(np.eye(3), (len(a), 1, 1))
    proper[:, 2, 2] = np.sign(np.linalg.det(U @ Vt))
    R = Vt.transpose(0, 2, 1) @ proper @ U.transpose(0, 2, 1)
    palm = np.einsum("fij,fj->fi", R, true[:, PALM] - true.mean(1)) + found.mean(1)
    return R, palm - true[:, PALM]


def rotation_vectors(R: Array) -> Array:
    """(F, 3) axes times angles, rad, angles up to pi."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def main() -> None:
    """Writes both files and prints the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    true = positions(folder / "nyu_test_groundtruth_label.txt")
    B = hand_directions(true)
    turns, shifts, each = [], [], {}
    for name, title in ESTIMATORS.items():
        R, shift = rigid(true, positions(folder / name))
        turns.append(rotation_vectors(B.transpose(0, 2, 1) @ R @ B))
        shifts.append(np.einsum("fji,fj->fi", B, shift))
        each[title] = figures(turns[-1], shifts[-1])
    turn, shift = np.concatenate(turns), np.concatenate(shifts)
    # every n-th by angle: the sample has the angles' distribution, tails and all
    order = np.argsort(np.linalg.norm(turn, axis=1), kind="stable")
    rows = order[((np.arange(KEPT) + 0.5) / KEPT * len(order)).astype(np.int64)]
    arrays = {"turn_rad": turn[rows].astype(np.float32), "shift_m": shift[rows].astype(np.float32)}
    np.savez_compressed(HERE / "hand_errors.npz", allow_pickle=False, **arrays)
    report = {
        "digest": arrays_digest(arrays),
        "frames": len(true),
        "percentiles": PERCENTILES,
        "all": figures(turn, shift),
        "kept": figures(arrays["turn_rad"], arrays["shift_m"]),
        "estimators": each,
    }
    (HERE / "hand_errors_report.json").write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))


def figures(turn: NDArray[np.float32] | Array, shift: NDArray[np.float32] | Array) -> dict[str, object]:
    """Percentiles of angle and shift, and how often a hand is turned by more than a right angle."""
    degrees, far = np.degrees(np.linalg.norm(turn, axis=1)), 1e3 * np.linalg.norm(shift, axis=1)
    return {
        "turn_deg": [round(float(p), 1) for p in np.percentile(degrees, PERCENTILES)],
        "shift_mm": [round(float(p), 1) for p in np.percentile(far, PERCENTILES)],
        "beyond_90_deg_percent": round(100 * float((degrees > 90).mean()), 2),
    }


if __name__ == "__main__":
    main()
