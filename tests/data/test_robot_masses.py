"""Imports of files that say no mass, no inertia or no speed: defaults, warnings, refusals."""

import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from refusals import one_line
from robot_files import SHAPES, read_arm, write_mjcf, write_urdf
from rounds import each

from r2h_batch.data import robot as robot_import
from r2h_batch.data.robot_masses import check_masses, weighed

INERTIAL = re.compile(r"<inertial>.*?</inertial>")
KG_M3 = 1000.0


def without(path, *links, keep=""):
    """The URDF in its place with `keep` for the <inertial> of these links."""
    text = path.read_text()
    for link in links:
        at = text.index(f'<link name="{link}">')
        text = text[:at] + INERTIAL.sub(keep, text[at:], count=1)
    path.write_text(text)
    return path


def weigh(path):
    chain, links = read_arm(path)
    with pytest.warns(UserWarning, match="no mass or no inertia of .*: those of its convex hull at 1000 kg/m3"):
        return weighed(check_masses(chain, "x"), links, "x")


@pytest.mark.parametrize("no", ["", "<inertial/>", '<inertial><mass value="0"/></inertial>'])
def test_a_link_without_a_mass_weighs_what_its_hull_does(no, tmp_path):
    sides, middle = (np.array(x) for x in SHAPES[5][1:])
    chain, got = weigh(without(write_urdf(tmp_path), "l5", keep=no))
    box, other = chain.links[5], chain.links[3]
    mass = KG_M3 * sides.prod()
    assert got == (5,) and box.mass == pytest.approx(mass) and box.com == pytest.approx(middle, abs=1e-9)
    assert box.inertia == pytest.approx(np.diag(mass / 12 * ((sides @ sides) - sides**2)), abs=1e-9)
    assert other.mass == 1.5 and other.com == pytest.approx([0, 0, 0.05])


def test_a_mass_without_an_inertia_keeps_its_place(tmp_path):
    keep = '<inertial><origin xyz="0.01 0 0.05"/><mass value="0.7"/></inertial>'
    chain, got = weigh(without(write_urdf(tmp_path), "l5", keep=keep))
    sides, box = np.array(SHAPES[5][1]), chain.links[5]
    assert got == (5,) and box.mass == 0.7 and box.com == pytest.approx([0.01, 0, 0.05])
    assert box.inertia == pytest.approx(np.diag(0.7 / 12 * ((sides @ sides) - sides**2)), abs=1e-9)


def test_torques_that_are_assumed_count_these_masses(tmp_path):
    known, _ = read_arm(write_urdf(tmp_path, **{' effort="80"': ""}))
    chain, _ = weigh(without(write_urdf(tmp_path, **{' effort="80"': ""}), "l5"))
    sides, middle = SHAPES[5][1:]
    lever = 0.18 + 0.20 + 0.20 + 0.20  # from joint 1 to joint 5: the rods between them
    more = KG_M3 * np.prod(sides) * (lever + middle[2]) - 1.5 * (lever + 0.05)
    assert chain.effort[0] == pytest.approx(known.effort[0] + 2 * 9.81 * more)
    assert chain.effort[4:].tolist() == known.effort[4:].tolist() == [20, 20, 20]


def test_a_file_that_says_all_is_left_as_it_is(tmp_path):
    chain, links = read_arm(write_urdf(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same, got = weighed(check_masses(chain, "x"), links, "x")
    assert got == () and [x.mass for x in same.links] == [x.mass for x in chain.links]


def test_a_flat_link_and_one_of_nothing_have_a_mass(tmp_path):
    chain, links = read_arm(without(write_urdf(tmp_path), "l4"))
    for corners in (np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), np.zeros((3, 3)) + [0.01, 0, 0]):
        links[4] = links[4].__class__("l4", corners[None], 1, (), ())
        with pytest.warns(UserWarning):
            found, _ = weighed(check_masses(chain, "x"), links, "x")
        moments = np.linalg.eigvalsh(found.links[4].inertia)
        assert found.links[4].mass == 0.05 and (moments > 0).all() and moments[2] <= moments[:2].sum() * (1 + 1e-6)


def test_a_link_that_no_robot_has_is_refused_before_bodies_are_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr(robot_import, "bodies_of", lambda *_: pytest.fail("a body was fitted"))
    made = {"name": "m", "base": "base", "flange": "flange", "packages": {}}
    huge = without(write_urdf(tmp_path, **{'"0.08 0.08 0.16"': '"1.1 1 1"'}), "l4")
    with pytest.warns(UserWarning), one_line("link l4 fills so much that it would weigh 1100 kg .* correct the scale"):
        robot_import.import_robot(huge, **made)
    heavy = write_urdf(tmp_path, **{'<mass value="1.5"/>': '<mass value="1500"/>'})
    with one_line("link l1 has 1500 kg and moments to 0 kg m.2; 1000 kg and 1000 kg m.2 are allowed"):
        robot_import.import_robot(heavy, **made)
    stout = write_urdf(tmp_path, **{'ixx="0.01"': 'ixx="2e3"', 'iyy="0.012"': 'iyy="2e3"'})
    with one_line("link l1 has 2 kg and moments to 2000 kg m.2"):
        robot_import.import_robot(stout, **made)


@pytest.mark.parametrize("given", ["", ' velocity="0"'])
def test_a_joint_without_a_speed_gets_2_rad_s(given, tmp_path):
    path = write_urdf(tmp_path, **{'effort="80" velocity="2"': f'effort="80"{given}', 'velocity="2"': 'velocity="3"'})
    chain, _ = read_arm(path)
    assert chain.assumed_speed == ("j1", "j2", "j3", "j4")
    assert chain.velocity.tolist() == [2, 2, 2, 2, 3, 3, 3]
    assert read_arm(write_mjcf(tmp_path))[0].assumed_speed == tuple(f"j{k}" for k in range(1, 8))


@pytest.mark.parametrize("none", ["1e9", "inf", "1.79769e+308", "250"])
def test_a_speed_that_limits_nothing_is_no_limit(none, tmp_path):
    """Files write it where they know none; 100 rad/s are 16 turns a second."""
    chain, _ = read_arm(write_urdf(tmp_path, **{'effort="80" velocity="2"': f'effort="80" velocity="{none}"'}))
    assert chain.assumed_speed == ("j1", "j2", "j3", "j4") and set(chain.velocity.tolist()) == {2.0}
    fast, _ = read_arm(write_urdf(tmp_path, **{'velocity="2"': 'velocity="100"'}))
    assert fast.assumed_speed == () and set(fast.velocity.tolist()) == {100.0}


def test_a_torque_or_an_angle_that_limits_nothing_is_no_limit(tmp_path):
    plain, _ = read_arm(write_urdf(tmp_path))
    weak, _ = read_arm(write_urdf(tmp_path, **{' effort="80"': ""}))
    for none in each(("1e9", "inf", "2e5")):
        chain, _ = read_arm(write_urdf(tmp_path, **{'effort="80"': f'effort="{none}"'}))
        assert plain.assumed == () and chain.assumed == weak.assumed == ("j1", "j2", "j3", "j4")
        assert np.array_equal(chain.effort, weak.effort)
    whole, _ = read_arm(write_urdf(tmp_path, **{'lower="-2.9" upper="2.9"': 'lower="-1e9" upper="inf"'}))
    assert np.allclose([whole.lower[0], whole.upper[0]], [-2 * np.pi, 2 * np.pi])
    for wrong, words in each(
        (("-1e9", "a number from"), ("nan", "a number from"), ("2 3", "a number from"), ("fast", "is 'fast'"))
    ):
        with one_line(words):
            read_arm(write_urdf(tmp_path, **{'velocity="2"': f'velocity="{wrong}"'}))


def test_a_speed_below_0_is_refused(tmp_path):
    with one_line("joint j1: velocity -2; it must be above 0, or left out for 2 rad/s"):
        read_arm(write_urdf(tmp_path, **{'velocity="2"': 'velocity="-2"'}))


def test_a_command_says_each_warning_once():
    work = (
        "import warnings\nfrom r2h_batch.base.command_line import exit_code_of\n"
        "def say(text):\n    with warnings.catch_warnings():\n        warnings.warn(text)\n    return 0\n"
        "exit_code_of('tried', lambda: say('one') + say('one') + say('other'))\n"
    )  # in a process of its own: pytest takes warnings itself
    done = subprocess.run([sys.executable, "-c", work], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr.splitlines()) == ("", ["tried: one", "tried: other"])


def test_two_shapes_of_one_name_print_nothing(tmp_path, capfd):
    read_arm(write_urdf(tmp_path, **{"<collision>": '<collision name="same">', "<visual>": '<visual name="same">'}))
    assert capfd.readouterr() == ("", "")
