"""The viewer, its pages, videos and words: what is drawn is where the verdict says, and a page needs nobody."""

import base64
import json
import re
import subprocess
from io import BytesIO

import mujoco
import numpy as np
import pytest
import trimesh
from needs import CHROMIUM, needs

from r2h_batch.__main__ import main
from r2h_batch.export.drawing import Stage
from r2h_batch.export.stored import Reader
from r2h_batch.scene import offscreen
from r2h_batch.view import words
from r2h_batch.view.choose import ANY, Filter, chosen, words_of
from r2h_batch.view.shapes import coarse, shape_of

pytestmark = needs("viser")


@pytest.fixture(scope="module")
def reader(run):
    return Reader(run)


def first(reader, **wanted):
    """The first trial of `random` with these words."""
    for row in reader.rows("random").to_pylist():
        if all(row[k] == v for k, v in wanted.items()):
            return reader.trial(row["trial_id"], "random")
    raise AssertionError(f"none of random's trials is {wanted}")


def recorded(html):
    """The scene that a page holds: its messages with their times, and the bytes of its buffers."""
    import msgspec  # both come with viser
    import zstandard

    packed = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', html)[1])
    data = zstandard.ZstdDecompressor().stream_reader(BytesIO(packed[8:])).read()
    size = int.from_bytes(data[:8], "little")
    return msgspec.msgpack.decode(data[8 : 8 + size])


@pytest.mark.check
def test_filters_choose_and_sort_rows():
    rows = [
        {"trial_id": k, "object": o, "outcome": c, "plan_reason": r, "margin_plan_m": m}
        for k, o, c, r, m in (
            (0, "cup", "success", "ok", 0.02), (1, "bowl", "plan", "ik_unreachable", None), (2, "cup", "safe", "ok", 0.001)
        )
    ]  # fmt: skip
    assert words_of(rows, "object") == [ANY, "bowl", "cup"]
    assert [r["trial_id"] for r in chosen(rows, Filter())] == [0, 1, 2]
    assert [r["trial_id"] for r in chosen(rows, Filter(object="cup", outcome="safe"))] == [2]
    assert [r["trial_id"] for r in chosen(rows, Filter(reason="ik_unreachable"))] == [1]
    assert [r["trial_id"] for r in chosen(rows, Filter(order="margin of plan"))] == [2, 0]
    assert [r["trial_id"] for r in chosen(rows, Filter(order="margin of plan", below_mm=5))] == [2]


def test_a_coarse_surface_stays_within_its_cells():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    v, f = coarse(np.asarray(ball.vertices), np.asarray(ball.faces), 0.004)
    assert len(f) < len(ball.faces) / 3 and np.abs(np.linalg.norm(v, axis=1) - 0.05).max() < 0.004 * 3**0.5
    made = trimesh.Trimesh(v, f, process=False)
    assert abs(made.volume / ball.volume - 1) < 0.03 and f.max() == len(v) - 1


def test_a_failed_plan_is_shown_with_what_speaks_against_it(reader):
    met = Stage(first(reader, plan_reason="ik_in_collision"))
    pair = met.witness
    assert pair.kind == met.stored.row["plan_pair"] and pair.distance_m < 0 and "overlap by" in pair.words
    length = np.linalg.norm(pair.line[1] - pair.line[0])
    assert abs(length + pair.distance_m) < 1e-6
    far = Stage(first(reader, plan_reason="ik_unreachable"))
    assert far.witness.kind == "unreachable" and far.witness.distance_m < -1e-3 and far.witness.geoms == ()
    for stage, names in (
        (met, ("plan fails: ik in collision", "overlap")),
        (far, ("plan fails: ik unreachable", "stays")),
    ):
        told = words.as_markdown(stage)
        assert all(name in told for name in names) and told.count("| fails |") + told.count("| passes |") >= 2


def test_a_shape_stands_where_mujoco_has_the_geom(reader):
    stage = Stage(reader.trial(1, "oracle"))
    data = mujoco.MjData(stage.model)
    data.qpos[:] = stage.stored.target_q
    mujoco.mj_kinematics(stage.model, data)
    for name in ("object/mesh_visual", "robot/upper_arm_visual", "table/top", "gripper/left_pad"):
        g = stage.model.geom(name).id
        shape, body = shape_of(stage.model, g), int(stage.model.geom_bodyid[g])
        R, turn = data.xmat[body].reshape(3, 3), np.empty(9)
        mujoco.mju_quat2Mat(turn, shape.quat_wxyz)
        middle = (shape.vertices.max(0) + shape.vertices.min(0)) / 2
        drawn = R @ (turn.reshape(3, 3) @ middle + shape.pos) + data.xpos[body]
        box = stage.model.geom_aabb[g][:3]
        real = data.geom_xmat[g].reshape(3, 3) @ box + data.geom_xpos[g]
        assert np.abs(drawn - real).max() < 2.5e-3, name


def test_a_page_holds_the_trial_its_motion_and_its_margins(run, reader, tmp_path, capsys):
    file = tmp_path / "a" / "page.html"
    assert main(["view", str(run), "--method", "oracle", "--trial", "1", "--html", str(file)]) == 0
    assert capsys.readouterr().out.strip() == str(file)
    html = file.read_text(encoding="utf-8")
    assert 1e5 < len(html) < 4e6 and 'src="http' not in html and 'href="http' not in html
    row = reader.trial(1, "oracle").row
    assert f"{1e3 * row['margin_plan_m']:+.1f} mm" in html and "success" in html
    scene = recorded(html)
    assert abs(scene["durationSeconds"] - reader.trial(1, "oracle").time_s[-1]) < 3.0
    names = {m.get("name") for _, m in scene["messages"]}
    assert {"/trial_0/ball", "/trial_0/hand/hand_mesh_visual", "/trial_0/object/object_mesh_visual"} <= names
    assert "/trial_0/witness" not in names and any("region_visual_mark" in str(n) for n in names)


def test_two_methods_stand_side_by_side_and_a_failed_plan_in_red(run, reader, tmp_path):
    trial = first(reader, plan_reason="ik_in_collision").row["trial_id"]
    file = tmp_path / "two.html"
    assert main(["view", str(run), "--method", "random", "oracle", "--trial", str(trial), "--html", str(file)]) == 0
    names = {m.get("name") for _, m in recorded(file.read_text())["messages"]}
    assert {"/trial_0/witness", "/trial_0/witness_label", "/trial_1/ball"} <= names and "/trial_1/witness" not in names
    assert any(str(n).endswith("_red") for n in names)


def test_the_viewer_lists_filters_steps_and_shows(reader, monkeypatch):
    from r2h_batch.view import server
    from r2h_batch.view.server import NOBODY, Viewer

    viewer = Viewer(reader, ["random", "oracle"], trial=4)
    try:
        assert viewer.listed[viewer.list.value] == 4 and len(viewer.drawn) == 2 and viewer.beside.value == "oracle"
        viewer.beside.value = NOBODY
        viewer.outcome.value = "plan"
        # _filter, _step, _show, _pose: a browser's click runs them in a thread of viser's; here they are waited for
        viewer._filter()
        assert len(viewer.drawn) == 1 and all(" plan fails" in line for line in viewer.listed)
        seen = {viewer.listed[viewer.list.value]}
        for _ in range(len(viewer.listed) - 1):
            viewer._step(1)
            viewer._show()
            seen.add(viewer.listed[viewer.list.value])
            assert "plan fails" in viewer.words.content
        assert seen == set(viewer.listed.values())
        viewer.method.value, viewer.outcome.value = "oracle", ANY
        viewer._filter(3)
        before = viewer.drawn[0].bodies[max(viewer.drawn[0].moving)].position.copy()
        monkeypatch.setattr(
            server, "LISTED", 3
        )  # a run of more trials than a list should have: the next ones, by `from`
        viewer.start.value = 4
        viewer._filter()
        assert list(viewer.listed.values()) == sorted(viewer.listed.values()) and len(viewer.listed) == 3
        assert "4 to 6 listed" in viewer.count.content
        viewer.start.value = 10**6
        viewer._filter()
        assert len(viewer.listed) == 1
        viewer.slider.value = 0.0
        viewer._pose()
        assert np.abs(viewer.drawn[0].bodies[max(viewer.drawn[0].moving)].position - before).max() > 0.05
    finally:
        viewer.stop()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["view", "RUN", "--html", "x.html"], "--html needs --trial"),
        (["view", "RUN", "--method", "a", "b", "c"], "two can be seen side by side"),
        (["view", "RUN", "--trial", "7777", "--method", "random", "--html", "x.html"], "no trial 7777"),
        (["video", "RUN", "--trial", "0", "--out", "x.doc"], ".mp4"),
        (["video", "RUN", "--trial", "0", "--out", "x.mp4", "--size", "99999", "3"], "--size"),
        (["strips", "--trial", "-1", "--out", "x.png"], "--trial is -1"),
    ],
)  # fmt: skip
def test_what_cannot_be_shown_is_refused_in_one_line(run, capsys, line, said):
    assert main([str(run) if word == "RUN" else word for word in line]) == 2
    out = capsys.readouterr()
    assert out.out == "" and out.err.count("\n") == 1 and said in out.err


def test_without_an_opengl_one_line_says_what_to_install(run, tmp_path, capsys, monkeypatch):
    offscreen.ready.cache_clear()
    monkeypatch.setattr(offscreen, "_works", lambda backend: False)
    try:
        assert main(["video", str(run), "--method", "oracle", "--trial", "0", "--out", str(tmp_path / "x.png")]) == 1
    finally:
        offscreen.ready.cache_clear()
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "apt-get install libosmesa6" in said


@needs("gl")
def test_a_film_and_a_strip_show_the_motion(run, reader, tmp_path):
    import imageio.v3 as imageio

    small = ["--size", "96", "64"]
    film = tmp_path / "x.mp4"
    assert (
        main(["video", str(run), "--method", "oracle", "--trial", "1", "--out", str(film), "--fps", "2", *small]) == 0
    )
    pictures = imageio.imread(film)
    seconds = reader.trial(1, "oracle").time_s[-1]
    assert pictures.shape[1:] == (64, 96, 3) and abs(len(pictures) / 2 - seconds) < 2.0
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 1.0
    trial = str(first(reader, plan_reason="ik_in_collision").row["trial_id"])
    strip = tmp_path / "x.png"
    assert main(["video", str(run), "--method", "random", "oracle", "--trial", trial, "--out", str(strip), *small]) == 0
    both = imageio.imread(strip).astype(int)
    assert both.shape == (128, 480, 3)
    red = (both[..., 0] > 130) & (both[..., 1] < 60) & (both[..., 2] < 60)
    assert red[:64].any() and not red[64:].any()


@needs("chromium")
def test_a_page_draws_its_scene_in_a_browser_without_server_or_network(reader, tmp_path):
    import imageio.v3 as imageio

    from r2h_batch.view.page import write_page

    page, png = write_page(first(reader, plan_reason="ik_in_collision"), tmp_path / "p.html"), tmp_path / "p.png"
    flags = [
        "--headless=new",
        "--no-sandbox",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ]
    flags += [
        "--window-size=640,480",
        "--virtual-time-budget=6000",
        f"--screenshot={png}",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ]
    subprocess.run([CHROMIUM, *flags, page.as_uri()], capture_output=True, timeout=240, check=True)
    picture = imageio.imread(png)[..., :3].astype(int)
    spread = picture.max(-1) - picture.min(-1)
    assert (spread[:, :420] > 60).mean() > 0.002, "nothing coloured is drawn: object, hand, red bodies"
    assert json.dumps(picture.shape) == "[480, 640, 3]"


def test_a_receiver_with_a_body_is_drawn_where_the_protocol_has_it(reader):
    from dataclasses import replace

    from r2h_batch import make_trials

    receiver = make_trials("S0", 1, protocol="r2h-v1").receiver[0].double().numpy()
    model = Stage(replace(reader.trial(1, "oracle"), receiver=receiver)).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name, a, b in (("upper_arm", 0, 1), ("forearm", 1, 2)):
        geom = model.geom(f"receiver/{name}_visual")
        ends = data.geom(geom.id).xpos + np.outer([-1, 1], data.geom(geom.id).xmat.reshape(3, 3)[:, 2] * geom.size[1])
        assert np.abs(np.sort(ends, 0) - np.sort(receiver[[a, b], :3], 0)).max() < 1e-6
        assert geom.size[0] == pytest.approx(receiver[a, 3]) and geom.contype == 0
    torso = data.geom("receiver/torso_visual")
    facing = torso.xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(facing, [receiver[3, 3], receiver[4, 3], 0], atol=1e-6)
    np.testing.assert_allclose(torso.xpos, receiver[3, :3], atol=1e-9)
