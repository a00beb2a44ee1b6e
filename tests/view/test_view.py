"""The viewer, pages, films, strips and captions: bodies are drawn where MuJoCo has them, and a page needs no server."""

import base64
import re
import socket
import subprocess
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from needs import CHROMIUM, needs

from r2h_batch.__main__ import main
from r2h_batch.runs.files import RunError
from r2h_batch.view.captions import as_markdown
from r2h_batch.view.drawing import Drawing, view_of
from r2h_batch.view.film import Story, write_film
from r2h_batch.view.page import Drawn, aim, write_page
from r2h_batch.view.pictures import image_at_end, images, ringed
from r2h_batch.view.stored import Reader, one_failure_of_each

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
    assert pair.distance_m < 0
    assert pair.caption.endswith(f"overlap by {-1e3 * met.stored.row['margin_plan_m']:.1f} mm or more")
    length = np.linalg.norm(pair.line[1] - pair.line[0])
    assert abs(length + pair.distance_m) < 1e-6
    far = Drawing(first(reader, plan_reason="ik_unreachable"))
    assert far.witness.kind == "unreachable" and far.witness.distance_m < -1e-3 and far.witness.geoms == ()
    for drawing, names in (
        (met, ("plan fails: every posture at the target collides", "overlap")),
        (far, ("plan fails: the arm cannot reach the target", "stays")),
    ):
        panel = as_markdown(drawing)
        assert all(name in panel for name in names) and len(re.findall(r"\| *(?:fails|passes) *\|", panel)) >= 2


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
    assert not marks(names, "/trial_0", "witness") and marks(names, "/trial_0/hand", "ball")
    assert marks(names, "/trial_0/object", "region")


def test_the_viewer_lists_what_is_filtered_and_a_folders_words_are_text_and_no_markup(reader, monkeypatch):
    from r2h_batch.view.server import Viewer

    def refused(*_):
        raise RunError("<img src=x onerror=alert(1)>")

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


@pytest.mark.alone
def test_only_its_own_page_may_connect_to_the_viewer_and_odd_messages_do_not_end_it(capfd, caplog):
    """Any page in a browser can open a websocket to this machine; its Origin says whose it is."""
    import viser
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    from r2h_batch.view.page import new_server, stop_server

    server = new_server(0)
    try:
        port = server.get_port()
        how = {"subprotocols": [f"viser-v{viser.__version__}"], "open_timeout": 10, "compression": None}
        for words in (b"", b"\0\xff\r\n\r\n"):  # a visitor that is no browser
            with socket.create_connection(("127.0.0.1", port), timeout=10) as visitor:
                visitor.sendall(words)
        for origin in (f"http://evil.example:{port}", f"http://127.0.0.1:{port + 1}", "null", None):
            with pytest.raises(InvalidStatus) as refused, connect(f"ws://127.0.0.1:{port}", origin=origin, **how):
                pass
            assert refused.value.response.status_code == 403
        for name in ("127.0.0.1", "localhost"):
            with connect(f"ws://127.0.0.1:{port}", origin=f"http://{name}:{port}", max_size=None, **how) as page:
                assert page.recv(timeout=10)
            # a list, a word, {"a": 1}, an unknown type; bytes that are no MessagePack
            for odd in (b"", b"\xc1", b"\xdd\xff\xff\xff\xff", b"\x91" * 100_000, "text", b"x" * (1 << 20), b"\x81\xa1a\x01",
                        b"\x81\xa4type\xa4Nope"):  # fmt: skip
                with connect(f"ws://127.0.0.1:{port}", origin=f"http://{name}:{port}", max_size=None, **how) as page:
                    page.recv(timeout=10)
                    page.send(odd)
                    with pytest.raises(ConnectionClosed):  # its page is told
                        while True:
                            page.recv(timeout=10)
    finally:
        stop_server(server)
    said = capfd.readouterr().err
    assert [r.message for r in caplog.records if r.exc_info] == []
    assert "Traceback" not in said and said.count("view: a page sent a broken message") == 16, said[-2000:]


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


PAPER = Path(__file__).resolve().parents[2] / "bench" / "rows" / "v1-paper-preset"
FAILURES = [  # of the published rows of preset paper, whose sampled paths meet hands now and then
    ("random", 66, "safe"), ("handover-va", 24, "safe"), ("random", 59, "stability"), ("random", 71, "stability"),
    ("fc", 4, "plan"), ("random", 34, "plan"), ("random", 2, "reach"), ("fc", 3, "affordance"),
]  # fmt: skip


def reds(image):
    """Pixels that are red."""
    r, g, b = (np.asarray(image)[..., k].astype(int) for k in range(3))
    return int(((r > 110) & (r > 2 * g) & (r > 2 * b)).sum())


@pytest.fixture(scope="module")
def published():
    return Reader(PAPER)


SECOND, COSTLY = (24, 71, 34), (66, 59, 3, 4)
"""Trials that fail by what another one fails by; and those that fail by what a leg, a word or a page of another test shows."""


@needs("gl")
@pytest.mark.parametrize(
    ("method", "trial", "outcome"),
    [
        pytest.param(
            *f, marks=[pytest.mark.slow] * (f[1] in SECOND) + [pytest.mark.whole(part="view")] * (f[1] in COSTLY)
        )
        for f in FAILURES
    ],
)
def test_every_failure_is_red_in_its_strip_and_film_and_not_covered_on_its_page(
    published, method, trial, outcome, tmp_path
):
    import imageio.v3 as imageio

    drawing = Drawing(published.trial(trial, method))
    assert drawing.stored.row["outcome"] == outcome
    shown = [reds(image) for image, _ in images(drawing, (160, 128), 3)]
    fails = [f for *_, f in drawing.moments(3)] if drawing.stored.moves else [False, True, True]
    assert all((n > 15) == f and (n < 4) != f for n, f in zip(shown, fails, strict=True)), shown
    assert reds(image_at_end(drawing, (160, 128), close=True)) > 20
    # beside the ring, what fails is red itself where a picture is large enough
    far, near = (image_at_end(drawing, (480, 384), close=close) for close in (False, True))
    assert (
        reds(near) > reds(ringed(np.full_like(near, 200), drawing.event[1], view_of([drawing], 1.25, close=True))) + 20
    )
    assert reds(far) > 60
    write_film([Story(drawing)], tmp_path / "film.gif", size=(320, 256), fps=1)
    film = imageio.imread(tmp_path / "film.gif", index=None)[..., :3]
    assert max(map(reds, film)) > 30
    # on the page nothing opaque stands between the first camera and what fails
    server = FakeServer()
    view = aim(server, [drawing])
    drawn = Drawn(server, drawing, view)
    assert drawn.marks["witness"]
    opaque = {path for path, opacity in server.meshes.items() if opacity is None}
    before = [drawing.model.geom(g).name.replace("/", "_") for g in drawing.before(view)]
    assert not [name for name in before for path in opaque if path.endswith(f"/{name}")]
    point = drawing.event[1]
    camera = view.look_at - view.distance_m * view.axes[2]
    turned = (point - camera) @ view.axes.T
    assert np.abs(turned[:2] / turned[2]).max() < 0.3  # it looks there


@needs("chromium")
@pytest.mark.slow
@pytest.mark.parametrize(("method", "trial", "outcome"), [f for f in FAILURES if f[1] in (66, 24, 59, 2, 3)])
def test_a_failure_with_a_motion_is_red_on_its_page_in_a_browser(published, method, trial, outcome, tmp_path):
    """Where a window of 900 x 600 shows the scene: left of the panel, below the browser's notice, above the player; while the
    motion rests at its end. (Of a page that stands still chromium now and then waits for a frame, without end.)"""
    import imageio.v3 as imageio

    stored = published.trial(trial, method)
    assert stored.row["outcome"] == outcome
    page, picture = write_page(stored, tmp_path / "page.html"), tmp_path / "page.png"
    assert stored.moves
    played_ms = round(1e3 * (Drawing(stored).motion()[0][-1] + 0.9))
    flags = ["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags += ["--window-size=900,600", f"--virtual-time-budget={played_ms}"]
    flags += [f"--user-data-dir={tmp_path}/profile", f"--screenshot={picture}"]
    subprocess.run([CHROMIUM, *flags, page.as_uri()], capture_output=True, timeout=300, check=True)
    scene = imageio.imread(picture)[160:555, :565, :3]
    assert (scene < 250).mean() > 0.2, "the browser drew no scene"
    assert reds(scene) > 40


@pytest.mark.whole(part="view")
def test_one_failure_of_each_kind_is_written_or_listed(run, reader, tmp_path, capsys):
    from r2h_batch.view.server import Viewer

    rows = reader.rows("random").to_pylist()
    kinds = one_failure_of_each(rows)
    assert len(kinds) >= 3 and {"reach", "affordance"} <= kinds.keys() and any(k.startswith("plan-") for k in kinds)
    for kind, trial in kinds.items():
        row = next(r for r in rows if r["trial_id"] == trial)
        before = [r for r in rows if r["outcome"] == row["outcome"] and r["plan_reason"] == row["plan_reason"]]
        assert kind.startswith(row["outcome"]) and trial == min(r["trial_id"] for r in before)
    line = ["view", str(run), "--method", "random", "--one-of-each"]
    assert main([*line, "--html", str(tmp_path / "page.html")]) == 0
    assert {f.name for f in tmp_path.iterdir()} == {f"page-{kind}.html" for kind in kinds}
    viewer = Viewer(reader, ["random"], only=list(kinds.values()))
    try:
        assert set(viewer.listed.values()) == set(kinds.values())
    finally:
        viewer.stop()
    capsys.readouterr()
    assert main([*line, "--trial", "3"]) == 2 and "leave out --trial" in capsys.readouterr().err
    assert main(["view", str(run), "--method", "oracle", "--one-of-each", "--html", str(tmp_path / "x.html")]) == 2
    assert "no trial of 'oracle' failed" in capsys.readouterr().err


class FakeServer:
    """Stands for viser's server and scene: remembers the opacity of each mesh."""

    def __init__(self):
        self.meshes, self.scene = {}, self
        self.initial_camera = SimpleNamespace()

    def __getattr__(self, name):
        if not name.startswith("add_"):
            raise AttributeError(name)

        def add(path, *_, opacity=None, **__):
            if name == "add_mesh_simple" and "_mark_" not in path:
                self.meshes[path] = opacity
            return SimpleNamespace()

        return add


@pytest.mark.whole(part="view")
@needs("gl")
def test_a_strip_of_s1_draws_region_and_ball_and_the_camera_is_never_behind_the_receiver(published):
    for method, trial in (("fc", 3), ("random", 59), ("fc", 67)):
        drawing = Drawing(published.trial(trial, method))
        image, _ = images(drawing, (320, 256), 2)[0]  # the whole person is in it: a toothbrush is some pixels
        r, g, b = (image[..., k].astype(int) for k in range(3))
        assert int(((r > 140) & (b < 90) & (g > 70) & (g < r)).sum()) > 6, trial  # orange: the region
        assert int(((g > r + 12) & (g > b + 12)).sum()) > 120, trial  # green: the ball
    for method, trial, _ in [f for f in FAILURES if f[1] not in SECOND]:
        drawing = Drawing(published.trial(trial, method))
        for view in (view_of([drawing], 1.2), view_of([drawing], 1.2, close=True)):
            facing = drawing.stored.receiver[3:5, 3]
            assert view.axes[2, :2] @ facing / np.linalg.norm(view.axes[2, :2]) < 0.51


def test_a_picture_of_what_cameras_see_has_a_row_for_each_camera(run, tmp_path, capsys):
    from PIL import Image

    def drawn(file, *more):
        return main(["view", str(run), "--trial", "4", "--sees", str(tmp_path / file), *more])

    rig = tmp_path / "one.toml"
    rig.write_text(
        'name = "one"\n[[cameras]]\nname = "post"\nposition = [-0.1, 0.75, 0.8]\ntarget = [0.42, -0.02, 0.15]\n'
    )
    assert drawn("two.png") == 0 and drawn("one.png", "--rig", str(rig)) == 0
    two, one = (np.asarray(Image.open(tmp_path / f"{name}.png").convert("RGB")) for name in ("two", "one"))
    assert two.shape[0] > 1.5 * one.shape[0] and two.shape[1] == one.shape[1]
    assert drawn("exact.png", "--noise", "0") == 0
    exact = np.asarray(Image.open(tmp_path / "exact.png").convert("RGB"))
    white = [(image.min(2) > 250).mean() for image in (two, exact)]
    assert white[0] > white[1] + 0.001  # lost pixels are not drawn
    blue = np.abs(two.astype(int) - (0x2A, 0x70, 0xB2)).sum(2) < 12  # the object, in both windows and in the cloud
    assert blue[: len(blue) // 2].sum() > 200 and blue[len(blue) // 2 :].sum() > 200
    capsys.readouterr()
    for words, line in (
        (["--trial", "4"], "--rig names the cameras of --sees"),
        (["--sees", str(tmp_path / "x.png")], "--sees needs --trial ID"),
        (["--trial", "100000", "--sees", str(tmp_path / "x.png")], "--trial is 100000"),
        (["--trial", "4", "--sees", str(tmp_path / "x.png"), "--rig", "cell"], "did you mean cell-v1"),
        (["--trial", "4", "--noise", "2"], "--noise and --labels are errors of --sees"),
        (["--trial", "4", "--sees", str(tmp_path / "x.png"), "--noise", "-1"], "--noise is -1; it must be 0 to 5"),
    ):
        more = ["--rig", "mine.toml"] if "names" in line else []
        assert main(["view", str(run), *words, *more]) == 2
        error = capsys.readouterr().err
        assert line in error and error.count("\n") == 1
