"""Families of objects: drawn by counters, closed, named, lying as such a thing lies; shipped instances are what is drawn."""

import json
import re
import sys
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, Mesh
from rounds import each
from scipy.spatial import ConvexHull

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError, UserError
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.scene.families import kept
from r2h_batch.scene.families.draw import SHIPPED, TRAINING, draw_instance, filled_to, model_of
from r2h_batch.scene.families.family import FAMILIES, GLASS, NUMBERS, TURNS, Draw, Shape, family
from r2h_batch.scene.families.remesh import Surface, heights, without_slivers
from r2h_batch.scene.families.shapes import Parts, box
from r2h_batch.scene.objects import INSTANCE_NAMES, OBJECT_NAMES, load_objects, object_digest, turned
from r2h_batch.trials.family_objects import FIRST_SERIES, family_objects, family_splits
from r2h_batch.trials.holding.receiving import load_receiving

REPORT = json.loads((resources.files("r2h_batch.assets.families") / "report.json").read_text())
each_category = pytest.mark.parametrize("category", OBJECT_NAMES)
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@cache
def shipped(category):
    """An instance of a category, drawn here. It is not changed."""
    return draw_instance(category, SHIPPED, 1)


def test_ninety_six_instances_are_shipped_category_first():
    assert len(INSTANCE_NAMES) == 96 == len(REPORT) and list(REPORT) == list(INSTANCE_NAMES)
    assert list(FAMILIES) == list(OBJECT_NAMES)


@each_category
def test_a_shipped_instance_is_one_closed_solid_with_named_parts_and_its_region(category):
    for model in each(load_objects([n for n in INSTANCE_NAMES if n.rpartition("_")[0] == category])):
        family, line = FAMILIES[category], REPORT[model.name]
        assert object_digest(model) == line["digest"] and model.who.key == model.name
        mesh = model.mesh
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
        assert model.part_names == family.parts and model.split == family.split
        region = {model.part_names[k] for k in np.unique(model.face_part[model.receiver_face])}
        assert region == set(family.receiver)
        assert model.words is not None and 0.005 < model.mass < 2.5
        inside = trimesh.convex.convex_hull(mesh.vertices).contains([model.com])
        assert inside.all() and (np.linalg.eigvalsh(model.inertia) > 0).all()


@each_category
def test_an_instance_is_a_function_of_category_series_and_number_alone(category):
    one = shipped(category)
    if category in ("bowl", "hammer", "trigger_sprayer"):
        again, other = draw_instance(category, SHIPPED, 1), draw_instance(category, TRAINING, 1)
        assert np.array_equal(one.vertices, again.vertices) and np.array_equal(one.faces, again.faces)
        assert one.parameters != other.parameters and other.name == f"{category}_t01"
    (stored,) = load_objects([one.name])
    assert REPORT[one.name]["parameters"] == one.parameters
    assert np.allclose(stored.mesh.extents, one.mesh.extents, atol=1e-4)
    assert stored.mass == one.mass and np.allclose(stored.com, one.com, atol=1e-7)
    assert np.allclose(stored.inertia, one.inertia, rtol=1e-6, atol=1e-9 * np.abs(one.inertia).max())


@pytest.mark.parametrize(("category", "share", "off_m"), [("bowl", 1e-3, 1e-5), ("game_controller", 0.1, 2e-3)])
def test_mass_centre_and_inertia_of_one_material_are_those_of_the_surface(category, share, off_m):
    """trimesh integrates over the union's surface. The controller's parts overlap by a fifth, which counts once in its
    mass; grips and sticks are a little too heavy beside the body for it."""
    for index in range(2):
        drawn = draw_instance(category, TRAINING, index)
        parts = Parts()
        shape = drawn.family.make(Draw(category, TRAINING, index), parts)
        (density,) = set(shape.density.values())
        mesh = trimesh.Trimesh(drawn.vertices, drawn.faces, process=False)
        assert drawn.mass == pytest.approx(density * mesh.volume, rel=1e-3)
        assert np.allclose(drawn.com, mesh.center_mass, atol=off_m)
        off = np.abs(density * mesh.moment_inertia - drawn.inertia).max()
        assert off < share * np.abs(drawn.inertia).max()


@each_category
def test_an_instance_rests_on_a_side_over_which_its_centre_of_mass_stands(category):
    drawn = shipped(category)
    low = drawn.vertices[:, 2].min()
    corners = drawn.vertices[drawn.vertices[:, 2] < low + 2e-5][:, :2]
    assert len(corners) >= 3
    weights = corners[ConvexHull(corners).vertices]  # the support's outline
    edge = np.roll(weights, -1, 0) - weights
    to_com = drawn.com[:2] - weights
    side = edge[:, 0] * to_com[:, 1] - edge[:, 1] * to_com[:, 0]
    assert (side > -1e-7).all() or (side < 1e-7).all()


def test_a_turned_object_keeps_its_grasps_and_receiving_hands_in_its_own_frame():
    (hammer,) = load_objects(["hammer"])
    other = turned(hammer, HALF_TURN)
    (own,), (new,) = candidates_of((hammer,)), candidates_of((other,))
    assert np.allclose(new.T_obj_ee[:, :3], HALF_TURN @ own.T_obj_ee[:, :3], atol=1e-6)
    a, b = load_receiving([hammer]), load_receiving([other])
    assert np.allclose(b.T_obj_hand.numpy()[:, :3], HALF_TURN @ a.T_obj_hand.numpy()[:, :3], atol=1e-6)
    assert other.who.key is None and object_digest(other) != object_digest(hammer)


def test_new_instances_are_drawn_by_what_the_flag_says():
    first, second = family_objects("families:knife,cup x 2 seed 7"), family_objects("families:cup x 1 seed 7")
    assert [o.name for o in first] == ["knife_s1007_00", "knife_s1007_01", "cup_s1007_00", "cup_s1007_01"]
    assert object_digest(first[2]) == object_digest(second[0])
    drawn = draw_instance("cup", FIRST_SERIES + 7, 0)
    assert np.array_equal(second[0].com, drawn.com) and np.array_equal(second[0].inertia, drawn.inertia)
    assert second[0].mass == drawn.mass and second[0].words is not None
    assert family_splits("families:knife,cup x 2") == {"S0", "S1"} and family_splits("families:cup") == {"S0"}


def test_an_instance_is_drawn_once_and_then_read_from_disk_with_all_that_it_had(tmp_path, monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path))
    times, (cup, bowl, bottle) = [], (FAMILIES[c] for c in ("cup", "bowl", "bottle"))
    monkeypatch.setattr(kept, "draw_instance", lambda *a, **k: times.append(a) or draw_instance(*a, **k))
    drawn = model_of(draw_instance("cup", 1005, 2))
    for _ in each(range(2)):
        found = kept.kept_instance(cup, 1005, 2)
        assert object_digest(found) == object_digest(drawn) and found.category == "cup" and found.repair == drawn.repair
    others = [(cup, 1005, 3), (cup, 1006, 2), (bowl, 1005, 2)]
    digests = {object_digest(kept.kept_instance(*other)) for other in others}
    assert times == [(cup, 1005, 2), *others] and len(digests - {object_digest(drawn)}) == 3
    standing = kept.kept_instance(bottle, 1005, 2, standing=True)
    assert not np.array_equal(standing.com, kept.kept_instance(bottle, 1005, 2).com)


def test_an_instance_of_a_family_of_other_code_is_drawn_each_time(tmp_path, monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path))
    cup = FAMILIES["cup"]

    def make(draw, parts):
        return cup.make(draw, parts)

    assert kept.kept_instance(replace(cup, make=make), 1005, 2).category == "cup" and not list(tmp_path.rglob("*.npz"))


def test_no_shipped_instance_has_a_sliver():
    """Slivers as trimesh has them: a triangle whose box along its longest side is lower than 10 nm."""
    for model in each(load_objects(INSTANCE_NAMES)):
        assert model.mesh.nondegenerate_faces(height=1e-8).all(), model.name


def test_slivers_go_without_a_change_of_the_solid():
    """A needle at a corner of a cube, and a cap: a face divided at a point of its own longest side."""
    cube = trimesh.creation.box((10.0, 10.0, 10.0))
    vertices, faces = np.array(cube.vertices), np.array(cube.faces)
    corner = vertices[faces[0]]
    first = int(np.linalg.norm(corner - np.roll(corner, -1, 0), axis=1).argmax())
    a, b, c = np.roll(faces[0], -first)
    m = len(vertices)
    faces = np.concatenate([[(a, m, c), (m, b, c), (a, b, m)], faces[1:]])
    label = np.concatenate([cube.face_normals[[0, 0, 0]], cube.face_normals[1:]])[:, 2] > 0.5
    surface = Surface(np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]]), faces, label.astype(np.int64))
    p, q = next(e for e in surface.edges() if m not in e and surface.length(*e) == 10.0)
    surface.split(p, q, tuple(np.array(surface.v[p]) + 1e-6 * (np.array(surface.v[q]) - np.array(surface.v[p]))))
    dirty, found, _ = surface.arrays()
    assert (heights(dirty, found) < 1e-4).sum() == 3
    without_slivers(surface, 1e-4, 0.01)
    clean, left, names = surface.arrays()
    mesh = trimesh.Trimesh(clean, left, process=False)
    assert heights(clean, left).min() > 1e-4 and mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(1000.0, rel=1e-5)
    assert mesh.area_faces[names == 1].sum() == pytest.approx(100.0, rel=1e-5)


def test_a_paper_cup_weighs_what_its_board_weighs():
    """Board of double-walled cups has 0.4 to 0.5 kg/m^2; the cup's outer surface is a frustum with a floor."""
    seen = 0
    for model in load_objects([name for name in INSTANCE_NAMES if name.startswith("cup_")]):
        parameters = REPORT[model.name]["parameters"]
        if parameters["kind"] != "paper cup":
            continue
        seen += 1
        top, low, high = parameters["radius"], parameters["radius"] * parameters["taper"], parameters["height"]
        outside = 1e-6 * np.pi * ((top + low) * np.hypot(high, top - low) + low**2)
        assert 0.4 * outside < model.mass < 0.55 * outside and 0.008 < model.mass < 0.015
    assert seen == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("families:cupp", "did you mean cup?; there are game_controller, bowl,"),
        ("families:mug x 3", "'mug', did you mean cup?"),
        ("families:cup_07", "CATEGORY is * or of game_controller"),
        ("families:", "no family is called ''; there are"),
        ("families:cup y 3", "'families:cup y 3' names no families; write families:CATEGORY"),
        ("families:cup,cup", "stands twice"),
        ("families:cup x 0", "x 0 of one family is 0 objects; at most 1,000 are allowed, so write x 1 to x 1000"),
        ("families:* x 100", "x 100 of 16 families is 1,600 objects; at most 1,000 are allowed, so write x 1 to x 62"),
        ("families:cup x 2 seed 99999999999", "the seed is 99999999999; it must be below 2^31"),
    ],
)
def test_what_names_no_family_or_too_many_is_refused_in_one_line(text, said):
    with pytest.raises(FileError, match=re.escape(said)) as caught:
        family_objects(text)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("--objects: ")


def test_ls_refuses_a_second_word_that_it_would_not_read(capsys):
    assert main(["ls", "families", "cup"]) == 2
    assert "takes nothing more, and 'cup' is given" in capsys.readouterr().err


@pytest.mark.parametrize("category", ["bottle", "trigger_sprayer"])
def test_standing_fillings_lie_at_the_bottom_and_weigh_as_much(category):
    """The mass is nearly the same: parts overlap a little."""
    for index in range(3):
        smeared, standing = (draw_instance(category, 1000, index, standing=s) for s in (False, True))
        share = smeared.parameters["filled"]
        assert smeared.parameters["filled"] == standing.parameters["filled"]
        assert standing.mass == pytest.approx(smeared.mass, rel=2e-3)
        heights = []
        for one in (smeared, standing):
            up = np.zeros(3)
            names = np.array(one.family.parts)[one.face_part]
            top, bottom = ("cap", "base") if category == "bottle" else ("nozzle", "bottle")
            middles = one.mesh.triangles_center
            up = middles[names == top].mean(0) - middles[names == bottom].mean(0)
            corner = one.vertices @ (up / np.linalg.norm(up))
            heights.append(float(one.com @ (up / np.linalg.norm(up))) - corner.min())
        assert heights[1] < heights[0] - (1 - share) * 0.02


def test_a_cylinder_that_is_partly_full_has_its_water_below():
    tall = Manifold.cylinder(200, 30, circular_segments=64)
    for share in (0.05, 0.3, 1.0):
        water = filled_to(tall, share)
        assert water.volume() == pytest.approx(share * tall.volume(), rel=1e-6)
        low, high = water.bounding_box()[2], water.bounding_box()[5]
        assert low == pytest.approx(0, abs=1e-6) and high == pytest.approx(200 * share, rel=1e-5)


def test_the_command_lines_word_standing_moves_the_centre_of_mass_of_bottles_alone():
    for category, moved in (("bottle", True), ("hammer", False)):
        (smeared,), (standing,) = (family_objects(f"families:{category} x 1 seed 3{w}") for w in ("", " standing"))
        assert (np.abs(smeared.com - standing.com).max() > 0.005) == moved
        assert standing.mass == pytest.approx(smeared.mass, rel=2e-3)


DEFAULTS = {"split": "S0", "parts": ("body",), "rests": ("upright",), "listed": False}


def family_of(make, category="vase", **given):
    return family(category, **{**DEFAULTS, **given})(make)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"rests": ("uprigt",)},
            "family vase: rests has 'uprigt', did you mean upright?; the words are upright, over, left,",
        ),
        ({"rests": ()}, "family vase: rests has ''; the words are upright"),
        ({"rests": "upright"}, "family vase: rests is 'upright'; it must be a tuple of words, as rests=(\"upright\",)"),
        ({"parts": ["body"]}, "family vase: parts is ['body']; it must be a tuple of words"),
        ({"split": "S1", "receiver": ("foot",)}, "family vase: no part 'foot'; parts are body"),
        ({"split": "S1"}, "family vase: split is 'S1' with receiver ()"),
        ({"category": "Vase"}, "family 'Vase': a category is small letters"),
    ],
)
def test_wrong_words_of_a_family_are_one_line(given, said):
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        family_of(lambda draw, part: None, **given)
    assert "\n" not in str(caught.value)


BODY, BESIDE = (box(60, 40, 100, at=(dx, dy, 0)) for dx, dy in ((0, 0), (60, 40)))
DENSE = {"body": 1000.0}
CUBE = Mesh(
    np.array([[x, y, z] for x in (0, 50) for y in (0, 50) for z in (0, 50)], np.float32),
    np.array([[0, 1, 2], [1, 3, 2], [4, 6, 5]], np.uint32),
)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda d, p: Shape(p("body", BODY.scale((1e-3,) * 3)), DENSE),
            "side of its solid is 0.1 mm; sizes are millimetres",
        ),
        (
            lambda d, p: Shape(p("body", BODY.scale((30.0,) * 3)), DENSE),
            "side of its solid is 3e+03 mm; sizes are millim",
        ),
        (lambda d, p: Shape(p("body", BODY), {}), "Shape.density has no part 'body'; parts with a solid are body"),
        (
            lambda d, p: Shape(p("body", BODY), {"body": -1.0}),
            "Shape.density of body is -1.0; more than 0 and at most 25000",
        ),
        (lambda d, p: Shape(p("body", BODY), {"body": np.nan}), "Shape.density of body is nan; more than 0"),
        (lambda d, p: Shape(p("body", BODY), {"body": "heavy"}), "Shape.density of body is heavy; more than 0"),
        (lambda d, p: Shape(p("body", BODY), 1000.0), "Shape.density is float 1000.0; it must be a dict"),
        (lambda d, p: Shape(p("bdy", BODY), {"bdy": 1.0}), "its generator names a part 'bdy'; parts are body"),
        (
            lambda d, p: Shape(p.divided("body", BODY, ("top", (0, 0, 1), 9)), DENSE),
            "names a part 'top'; parts are body",
        ),
        (lambda d, p: Shape(p("body", BODY) + BESIDE, DENSE), "some of its surface belongs to no part"),
        (
            lambda d, p: Shape(p("body", BODY), DENSE, ("bdy", 0.4)),
            "filling names a part 'bdy'; parts with a solid are body",
        ),
        (
            lambda d, p: Shape(p("body", BODY), DENSE, ("body", 40)),
            "filling has a share of 40; more than 0 and at most 1",
        ),
        (lambda d, p: Shape(p("body", BODY), DENSE, 0.4), "filling is float 0.4; it must be (part, share)"),
        (lambda d, p: Shape(p("body", BODY) - BODY, DENSE), "nothing is left of its solid"),
        (
            lambda d, p: Shape(p("body", Manifold(CUBE)), DENSE),
            "its solid is no closed surface (manifold3d: NotManifold)",
        ),
        (lambda d, p: Shape(BODY.to_mesh(), DENSE), "it must be a manifold3d.Manifold"),
        (lambda d, p: p("body", BODY), "it must be Shape(solid, density)"),
        (lambda d, p: {}["h"], "its generator: KeyError: 'h' ("),
        (lambda d, p: sys.exit(0), "its generator: SystemExit: 0 ("),
        (lambda d, p: [d(str(k), 0, 1) for k in range(80)], "takes more than 64 numbers; draw fewer"),
        (
            lambda d, p: Shape(p("body", BODY + BESIDE), DENSE),
            "its mesh is not watertight: parts that touch along an edge",
        ),
        (
            lambda d, p: Shape(p("body", BODY + BESIDE.translate((9, 0, 0))), DENSE),
            "its mesh is 2 bodies that do not touch",
        ),
    ],
)
def test_what_a_generator_answers_wrongly_is_one_line_that_names_the_family(make, said):
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        kept.kept_instance(family_of(make), FIRST_SERIES, 2)
    text = str(caught.value)
    assert text.startswith("family vase, instance ") and "\n" not in text
    assert "vase_s1000_02" in text or "instance 2 of series 1000" in text


def test_a_region_of_none_or_all_of_the_surface_names_the_family():
    asked = {"split": "S1", "parts": ("body", "foot"), "receiver": ("foot",)}
    for part, share in each([("body", "nothing"), ("foot", "all")]):
        made = family_of(lambda d, p, part=part: Shape(p(part, BODY), {part: 900.0}), **asked)
        with pytest.raises(
            UserError, match=f"family vase, instance vase_s1000_00: {share} of its surface is of the receiver's"
        ):
            kept.kept_instance(made, FIRST_SERIES, 0)


def test_parts_that_overlap_are_one_closed_body():
    solid = BODY + BESIDE.translate((-9, -9, 0))
    found = kept.kept_instance(family_of(lambda d, p: Shape(p("body", solid), DENSE)), FIRST_SERIES, 0)
    assert found.mesh.is_watertight and found.mass == pytest.approx(1e-6 * solid.volume(), rel=1e-3)


def test_the_family_on_the_page_is_drawn(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "benchmark.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    code = code.replace('take="foot")', 'take="foot", listed=False)')  # other tests count the families
    (file := tmp_path / "vases.py").write_text(code)
    first, second = family_objects(f"families:{file}:VASE x 2 seed 7")
    for model in each([first, second]):
        assert model.split == "S1" and model.mesh.is_watertight and 0.05 < model.mesh.extents.max() < 0.2
        assert {model.part_names[k] for k in np.unique(model.face_part[model.receiver_face])} == {"foot"}
        assert model.mass == pytest.approx(GLASS * model.mesh.volume, rel=1e-2)
    assert first.mass != second.mass
    told = page.partition("## Your own family")[2].partition("## The contact")[0]
    assert all(f"`{word}`" in told for word in TURNS) and f"{NUMBERS} numbers" in told
