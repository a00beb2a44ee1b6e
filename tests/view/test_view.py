"""The viewer, pages, films, strips and captions: bodies are drawn where MuJoCo has them, and a page needs no server."""

import base64
import contextlib
import json
import re
import subprocess
from dataclasses import replace
from io import BytesIO

import mujoco
import numpy as np
import pytest
from needs import CHROMIUM, needs

from r2h_batch.__main__ import main
from r2h_batch.export.captions import as_markdown
from r2h_batch.export.drawing import Drawing
from r2h_batch.export.episode import episode_of
from r2h_batch.export.stored import ExportError, Reader
from r2h_batch.view.server import ANY, Filter

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


def marks(names, parent, group):
    """Names of the marks of a group that stand in a frame."""
    return [name for name in names if str(name).startswith(f"{parent}/{group}_mark_")]


@pytest.mark.check
def test_filters_choose_and_sort_rows():
    rows = [
        {"trial_id": k, "object": o, "outcome": c, "plan_reason": r, "margin_plan_m": m}
        for k, o, c, r, m in (
            (0, "cup", "success", "ok", 0.02), (1, "bowl", "plan", "ik_unreachable", None), (2, "cup", "safe", "ok", 0.001)
        )
    ]  # fmt: skip
    for words, order, below_mm, ids in (
        ({}, "trial", np.inf, [0, 1, 2]),
        ({"object": ANY, "outcome": ANY}, "trial", np.inf, [0, 1, 2]),
        ({"object": "cup", "outcome": "safe"}, "trial", np.inf, [2]),
        ({"plan_reason": "ik_unreachable"}, "trial", np.inf, [1]),
        ({}, "margin of plan", np.inf, [2, 0]),
        ({}, "margin of plan", 5.0, [2]),
    ):
        assert [row["trial_id"] for row in Filter(words, order, below_mm).chosen(rows)] == ids


def test_a_failed_plan_is_shown_with_what_speaks_against_it(reader):
    met = Drawing(first(reader, plan_reason="ik_in_collision"))
    pair = met.witness
    assert pair.distance_m < 0 and "overlap by" in pair.caption
    rows = [r for r in reader.rows("random").to_pylist() if r["plan_reason"] == "ik_in_collision"]
    shown = [Drawing(reader.trial(r["trial_id"], "random")).witness for r in rows[:2]]
    assert all(w.distance_m < 0 for w in shown)
    assert any(w.kind == r["plan_pair"] for w, r in zip(shown, rows))
    length = np.linalg.norm(pair.line[1] - pair.line[0])
    assert abs(length + pair.distance_m) < 1e-6
    far = Drawing(first(reader, plan_reason="ik_unreachable"))
    assert far.witness.kind == "unreachable" and far.witness.distance_m < -1e-3 and far.witness.geoms == ()
    for drawing, names in (
        (met, ("plan fails: every posture at the target collides", "overlap")),
        (far, ("plan fails: the arm cannot reach the target", "stays")),
    ):
        panel = as_markdown(drawing)
        assert all(name in panel for name in names) and panel.count("| fails |") + panel.count("| passes |") >= 2


def test_a_failed_reach_shows_the_gap_and_a_failed_affordance_the_part_on_the_region(reader):
    for outcome in ("reach", "affordance"):
        drawing = Drawing(first(reader, outcome=outcome))
        witness, row = drawing.witness, drawing.stored.row
        if outcome == "reach":
            assert abs(witness.distance_m + row["margin_reach_m"]) < 1e-4
        else:
            assert witness.geoms[0].startswith("gripper/") and witness.geoms[1] == "object/region_visual"
        assert [m.text for m in drawing.marks if m.text] == [witness.caption]
        assert drawing.moments(3)[-1][2] and not drawing.moments(3)[0][2]


def test_a_surface_stands_where_mujoco_has_the_geom(reader):
    drawing = Drawing(reader.trial(1, "oracle"))
    data = drawing.at(drawing.stored.target_q)
    for name in ("object/mesh_visual", "robot/upper_arm_visual", "table/top", "gripper/left_pad"):
        g = drawing.model.geom(name).id
        vertices, body = drawing.surface(g).vertices, int(drawing.model.geom_bodyid[g])
        drawn = vertices @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        local = (drawn - data.geom_xpos[g]) @ data.geom_xmat[g].reshape(3, 3)
        middle = (local.max(0) + local.min(0)) / 2
        assert np.abs(middle - drawing.model.geom_aabb[g][:3]).max() < 2.5e-3, name


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
    assert {"/trial_0/hand/hand_mesh_visual", "/trial_0/object/object_mesh_visual"} <= names
    assert not marks(names, "/trial_0", "witness") and marks(names, "/trial_0", "ball")
    assert marks(names, "/trial_0/object", "region")


def raised(error):
    raise error


def test_the_viewer_lists_filters_steps_and_shows(reader, monkeypatch):
    from r2h_batch.view import server
    from r2h_batch.view.server import NO_METHOD, Viewer

    viewer = Viewer(reader, ["random", "oracle"], trial=4)
    try:
        assert viewer.listed[viewer.list.value] == 4 and len(viewer.drawn) == 2 and viewer.beside.value == "oracle"
        viewer.beside.value = NO_METHOD
        viewer.filters["outcome"].value = "plan"
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
        with monkeypatch.context() as patch:  # what a folder says is text, not markup
            patch.setattr(viewer.reader, "trial", lambda *_: raised(ExportError("<img src=x onerror=alert(1)>")))
            viewer._show()
            assert "\\<img" in viewer.words.content and not viewer.drawn
        viewer.method.value, viewer.filters["outcome"].value = "oracle", ANY
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


def test_only_its_own_page_may_connect_to_the_viewer_and_odd_messages_do_not_end_it():
    """Any page in a browser can open a websocket to this machine; its Origin says whose it is."""
    import viser
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    from r2h_batch.view.page import new_server, stop_server

    server = new_server(0)
    try:
        port = server.get_port()
        how = {"subprotocols": [f"viser-v{viser.__version__}"], "open_timeout": 10, "compression": None}
        for origin in (
            "http://evil.example",
            f"http://evil.example:{port}",
            f"http://127.0.0.1:{port + 1}",
            "null",
            None,
        ):
            with pytest.raises(InvalidStatus) as refused, connect(f"ws://127.0.0.1:{port}", origin=origin, **how):
                pass
            assert refused.value.response.status_code == 403
        for name in ("127.0.0.1", "localhost"):
            with connect(f"ws://127.0.0.1:{port}", origin=f"http://{name}:{port}", max_size=None, **how) as page:
                assert page.recv(timeout=10)
                for odd in (b"", b"\xc1", b"\xdd\xff\xff\xff\xff", b"\x91" * 100_000, "text", b"x" * (1 << 20)):
                    with contextlib.suppress(ConnectionClosed):
                        page.send(odd)
    finally:
        stop_server(server)


@needs("gl")
def test_a_film_and_strips_show_the_motion(run, reader, tmp_path):
    import imageio.v3 as imageio

    small, film = ["--size", "96", "64"], tmp_path / "x.mp4"
    line = ["view", str(run), "--method", "oracle", "--trial", "1", "--video", str(film), "--fps", "2"]
    assert main([*line, *small]) == 0
    pictures = imageio.imread(film)
    seconds = reader.trial(1, "oracle").time_s[-1]
    assert pictures.shape[1:] == (64, 96, 3) and abs(len(pictures) / 2 - seconds) < 2.0
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 1.0
    trial, strips = str(first(reader, plan_reason="ik_in_collision").row["trial_id"]), tmp_path / "x.png"
    line = ["view", str(run), "--method", "random", "oracle", "--trial", trial, "--strips", str(strips)]
    assert main([*line, *small]) == 0
    both = imageio.imread(strips)[..., :3].astype(int)
    red = (both[..., 0] > 130) & (both[..., 1] < 60) & (both[..., 2] < 60)
    (tall, wide), legend = red.shape, 48
    near, other = red[: tall // 2, 2 * wide // 5 : 3 * wide // 5], red[tall // 2 + tall // 8 : -legend]
    assert near.any() and not other.any() and red[-legend:].any()


@needs("gl")
def test_strips_of_a_closed_loop_move_the_hand_and_its_arm(run, tmp_path, capsys):
    """Bodies at each step are where the episode has them, and the strips say how it ended."""
    file = tmp_path / "loop.png"
    line = ["view", str(run), "--method", "oracle", "--trial", "1", "--strips", str(file), "--frames", "2"]
    assert main([*line, "--receiver-motion", "moves", "--policy", "servo"]) == 0
    assert "servo, moves: " in capsys.readouterr().out and file.stat().st_size > 3000
    drawing = episode_of(Reader(run), 1, "oracle", "moves", "servo")
    _, steps = drawing.motion()
    for k in (0, len(steps) - 1):
        data = drawing.at(steps[k])
        assert np.allclose(data.body("hand").xpos, drawing._hands[k][:3, 3]) and np.allclose(data.qpos, steps[k][:6])
        if drawing._receivers is not None:
            ends = drawing._receivers[k][1:3, :3]
            assert np.allclose(data.geom("receiver/forearm_visual").xpos, ends.mean(0), atol=1e-6)
    assert np.linalg.norm(drawing._hands[-1][:3, 3] - drawing._hands[0][:3, 3]) > 0.01


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
        f"--user-data-dir={tmp_path}/profile",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    subprocess.run([CHROMIUM, *flags, page.as_uri()], capture_output=True, timeout=240, check=True)
    picture = imageio.imread(png)[..., :3].astype(int)
    spread = picture.max(-1) - picture.min(-1)
    assert (spread[:, :420] > 60).mean() > 0.002, "nothing coloured is drawn: object, hand, red bodies"
    assert json.dumps(picture.shape) == "[480, 640, 3]"


def test_a_receiver_with_a_body_is_drawn_where_the_protocol_has_it(reader):

    from r2h_batch import make_trials

    receiver = make_trials("S0", 1, protocol="r2h-v1").receiver[0].double().numpy()
    model = Drawing(replace(reader.trial(1, "oracle"), receiver=receiver)).model
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
