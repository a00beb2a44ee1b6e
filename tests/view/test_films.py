"""Films: what they say, what they show at the end, and that they say how far they are."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from needs import needs

from r2h_batch.view import film as films
from r2h_batch.view.drawing import DIRECTIONS_DEG, Drawing, view_of
from r2h_batch.view.film import STILL_S, Caption, Story, write_film
from r2h_batch.view.mjcf import MARK
from r2h_batch.view.stored import Reader

pytestmark = needs("gl")


@pytest.fixture(scope="module")
def reader(run):
    return Reader(run)


def drawing_of(reader, outcome, method="random"):
    rows = reader.rows(method).to_pylist()
    trial = next(r["trial_id"] for r in rows if r["outcome"] == outcome)
    return Drawing(reader.trial(trial, method))


def lines_of(monkeypatch):
    """Every (head, words) that a film writes around an image."""
    said = []
    around = Caption.around

    def listening(self, image, head, words):
        said.append((head, tuple(words)))
        return around(self, image, head, words)

    monkeypatch.setattr(Caption, "around", listening)
    return said


def test_a_film_says_trial_method_time_and_from_the_end_on_the_verdict(reader, tmp_path, monkeypatch):
    said = lines_of(monkeypatch)
    drawing = drawing_of(reader, "success", "oracle")
    write_film([Story(drawing)], tmp_path / "x.gif", size=(240, 180), fps=2)
    end = drawing.motion()[0][-1]
    assert all(f"Trial {drawing.stored.row['trial_id']}:" in head and "oracle" in head for head, _ in said)
    for k, (_, (when, verdict)) in enumerate(said):
        assert when == f"{min(k / 2, end):.1f} s" and verdict.startswith("success" if k / 2 >= end else ""), k
        assert bool(verdict) == (k / 2 >= end)
    assert sum(bool(v) for _, (_, v) in said) >= 2  # there is time to read it


@pytest.mark.whole(part="view")
def test_a_film_without_a_motion_turns_around_the_posture_and_says_why(reader, tmp_path, monkeypatch):
    import imageio.v3 as imageio

    said = lines_of(monkeypatch)
    drawing = drawing_of(reader, "plan")
    write_film([Story(drawing)], tmp_path / "x.gif", size=(240, 180), fps=3)
    film = imageio.imread(tmp_path / "x.gif", index=None)[..., :3].astype(int)
    assert len(said) == len(film) == round(3 * STILL_S)
    assert np.abs(np.diff(film, axis=0)).mean((1, 2, 3)).min() > 0.2  # no two pictures are the same
    _, words = said[0]
    assert words[0].startswith("plan fails") and drawing.witness.caption in words and "no motion" in words[-1]


@pytest.mark.parametrize("outcome", ["success", "reach"])
def test_gripper_and_object_are_seen_in_the_last_second(reader, outcome):
    """By another way than the rays that choose the camera: pixels of gripper and object, drawn with all others against alone."""
    drawing = drawing_of(reader, outcome, "oracle" if outcome == "success" else "random")
    model, view = drawing.model, view_of([drawing], 4 / 3)
    model.vis.global_.offwidth, model.vis.global_.offheight = 320, 240
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    camera.lookat[:], camera.distance = view.look_at, view.distance_m
    camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
    option.geomgroup[MARK] = option.sitegroup[:] = 0
    own = drawing.visual_geoms(("gripper", "object"))
    solid = model.geom_rgba.copy()
    seen = []
    times, q = drawing.motion()
    with mujoco.Renderer(model, 240, 320) as drawer:
        drawer.enable_segmentation_rendering()
        for alone in (False, True):
            model.geom_rgba[:] = solid
            if alone:
                model.geom_rgba[[g for g in range(model.ngeom) if g not in own], 3] = 0.0
            for ago in (0.0, 0.5, 1.0):
                data = drawing.at(q[np.abs(times - (times[-1] - ago)).argmin()])
                drawer.update_scene(data, camera, option)
                ids = drawer.render()
                seen.append(int((np.isin(ids[..., 0], own) & (ids[..., 1] == mujoco.mjtObj.mjOBJ_GEOM)).sum()))
    model.geom_rgba[:] = solid
    share = np.array(seen[:3]) / np.array(seen[3:])
    assert share.min() > 0.5, share


def test_a_camera_is_chosen_by_what_it_sees(reader):
    """With a wall before gripper and object from the side that was chosen, another side is."""
    drawing = drawing_of(reader, "success", "oracle")
    chosen = view_of([drawing], 4 / 3)
    again = Drawing(drawing.stored)
    spot, forward = again.at(again.last).site("ee").xpos.copy(), chosen.axes[2]
    wall = again.model.geom("table/top_visual").id  # a box that is seen: it becomes the wall
    again.model.geom_pos[wall] = spot - 0.35 * forward - again.model.body("table").pos
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(chosen.axes.T).ravel())
    again.model.geom_quat[wall], again.model.geom_size[wall] = quat, [0.25, 0.25, 0.01]
    other = view_of([again], 4 / 3)
    assert (other.azimuth_deg, other.elevation_deg) != (chosen.azimuth_deg, chosen.elevation_deg)
    assert len(again.sides) == len(DIRECTIONS_DEG)


@pytest.mark.whole(part="view")
def test_a_film_tells_how_far_it_is_in_python_too(reader, tmp_path, monkeypatch):
    told = []
    drawing = drawing_of(reader, "success", "oracle")

    class Listening:
        def __init__(self, name, total, unit):
            told.append([name, total, unit, 0])

        def __enter__(self):
            return lambda n: told[-1].__setitem__(3, told[-1][3] + n)

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(films, "progress", Listening)
    write_film([Story(drawing)], tmp_path / "x.gif", size=(96, 64), fps=1)
    assert told == [["film x.gif", told[0][1], "pictures", told[0][1]]]


def test_captions_do_not_lie_over_the_picture():
    letters = Caption.of((320, 240), 3)
    image = np.full((letters.inner[1], 320, 3), 77, np.uint8)
    made = letters.around(image, "head", ["1.0 s", "a verdict that is far too long for its line " * 5])
    assert made.shape == (240, 320, 3) and (made[letters.row : letters.row + len(image)] == 77).all()
    assert (made[: letters.row] < 100).any() and (made[letters.row + len(image) :] < 100).any()
    assert replace(letters, letters=0).around(image, "head", []) is image
