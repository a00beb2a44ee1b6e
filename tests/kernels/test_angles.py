"""Angles in float32 without a library: close to the truth everywhere, and no contraction or approximation on CUDA."""

import re
from importlib import import_module
from pathlib import Path

import gpu_build
import numpy as np
import pytest
import warp as wp

from r2h_batch.base.launch import init_warp, launch_trials
from r2h_batch.kernels.geometry.angles import angle_of, arc_cosine, sin_cos
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def angles(
    first: int, x_in: wp.array(dtype=float), y_in: wp.array(dtype=float), sine_out: wp.array(dtype=float),
    cosine_out: wp.array(dtype=float), angle_out: wp.array(dtype=float), arc_out: wp.array(dtype=float),
):  # fmt: skip
    i = first + wp.tid()
    s, c = sin_cos(x_in[i])
    sine_out[i] = s
    cosine_out[i] = c
    angle_out[i] = angle_of(y_in[i], x_in[i])
    arc_out[i] = arc_cosine(wp.clamp(y_in[i] / 100.0, -1.0, 1.0))


def evaluated(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    init_warp()
    out = {k: np.zeros_like(x) for k in ("sine", "cosine", "angle", "arc")}
    launch_trials(angles, len(x), inputs={"x": x, "y": y}, outputs=out, device="cpu", chunk=1 << 16)
    return tuple(out.values())


def test_angles_are_within_a_few_units_in_the_last_place() -> None:
    rng = np.random.default_rng(0)
    special = np.array([0, -0.0, *(k * np.pi / 8 for k in range(-130, 131)), 1e-30, -1e-30, 100, -100], np.float32)
    x = np.concatenate([special, rng.uniform(-7, 7, 100_000), rng.uniform(-100, 100, 100_000)]).astype(np.float32)
    y = np.concatenate([special[::-1], rng.uniform(-100, 100, 200_000)]).astype(np.float32)
    sine, cosine, angle, arc = evaluated(x, y)
    x64, y64 = x.astype(np.float64), y.astype(np.float64)
    assert np.abs(sine - np.sin(x64)).max() < 1.3e-7 and np.abs(cosine - np.cos(x64)).max() < 1.3e-7
    assert np.abs(sine.astype(np.float64) ** 2 + cosine.astype(np.float64) ** 2 - 1).max() < 2.5e-7
    turned = np.angle(np.exp(1j * (angle - np.arctan2(y64, x64))))  # -pi and pi are one angle
    assert np.abs(turned).max() < 4e-7
    c = np.clip(y / np.float32(100), -1, 1).astype(np.float64)
    assert np.abs(arc - np.arccos(c)).max() < 4e-7


DECIDE = [n for n in gpu_build.kernel_modules() if n.split(".")[0] not in ("methods", "receiver")]
INEXACT = re.compile(r"\b(?:mul|add|sub)\.f32|\.approx\.(?:ftz\.)?f32|\.ftz\.|\bdiv\.full\.f32")
"""In PTX: float32 arithmetic that may be contracted (what may not says how it is rounded, `mul.rn.f32`), is approximate or
flushed. Warp's matrix products say fmaf themselves, `fma.rn.f32`: one rounding on a CPU as well."""
LIBRARY = re.compile(r"wp\.(?:sin|cos|tan|asin|acos|atan2?|sinh|cosh|tanh|exp|log\w*|pow)\(")
IN_FLOAT64 = {"ik", "robot/fk.py"}
"""Joint angles are solved in float64: a last bit there is rarely one of the float32 that is handed on."""


def inexact(name: str, folder: Path) -> set[str]:
    init_warp()
    module = import_module(gpu_build.PACKAGE + name)
    wp.compile_aot_module(module, arch=90, module_dir=str(folder), use_ptx=True)
    (code,) = folder.glob("*.ptx")
    return set(INEXACT.findall(code.read_text(errors="replace")))


def test_what_decides_verdicts_rounds_every_product_and_asks_no_library(tmp_path: Path) -> None:
    assert inexact("robot.gripper", tmp_path) == set()
    (tmp_path / "other").mkdir()
    assert inexact("methods.approach_hit", tmp_path / "other") != set()  # contraction is on there, and is seen


def test_what_decides_verdicts_takes_no_angle_from_a_library() -> None:
    root, found = Path(__file__).resolve().parents[2] / "kernels", {}
    for path in root.rglob("*.py"):
        name = path.relative_to(root).as_posix()
        found[name] = len(LIBRARY.findall(path.read_text()))
    elsewhere = {n for n, k in found.items() if k and not n.startswith(("methods/", "receiver/"))}
    assert {n if n.startswith("robot") else n.split("/")[0] for n in elsewhere} == IN_FLOAT64


@pytest.mark.slow
@pytest.mark.parametrize("name", DECIDE)
def test_no_module_that_decides_verdicts_contracts(name: str, tmp_path: Path) -> None:
    assert inexact(name, tmp_path) == set()
