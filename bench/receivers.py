"""The people of protocol r2h-v1, looked at: `python bench/receivers.py` writes docs/receivers.png (12 of them from the side) and
docs/receivers_angles.png (how hands point and where they are). MUJOCO_GL=osmesa without a display."""

import argparse
from pathlib import Path

import numpy as np
import torch
from _report import Report
from PIL import Image
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.config import HOME_Q
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import random
from r2h_batch.scene.hand import load_hand_set, palm_frame
from r2h_batch.types import Trials
from r2h_batch.view.drawing import Drawing, View
from r2h_batch.view.pictures import painter
from r2h_batch.view.stored import judged_again

DOCS = Path(__file__).parents[1] / "docs"


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


def people(trials: Trials, rows: list[int], path: Path) -> None:
    """Trials from the side of the receiver's arm, four in a line, with the robot at home and a random object in it."""
    evaluator = Evaluator(load_benchmark("r2h-v1")).kinematic
    images = []
    for row in rows:
        trial = trials[row : row + 1]
        drawing = Drawing(judged_again(evaluator, trial, random.predict(trial, evaluator.scene, seed=0), "random"))
        left = int(evaluator.scene.hands.set.side[trial.hand_index.long()]) == 1
        with painter(drawing, (480, 420), View(np.array([0.4, 0, 0.15]), 112 if left else -112, -12, 2.4)) as paint:
            images.append(paint(np.array(HOME_Q)))
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


def run(given: argparse.Namespace, _: Report) -> None:
    """Draws the pictures."""
    found = {}
    for protocol in ("r2h-v0", "r2h-v1"):
        trials = load_benchmark(protocol).trials(given.trials)
        found[protocol] = angles(trials)
    people(trials, list(range(12)), given.out / "receivers.png")
    histograms(found, given.out / "receivers_angles.png")


BENCH = Bench(
    __doc__,
    run,
    flags={
        "--trials": {"default": 2000, "help": "of each split"},
        "--out": {"type": Path, "default": DOCS},
    },
    peer="r2h-v0",
)

if __name__ == "__main__":
    BENCH.main()
