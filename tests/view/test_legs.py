"""Legs of picking before a stored motion, and the leg in which a pick fails (r2h_batch.view.legs)."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.judge.pick import picked
from r2h_batch.observe import moments
from r2h_batch.scene.model_parts import VISUAL
from r2h_batch.sweep.command import main as sweep
from r2h_batch.view import film as films
from r2h_batch.view import pictures
from r2h_batch.view.drawing import LINE_M, RED, TIP_M, Drawing, view_of
from r2h_batch.view.lab.folder import write_trial
from r2h_batch.view.lab.sheets import object_sheet
from r2h_batch.view.page import Drawn
from r2h_batch.view.stored import Reader

NEAR_M = 2e-3
"""Closing moves an object between the pads by this much at most here, and straight ways leave their lines by less."""
WANTED = ("grasp_collides", "out_of_reach", "no_straight_way")


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    out = tmp_path_factory.mktemp("legs") / "run"
    line = ["--benchmark", "r2h-v3", "--method", "random", "fc", "--trials", "9", "--execute.sim", "none"]
    assert sweep([*line, "--out", str(out)]) == 0
    return Reader(out)


def rows(reader, method):
    return reader.rows(reader.method(method)).to_pylist()


def passing(reader):
    return next(r["trial_id"] for r in rows(reader, "fc") if r["passed_pick"] and r["passed_plan"])


@pytest.fixture(scope="module")
def carried(reader):
    """A trial of FC that is picked and has a path, with its legs. It is not changed."""
    return reader.trial(passing(reader), "fc")


def object_at(drawing, q):
    body = drawing.at(q).body("object")
    return np.append(body.xpos, body.xmat).copy()


def test_legs_lead_from_home_to_the_motion_and_take_the_object_along(carried):
    stored, drawing = carried, Drawing(carried)
    picks, lifts = drawing.legs
    assert np.allclose(picks.stored.q[0], stored.workplace.home_q) and picks.stored.goes_on
    turn = np.round((picks.stored.q[-1] - lifts.stored.q[0]) / (2 * np.pi)) * 2 * np.pi
    assert np.allclose(picks.stored.q[-1] - lifts.stored.q[0], turn, atol=2e-3)
    turn = np.round((lifts.stored.q[-1] - stored.q[0]) / (2 * np.pi)) * 2 * np.pi
    assert np.allclose(lifts.stored.q[-1] - stored.q[0], turn, atol=1e-6)
    first, before = (object_at(picks, q) for q in (picks.stored.q[0], picks.stored.q[-1]))
    assert np.array_equal(first, before)  # nobody holds it
    taken, up, carried = (
        object_at(d, q) for d, q in ((lifts, lifts.stored.q[0]), (lifts, lifts.stored.q[-1]), (drawing, stored.q[0]))
    )
    assert np.abs(taken - before)[:3].max() < NEAR_M and np.abs(taken - before)[3:].max() < 1e-3
    assert np.allclose((up - taken)[:3], [0.0, 0.0, 0.1], atol=NEAR_M) and np.allclose(carried, up, atol=1e-5)


class FakeScene:
    """Stands for viser's scene: keeps each handle by its path."""

    def __init__(self):
        self.handles = {}

    def __getattr__(self, name):
        if not name.startswith("add_"):
            raise AttributeError(name)

        def add(path, *_, **how):
            self.handles[path] = SimpleNamespace(**how)
            return self.handles[path]

        return add


def test_a_page_plays_the_legs_first_with_an_open_gripper_and_the_object_where_it_is(carried):
    drawing = Drawing(carried)
    scene = FakeScene()
    drawn = Drawn(scene, drawing, view_of([drawing], 1.2))
    picks, lifts = drawing.legs
    ends = np.cumsum([d.motion()[0][-1] for d in (picks, lifts, drawing)])
    assert drawn.play() == pytest.approx(ends[-1]) and ends[-1] > drawing.motion()[0][-1] + 2
    for time_s, of, q, opened in (
        (0.0, picks, picks.stored.workplace.home_q, True),
        (ends[0] - 1e-6, picks, picks.stored.q[-1], True),
        (ends[1] - 1e-6, lifts, lifts.stored.q[-1], False),
        (ends[2], drawing, drawing.motion()[1][-1], False),
    ):
        drawn.at(float(time_s))
        data = of.at(np.array(q))
        for body in ("object", "gripper"):
            assert np.allclose(scene.handles[f"/trial/{body}"].position, data.body(body).xpos, atol=1e-3), (
                time_s,
                body,
            )
        assert np.allclose(scene.handles["/trial/gripper_open"].position, data.body("gripper").xpos, atol=1e-3)
        assert scene.handles["/trial/gripper_open"].visible == opened
        assert scene.handles["/trial/gripper"].visible == (not opened)


def test_the_resting_object_lies_at_the_trials_moment_and_the_gripper_comes_open(reader, carried):
    number, leg = passing(reader), carried.before[0]
    trial = load_benchmark("r2h-v3").trials_with_ids(torch.tensor([number]))
    T = moments(reader.evaluator.scene, trial)[0].double().numpy()
    assert np.array_equal(leg.resting, T) and leg.row["opening_m"] == leg.robot.open_gap_m
    drawing = Drawing(leg)
    pads = [drawing.at(leg.q[-1]).geom(f"gripper/{side}_pad").xpos.copy() for side in ("left", "right")]
    held = Drawing(carried)
    closed = [held.at(leg.q[-1]).geom(f"gripper/{side}_pad").xpos.copy() for side in ("left", "right")]
    assert np.linalg.norm(pads[0] - pads[1]) > np.linalg.norm(closed[0] - closed[1]) + 1e-3


def test_where_a_pick_fails_the_posture_and_the_pair_of_its_margin_are_drawn(reader):
    seen = set()
    for row in each([r for r in rows(reader, "random") if r["outcome"] == "pick"]):
        reason = row["pick_reason"]
        if reason in seen:
            continue
        seen.add(reason)
        stored = reader.trial(row["trial_id"], "random")
        drawing = Drawing(stored)
        trial = load_benchmark("r2h-v3").trials_with_ids(torch.tensor([row["trial_id"]]))
        T_world_obj = moments(reader.evaluator.scene, trial)
        T = torch.tensor(stored.T_obj_ee, dtype=torch.float32)[None]
        grasp = picked(reader.evaluator.scene, T, T_world_obj, trial).T_world_ee[0].double().numpy()
        ee = drawing.at(stored.target_q).site("ee")
        if reason == "out_of_reach":
            assert drawing.witness.kind == "unreachable" and stored.unreachable
            assert drawing.witness.distance_m == pytest.approx(row["margin_pick_m"])
            assert np.linalg.norm(ee.xpos - grasp[:3, 3]) > 1e-3
            continue
        assert not stored.unreachable and not stored.moves and stored.before == ()
        assert np.allclose(ee.xpos, grasp[:3, 3], atol=1e-4)
        assert np.allclose(object_at(drawing, stored.target_q)[:3], T_world_obj[0, :3, 3], atol=1e-6)
        if reason == "grasp_collides":
            assert drawing.witness.kind == row["pick_pair"] and drawing.witness.distance_m < 0
            assert row["pick_part"] in str(drawing.witness.geoms)
            assert drawing.witness.least_m == pytest.approx(row["margin_pick_m"])
            # the link that meets the table is red, and no ball hides it
            link = drawing.model.geom(drawing.seen_of(drawing.model.geom(drawing.witness.geoms[0]).id))
            assert link.name == f"{re.sub(r'_[0-9]+$', '', drawing.witness.geoms[0])}_visual"
            assert {m.radius_m for m in drawing.marks if m.group == "witness"} == {LINE_M, TIP_M}
            with pictures.painter(drawing, (480, 384), view_of([drawing], 1.25, close=True)) as paint:
                shown = [paint(stored.target_q, *groups) for groups in ((), ("witness",))]
                assert np.allclose(drawing.model.geom_rgba[link.id], (*RED[:3], 1.0), atol=1e-6)
            assert not np.array_equal(*shown)
        if reason == "no_straight_way":
            assert drawing.witness is None and any(m.group == "witness" for m in drawing.marks)
    assert seen >= {"grasp_collides", "out_of_reach"} and len(seen) >= len(WANTED)


def test_a_film_shows_the_legs_then_the_motion_with_the_time_going_on(carried, monkeypatch):
    drawing = Drawing(carried)
    words, postures = [], []

    class Told:
        def __enter__(self):
            return lambda q, *groups, view=None: postures.append(q) or np.zeros((90, 160, 3), np.uint8)

        def __exit__(self, *_):
            return None

    monkeypatch.setattr(films, "painter", lambda *_: Told())
    monkeypatch.setattr(films.Caption, "around", lambda self, image, head, lines: words.append(lines) or image)
    view = view_of([drawing], 1.5)
    frames = list(films._film(films.Story(drawing), (320, 240), 4, view))
    rested = len(films._times(drawing, 4, rests=True))
    assert len(frames) == sum(len(films._times(leg, 4)) for leg in drawing.legs) + rested
    does = [line[1] for line in words]
    assert does[0] == "picks" and "lifts" in does and does.index("lifts") > 2
    assert "success" in does[-1] or "fails" in does[-1]
    seconds = [float(line[0].partition(" ")[0]) for line in words]
    assert seconds == sorted(seconds)
    assert np.allclose(postures[0], drawing.stored.workplace.home_q)
    assert drawing.bounds().shape[0] > drawing.legs[0].bounds().shape[0]


@pytest.mark.whole(part="view")
def test_a_laboratory_gets_the_paths_to_the_object_and_up_before_the_carry(carried, tmp_path):
    stored = carried
    write_trial(stored, tmp_path, step_s=0.05, tcp_speed=0.25)
    ways = {}
    for name in each(("pick", "lift", "there", "back")):
        assert (tmp_path / f"{name}.ros2.json").exists() and (tmp_path / f"{name}.script").exists()
        lines = (tmp_path / f"{name}.csv").read_text().splitlines()
        head = lines[0].split(",")
        own = [head.index(f"q_{j}") for j in stored.robot.joints]
        ways[name] = np.array([[float(line.split(",")[k]) for k in own] for line in lines[1:]])
    drawn, T = object_sheet(stored.before[0]), stored.before[0].resting
    outline = drawn.shapes[0][0]
    assert np.allclose(outline, (stored.object_model.vertices @ T[:3, :3].T + T[:3, 3])[:, :2], atol=1e-9)
    assert np.abs(np.array(drawn.cross) - outline.mean(0)).max() <= 0.025 + 1e-9
    assert (tmp_path / "object.pdf").stat().st_size > 1000
    assert np.allclose(ways["pick"][0], stored.workplace.home_q, atol=1e-6)
    for a, b in each((("pick", "lift"), ("lift", "there"), ("there", "back"))):
        gap = ways[a][-1] - ways[b][0]
        assert np.allclose(gap - 2 * np.pi * np.round(gap / (2 * np.pi)), 0.0, atol=2e-3)
    about = json.loads((tmp_path / "trial.json").read_text())
    assert np.allclose(np.radians(about["lab"]["joints_deg"]["home"]), stored.workplace.home_q, atol=1e-4)
    loads = [
        re.search(r"set_target_payload\(([0-9.]+)|set_payload\(([0-9.]+)", (tmp_path / f"{n}.script").read_text())
        for n in ("pick", "lift")
    ]
    light, heavy = (float(next(g for g in found.groups() if g)) for found in loads)
    assert heavy - light == pytest.approx(stored.object_model.mass, abs=1e-3)


@pytest.mark.whole(part="view")
def test_strips_begin_with_the_grasp_on_the_table_and_the_lift(carried):
    drawing = Drawing(carried)
    for n in each((3, 5)):
        found = pictures.images(drawing, (64, 48), n)
        assert len(found) == n
    assert [words for _, words in found][:2] == ["picks", "lifts"] and found[2][1] != "0.0 s"
    assert drawing.legs[0].model.geom("object/mesh_visual").group == VISUAL
