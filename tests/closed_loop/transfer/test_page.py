"""docs/transfer.md suffices for a rebuild: its tables have the numbers of the code, and no number of the code is missing."""

import ast
import re
from importlib import import_module
from inspect import getsource
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from screwdriver import OBJECTS, ROBOT, screwdrivers

from r2h_batch.closed_loop.transfer.cases import Case, Simulator
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.closed_loop.transfer.person import SCENARIOS
from r2h_batch.scene.robot import load_robot

PAGE = Path(__file__).resolve().parents[3] / "docs" / "transfer.md"
HERE = "r2h_batch.closed_loop.transfer"
MODULES = {
    name: f"{place}.{name}"
    for place, names in {
        HERE: ("model", "worlds_mujoco", "person", "simulate", "outcome", "release", "held", "friction"),
        "r2h_batch.judge": ("grasp_physics", "closed_pose"),
        "r2h_batch.trials.holding": ("capacity", "held_out"),
    }.items()
    for name in names
}
UNITS = {
    "mm": 1e-3, "cm": 1e-2, "ms": 1e-3, "cm/s": 1e-2, "mm/s": 1e-3, "kN/m": 1e3, "%": 1e-2,
    **dict.fromkeys(
        ("kg", "kg m2", "s", "N", "N m", "N/m", "N s/m", "N m/rad", "m/s", "/s", "/N2", "Hz", "rad", "degrees", ""), 1.0
    ),
}  # fmt: skip
NO_MODEL = {
    "model": {"MEMORY"},  # of the engine
    "simulate": {"POLL_TICKS"},  # of a GPU
    "outcome": {"SHARES"},  # columns
    "friction": {"CLOSING_AXIS", "ARM_M"},  # scales of a program
    "person": {"KEY"},
    "grasp_physics": {"STEP_S", "SETTLE_S", "SHAKE_M_S2", "SHAKE_HZ", "SHAKE_S", "G"}  # another check's
    | {"FORCE_N", "JAW_ARMATURE_KG", "JAW_GAINS"},  # of other grippers
    "held_out": {"PER_SIDE", "TURNS", "SAME_M", "SAME_SHARE"},  # which grasps there are
}
"""Numbers that no outcome depends on, or that another table has."""


def rows() -> list[tuple[str, str, list[str], float]]:
    """Words, value and names of each row whose last cell names code, and what it divides the code's number by."""
    section = PAGE.read_text("utf-8").split("## Numbers of the model")[1].split("\n## ")[0]
    cells = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| ")]
    found = [
        (c[0].strip(), c[1].strip(), re.findall(r"`([\w.]+)`", c[2]), float((re.findall(r"` / (\d+)", c[2]) or [1])[0]))
        for c in cells
    ]
    return [row for row in found if row[2]]


def numbers(text: str) -> list[float]:
    """The numbers of a cell, SI. `4, 6 Hz; 4 mm`: a number without a unit has the next one's before a semicolon."""
    found = []
    for group in text.split(";"):
        unit, own = "", []
        for part in reversed(group.split(",")):
            if number := re.fullmatch(r"(-?[\d.]+(?:e-?\d+)?)\s*(.*)", part.strip()):
                unit = number[2] or unit
                own.append(float(number[1]) * UNITS[unit])
        found += own[::-1]
    return found


def of_code(name: str) -> list[float]:
    """The numbers that a name of the tables stands for."""
    module, _, rest = name.partition(".")
    robots = {"robot": load_robot(), "linkage": load_robot().linkage}
    owner = robots[module] if module in robots else import_module(MODULES[module])
    return np.atleast_1d(np.asarray(attrgetter(rest)(owner), float)).tolist()


def constants(module: str) -> set[str]:
    """Numeric constants of a file and of its classes."""
    made = import_module(MODULES[module])
    found = set()

    def look(body, before=""):
        for node in body:
            if isinstance(node, ast.ClassDef):
                look(node.body, f"{before}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else []
            for name in (n for t in targets for n in (t.elts if isinstance(t, ast.Tuple) else [t])):
                if not isinstance(name, ast.Name) or not name.id.isupper() or name.id.startswith("_"):
                    continue
                value = attrgetter(before + name.id)(made)
                numeric = isinstance(value, int | float) or (
                    isinstance(value, tuple) and all(isinstance(v, int | float) for v in value)
                )
                if numeric and not hasattr(value, "name"):
                    found.add(before + name.id)

    look(ast.parse(getsource(made)).body)
    return found


@pytest.mark.check
@pytest.mark.parametrize(("what", "value", "names", "by"), rows(), ids=lambda x: x[0] if isinstance(x, list) else "")
def test_a_number_of_the_page_is_the_one_of_the_code(what, value, names, by):
    said, code = numbers(value), [x / by for name in names for x in of_code(name)]
    assert said == pytest.approx(code, rel=2e-4), what


def test_the_page_has_every_number_of_the_model():
    named = {name for _, _, names, _ in rows() for name in names}
    missing = {
        f"{module}.{name}"
        for module in MODULES
        for name in constants(module) - NO_MODEL.get(module, set())
        if f"{module}.{name}" not in named and "Does." not in name
    }
    assert missing == set()


def test_the_ranges_of_persons_are_those_of_the_code():
    text = PAGE.read_text("utf-8")
    take, weak = SCENARIOS["take"], SCENARIOS["weak"]
    assert f"| grip, times the usual one | {take.grip[0]:g} to {take.grip[1]:g} |" in text
    assert f"| {take.arm_n_m[0]:g} to {take.arm_n_m[1]:g} N/m |" in text
    assert f"| largest pull | {take.pull_n[0]:g} to {take.pull_n[1]:g} N |" in text
    assert f"| {take.pause_s[0]:g} to {take.pause_s[1]:g} s |" in text
    assert weak.grip == (0.2, 0.5) and "a fifth to half of the grip" in text
    assert f"at most {weak.most_grip_n:g} N in sum" in text
    assert f"pulls of {weak.pull_n[0]:g} to {weak.pull_n[1]:g} N" in text


def test_the_class_on_the_page_lets_go_when_the_person_tugs_and_not_before(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (file := tmp_path / "tug.py").write_text(code)
    took, touched = Simulator(ROBOT, OBJECTS, Setting(), seed=0)(
        screwdrivers(), [Case(f"{file}:Tug", scenario, 0) for scenario in ("take", "nobody")]
    )
    assert took.transfers.outcome == ["taken"] * 3 and (took.transfers.pull_n > 6.0).all()
    assert touched.transfers.outcome == ["kept"] * 3 and (touched.transfers.surplus_n < 0).all()
    assert np.isfinite(touched.transfers.surplus_n).all()


def test_a_policy_that_gives_no_surplus_has_none_and_is_not_undecided_for_it(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (file := tmp_path / "tug.py").write_text(code.replace(", surplus_n=surplus_n", ""))
    (made,) = Simulator(ROBOT, OBJECTS, Setting(), seed=0)(screwdrivers(), [Case(f"{file}:Tug", "nobody", 0)])
    assert np.isnan(made.transfers.surplus_n).all() and made.transfers.outcome == ["kept"] * 3
    assert not made.transfers.undecided.any()
