"""The viewer, pages, films, strips and captions: bodies are drawn where MuJoCo has them, and a page needs no server."""

import base64
import contextlib
import re
from io import BytesIO

import numpy as np
import pytest
from needs import needs

from r2h_batch.__main__ import main
from r2h_batch.view.captions import as_markdown
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.stored import ExportError, Reader

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


def test_the_viewer_lists_what_is_filtered_and_a_folders_words_are_text_and_no_markup(reader, monkeypatch):
    from r2h_batch.view.server import Viewer

    def refused(*_):
        raise ExportError("<img src=x onerror=alert(1)>")

    viewer = Viewer(reader, ["random", "oracle"], trial=4)
    try:
        assert viewer.listed[viewer.list.value] == 4 and len(viewer.drawn) == 2 and viewer.beside.value == "oracle"
        viewer.filters["outcome"].value = "plan"
        viewer._filter()  # a browser's click runs it in a thread of viser's
        assert viewer.listed and all(" plan fails" in line for line in viewer.listed)
        assert "plan fails" in viewer.words.content
        monkeypatch.setattr(viewer.reader, "trial", refused)
        viewer._show()
        assert "\\<img" in viewer.words.content and not viewer.drawn
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
        for origin in (f"http://evil.example:{port}", f"http://127.0.0.1:{port + 1}", "null", None):
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
    line = ["view", str(run), "--method", "oracle", "--trial", "1", "--video", str(film), "--fps", "1"]
    assert main([*line, *small]) == 0
    pictures = imageio.imread(film)
    seconds = reader.trial(1, "oracle").time_s[-1]
    assert pictures.shape[1:] == (64, 96, 3) and abs(len(pictures) - seconds) < 2.0
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 1.0
    trial, strips = str(first(reader, plan_reason="ik_in_collision").row["trial_id"]), tmp_path / "x.png"
    line = ["view", str(run), "--method", "random", "oracle", "--trial", trial, "--strips", str(strips)]
    assert main([*line, *small]) == 0
    both = imageio.imread(strips)[..., :3].astype(int)
    red = (both[..., 0] > 130) & (both[..., 1] < 60) & (both[..., 2] < 60)
    (tall, wide), legend = red.shape, 48
    near, other = red[: tall // 2, 2 * wide // 5 : 3 * wide // 5], red[tall // 2 + tall // 8 : -legend]
    assert near.any() and not other.any() and red[-legend:].any()
