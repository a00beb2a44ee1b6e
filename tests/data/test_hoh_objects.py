"""HOH's objects in files as their owners' code reads them: both forms of a handover give the same region."""

import csv
import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from r2h_batch.__main__ import main
from r2h_batch.data.hoh_objects import collect, meshes
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.protocols.edit import edited

CAPTURE = "01638-46157-S1"
SESSION = f"{CAPTURE}/reference/{CAPTURE}.json"
STEPS = f"{CAPTURE}/3dModelAlignments/{CAPTURE}_1_transformations.json"
RANDOM = np.random.default_rng(4)
ENDS = (-100.0, -96.0, 100.0)
"""Where three receivers take hold of the bar: x, mm."""


def pose(mm):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(mm[0])).as_matrix()
    T[:3, 3] = mm
    return T


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def cloud(path, points):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.PointCloud(points).export(path)


@pytest.fixture
def hoh(tmp_path):
    """A bar of 200 mm with three receivers, two of whom take its end at -x, in HOH's form; a ball that nobody takes."""
    root = tmp_path / "hoh"
    models = root / "HOH_Objects" / "simplified"
    models.mkdir(parents=True)
    bar = trimesh.creation.box((200.0, 24.0, 24.0)).subdivide().subdivide().subdivide()
    bar.export(models / "318_simplified.obj")
    trimesh.creation.icosphere(radius=40.0).export(models / "7_simplified.obj")
    keyframes, objects = [], []
    for i, end in enumerate(ENDS):
        hand = np.array([end, 0.0, 0.0]) + RANDOM.uniform(-16, 16, (4000, 3))  # mm, in the object's frame
        steps = {
            "3dm_to_O": pose((30 + i, 400, 900)),
            "4_9": pose((60, -20, 5)),
            "9_10": pose((1, 2, -3)),
            "10_11": pose((2, 0, 1)),
        }
        T = steps["10_11"] @ steps["9_10"] @ steps["4_9"] @ steps["3dm_to_O"]
        cloud(root / CAPTURE / "PCFiltered" / str(i) / "receiver_frame11.ply", moved(T, hand))
        file = root / CAPTURE / "3dModelAlignments" / f"{CAPTURE}_{i}_transformations.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps({k: v.tolist() for k, v in steps.items()}))
        keyframes.append({"o_frame_index": 4, "g_frame_index": 9, "t_frame_index": 11})
        objects.append("318")
    data = {"objects_used": objects, "keyframes": keyframes, "giver_receiver_comfort_ratings": [[5, 4], [4, 4], [3, 2]]}
    (root / CAPTURE / "reference").mkdir()
    (root / CAPTURE / "reference" / f"{CAPTURE}.json").write_text(json.dumps({**data, "left_seated_giver": False}))
    return root


def imported(folder, out, *more):
    return main(["import", "objects", str(folder), "--from", "hoh", "--out", str(out), *map(str, more)])


def test_the_region_is_where_most_receivers_took_hold(hoh, tmp_path, capsys):
    assert imported(hoh, tmp_path / "mine") == 0
    assert "2 objects of hoh (1 with a receiver's region)" in capsys.readouterr().out
    found = {o.name: o for o in edited(BenchmarkChoice(objects=str(tmp_path / "mine"))).objects}
    bar = found["hoh_318"]
    assert bar.mesh.extents == pytest.approx([0.2, 0.024, 0.024], abs=1e-6) and bar.split == "S1"
    x = bar.mesh.triangles_center[:, 0]
    assert bar.receiver_face[x < -0.09].all() and not bar.receiver_face[x > -0.05].any()
    assert found["hoh_7"].split == "S0"
    share = np.load(tmp_path / "mine" / "meshes" / "hoh_318_taken.npy")
    assert share[x < -0.095] == pytest.approx(2 / 3) and share[x > 0.095] == pytest.approx(1 / 3)
    with (tmp_path / "mine" / "comfort.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["object"], r["giver"], r["receiver"]) for r in rows] == [("hoh_318", *p) for p in ("54", "44", "32")]


def scene(scenes, number, end):
    """A handover of the bar as HOH-Grasps has it: metres, the receiver's hand at x = end (mm)."""
    name = f"{CAPTURE}_{number}_318"
    T = pose((7 + number, 0, 0))
    T[:3, 3] *= 0.001
    hand = 0.001 * (np.array([end, 0.0, 0.0]) + RANDOM.uniform(-16, 16, (4000, 3)))
    cloud(scenes / name / f"{name}_hand_receiver_t.ply", moved(T, hand))
    (scenes / name / f"{name}_transforms.json").write_text(json.dumps({"obj_to_t": T.tolist()}))


def test_a_handover_that_is_in_hoh_and_in_hoh_grasps_counts_once(hoh):
    """Only one of three is in both: counted twice, it would take a share from the others."""
    alone = collect(hoh, ["318"]).shares["hoh_318"]
    scene(hoh / "scenes", 2, ENDS[2])
    both = collect(hoh, ["318"])
    assert len(both.handovers) == len({(h.capture, h.number) for h in both.handovers}) == 3
    assert all(h.comfort is not None for h in both.handovers)  # HOH's ratings stay
    assert set(alone.round(6)) == {0.0, round(1 / 3, 6), round(2 / 3, 6)}
    assert (alone == both.shares["hoh_318"]).mean() > 0.99


def test_the_simplified_mesh_is_taken_where_there_is_a_full_one_too(hoh):
    full = hoh / "HOH_Objects" / "full"
    full.mkdir()
    for name in ("318", "9"):
        trimesh.creation.box((400.0, 24.0, 24.0)).export(full / f"{name}_cleaned.obj")
    assert {name: path.name for name, path in meshes(hoh).items()} == {
        "318": "318_simplified.obj",
        "7": "7_simplified.obj",
        "9": "9_cleaned.obj",
    }


def test_scenes_of_hoh_grasps_give_the_same_region_in_metres(hoh, tmp_path, capsys):
    assert imported(hoh, tmp_path / "a", "--only", "318") == 0
    scenes = tmp_path / "grasps" / "scenes"
    for i, end in enumerate(ENDS):
        scene(scenes, i, end)
    both = tmp_path / "both"
    both.mkdir()
    (hoh / "HOH_Objects").rename(both / "HOH_Objects")
    scenes.rename(both / "scenes")
    assert imported(both, tmp_path / "b", "--only", "hoh_318") == 0
    capsys.readouterr()
    a, b = (np.load(tmp_path / k / "meshes" / "hoh_318_parts.npy") for k in "ab")
    assert (a == b).mean() > 0.99 and 0.02 < a.mean() < 0.3


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        (SESSION, lambda d: {**d, "keyframes": []}, "a list each of one length"),
        (STEPS, lambda d: {**d, "4_9": np.ones((4, 4)).tolist()}, "4_9 is no rigid pose"),
        (STEPS, lambda d: {k: d[k] for k in ("3dm_to_O", "4_9")}, "9_10 is missing"),
    ],
)  # fmt: skip
def test_what_is_not_as_it_should_be_is_named_and_skipped_or_refused(hoh, tmp_path, capsys, file, change, said):
    path = hoh / file
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    assert imported(hoh, tmp_path / "mine") == 0
    assert said in capsys.readouterr().err
    assert imported(hoh, tmp_path / "again", "--strict") == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_a_folder_without_models_or_with_another_name_is_refused_in_one_line(hoh, tmp_path, capsys):
    assert imported(hoh / CAPTURE, tmp_path / "mine") == 2
    assert "no HOH_Objects/simplified" in capsys.readouterr().err
    assert imported(hoh, tmp_path / "mine", "--only", "9") == 2
    assert "there are 318, 7" in capsys.readouterr().err
