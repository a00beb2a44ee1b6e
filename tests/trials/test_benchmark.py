"""A benchmark as a file: the built-in one comes back bit for bit, another one is another one everywhere."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.config import Thresholds
from r2h_batch.methods.part_roles import GRASP, WRAP, roles_of
from r2h_batch.scene.hand import palm_frame
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.trials.file_fields import read_benchmark_file, text_of
from r2h_batch.trials.holding.instructions import intents_of, understand
from r2h_batch.trials.yaml_file import read_benchmark
from r2h_batch.types import CollidingPair, PlanReason

pytestmark = pytest.mark.check


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A folder with a box of 4 x 5 x 12 cm, its faces labelled by height."""
    trimesh.creation.box((0.04, 0.05, 0.12)).subdivide().export(tmp_path / "brick.stl")
    labels = (trimesh.load(tmp_path / "brick.stl").triangles_center[:, 2] > 0).astype(np.int64)
    np.save(tmp_path / "parts.npy", labels)
    return tmp_path


BRICK = """
objects:
- built_in: cup
- file: brick.stl
  split: S1
  receiver: z<0.5
  mass: 0.4
  parts: parts.npy
  part_names: [low, high]
  roles: {low: wrap, high: grasp}
  words:
    names: [brick, block]
    parts: {foot: [low]}
    verbs: {hammer: foot}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "benchmark.yaml"
    path.write_text(text)
    return path


def test_the_built_in_one_is_such_a_file(tmp_path, capsys):
    assert main(["ls", "benchmark", "--yaml"]) == 0
    text = capsys.readouterr().out
    default = load_benchmark()
    assert text == text_of(default.name, default.objects, default.receiver)
    path = written(tmp_path, text)
    assert read_benchmark(path).digest == default.digest == read_benchmark(written(tmp_path, "format: 1\n")).digest
    assert main(["ls", "benchmark", str(path)]) == 0
    assert "the default benchmark" in capsys.readouterr().out
    assert main(["ls", "benchmark", "--schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert set(schema["properties"]) >= {"objects", "hand_set", "hand_model", "thresholds", "table", "home", "protocol"}
    assert set(schema["$defs"]["Thresholds"]["properties"]) == set(Thresholds.__dataclass_fields__)


def test_the_digest_has_what_a_person_is_made_of_where_the_person_counts(monkeypatch):
    digests = {name: load_benchmark(name).digest for name in ("r2h-v0", "r2h-v1", "r2h-v2", "r2h-v3")}
    assert digests["r2h-v0"].startswith("3bff8fe196d6") and digests["r2h-v1"].startswith("e9a7531f1846")
    assert digests["r2h-v3"] == "0b27b84787b9a4e422c73b90723dc62e88c8529c585e8a33740b9c54bc7dd3f6"
    assert list(load_benchmark("r2h-v2").digests_before(())) == [
        "940101feca37a37ffcc3e60468b04b7b2200d1726a77f65e91da0d871adc49b0"
    ]
    assert load_benchmark("r2h-v1").digests_before(()) == {}
    v3 = replace(load_benchmark("r2h-v3"), receiver="hand", head_clearance_m=0.0)
    # Received asks about the whole person, whatever planning sees
    received, presented = v3.digest, v3.until("present").digest
    assert all("head" in changed for changed in v3.digests_before(v3.asks).values())
    assert v3.until("present").digests_before(()) == {}
    monkeypatch.setattr("r2h_batch.trials.benchmark.MADE_OF", "other pieces\n")
    for name, digest in each(digests.items()):
        other = replace(load_benchmark(name), name="other")
        assert (other.digest == digest) == (other.receiver == "hand"), name
    v3 = replace(v3, name="other")
    assert v3.digest != received and v3.until("present").digest == presented


def test_the_digest_has_where_listed_persons_stand_where_the_person_counts():
    v1 = load_benchmark("r2h-v1")
    trials = v1.trials(1)
    receiver = trials.receiver.clone()
    receiver[:, 3, 2] += 0.05  # the torso, and the head over it
    for who in ("hand", "body"):
        listed, higher = (replace(v1, listed=t, receiver=who) for t in (trials, replace(trials, receiver=receiver)))
        assert (listed.digest == higher.digest) == (who == "hand")
        assert listed.digests_before(()) == higher.digests_before(())  # r2h_batch 0.3 left them out


def test_the_name_that_r2h_v3_had_before_it_was_frozen_says_what_to_write(tmp_path, capsys):
    with pytest.raises(FileError, match=r"^benchmark r2h-v3-draft: r2h_batch 0.3 had it, .*; write r2h-v3, which"):
        load_benchmark("r2h-v3-draft")
    with pytest.raises(FileError, match=r"benchmark.yaml: benchmark r2h-v3-draft: .*; write r2h-v3, which"):
        read_benchmark(written(tmp_path, "protocol: r2h-v3-draft\n"))
    assert main(["sweep", "--benchmark", "r2h-v3-draft", "--method", "random"]) == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if ": working, " not in x]
    assert line.endswith("write r2h-v3, which it became")


def test_a_rule_with_a_key_draws_as_the_key_says_and_is_called_by_its_name():
    v2, ids = load_benchmark("r2h-v2"), torch.arange(4)
    again = replace(v2, rule=replace(v2.rule, name="other", key="r2h-v2"))
    assert again.protocol == "other" and again.digest == v2.digest
    assert torch.equal(again.trials_with_ids(ids).T_world_hand, v2.trials_with_ids(ids).T_world_hand)
    other = replace(v2, rule=replace(v2.rule, key="other"))
    assert other.protocol == "r2h-v2" and other.digest != v2.digest
    assert not torch.equal(other.trials_with_ids(ids).T_world_hand, v2.trials_with_ids(ids).T_world_hand)


def test_what_is_kept_from_the_head_is_a_number_of_the_benchmark_where_the_person_counts(tmp_path, capsys):
    v2, v3 = load_benchmark("r2h-v2"), load_benchmark("r2h-v3")
    assert v2.head_clearance_m == 0 and v3.head_clearance_m == 0.1
    assert v2.digest == load_benchmark("r2h-v2").digest != replace(v2, head_clearance_m=0.1).digest
    for text, wanted in each(
        {
            "protocol: r2h-v2": v2,
            "protocol: r2h-v2\nhead_clearance_m: 0.1": replace(v2, head_clearance_m=0.1),
            "protocol: r2h-v3": v3,
            "protocol: r2h-v3\nhead_clearance_m: 0.0": replace(v3, head_clearance_m=0.0),
            "protocol: r2h-v3\nreceiver: hand": replace(v3, receiver="hand", head_clearance_m=0.0),
        }.items()
    ):
        assert read_benchmark(written(tmp_path, text)).digest == wanted.digest, text
    # trials and certificates are those without it
    assert v3.undrawn_digest == replace(v3, head_clearance_m=0.0).undrawn_digest
    with pytest.raises(ValueError, match=r"head_clearance_m is 0\.6; it must be a finite number from 0 to 0\.5"):
        replace(v2, head_clearance_m=0.6)
    with pytest.raises(ValueError, match=r"head_clearance_m is 0\.1 and receiver is hand, without a head; make it 0"):
        replace(load_benchmark("r2h-v1"), head_clearance_m=0.1)
    with pytest.raises(FileError, match=r"receiver is hand, without a head"):
        read_benchmark(written(tmp_path, "protocol: r2h-v1\nhead_clearance_m: 0.1"))


def test_every_number_of_a_file_makes_another_benchmark(tmp_path):
    digests = {load_benchmark("r2h-v1").digest}
    lines = [
        *(f"thresholds: {{{k}: 0.0092}}" for k in Thresholds.__dataclass_fields__),
        "table: {center: [-0.025, 0, -0.03]}",
        "table: {half: [0.475, 0.6, 0.02]}",
        "home: [-0.3, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483]",
        "objects: [{built_in: cup, mass: 0.5}]",
        "objects: [{built_in: cup, instruction: cup please}]",
        "objects: [{built_in: cup, roles: {wall: grasp}}]",
        "objects: [{built_in: cup, words: {names: [cup], parts: {wall: [wall]}}}]",
        "objects: [{built_in: hammer, split: S0}]",
    ]
    for line in lines:
        digests.add(read_benchmark(written(tmp_path, line)).digest)
    assert len(digests) == 1 + len(lines)


def test_hands_stand_where_the_benchmarks_ball_table_and_home_let_them(tmp_path):
    path = written(tmp_path, "thresholds: {reach_offset_m: 0.2}\ntable: {half: [0.475, 0.6, 0.3]}\n")
    benchmark = read_benchmark(path)
    trials = benchmark.trials(40)
    hands = benchmark.hand_set
    geometry = hands.model.pose(hands.pose, hands.shape, hands.side)
    point, normal = palm_frame(geometry.joints.double(), hands.side)
    i, T = trials.hand_index.long(), trials.T_world_hand.double()
    center = (T[:, :3, :3] @ (point + 0.2 * normal)[i][..., None])[..., 0] + T[:, :3, 3]
    reach = center[:, :2].norm(dim=1)
    assert ((reach > 0.45 - 1e-6) & (reach < 0.80 + 1e-6)).all()
    skin = torch.einsum("nij,nvj->nvi", T[:, :3, :3], geometry.vertices.double()[i]) + T[:, None, :3, 3]
    low, high = torch.tensor([-0.5, -0.6, -0.325]), torch.tensor([0.45, 0.6, 0.275])
    assert not ((skin > low) & (skin < high)).all(2).any()
    default = load_benchmark("r2h-v1").trials(40)
    assert not torch.equal(default.T_world_hand, trials.T_world_hand)
    assert torch.equal(load_benchmark("r2h-v1").trials(40).T_world_hand, default.T_world_hand)


def test_the_arm_starts_at_the_benchmarks_home_beside_its_table(tmp_path):
    home = [0.5, -1.6, 1.4, -1.3, -1.6, 1.0]
    path = written(tmp_path, f"home: {home}\nobjects: [{{built_in: cup}}]\n")
    benchmark = load_benchmark(path)
    evaluator = Evaluator(benchmark).kinematic
    trials = benchmark.trials(6, splits="S0")
    T_world_ee = torch.from_numpy(ee_pose(load_robot(), home)).float().repeat(6, 1, 1)
    T_world_ee[:, 2, 3] += 0.05
    T_obj_ee = torch.eye(4).repeat(6, 1, 1)
    scores = evaluator.score(T_obj_ee, T_world_ee, trials)
    moved = scores.path_len > 0
    assert moved.any() and torch.allclose(scores.path[moved][:, 0], torch.tensor(home), atol=1e-7)
    # among eight branches the nearest to this home, not to the default one
    assert (scores.q_goal[moved] - torch.tensor(home)).abs().max() < 0.5
    table = "table: {center: [0.4, 0, 0.6], half: [0.4, 0.4, 0.2]}"
    high = read_benchmark(written(tmp_path, f"{table}\nobjects: [{{built_in: cup}}]"))
    blocked = Evaluator(high).kinematic
    scores = blocked.score(T_obj_ee, T_world_ee, trials.named(high.objects))
    assert (scores.plan_reason == int(PlanReason.START_IN_COLLISION)).all()
    assert set(scores.plan_pair.tolist()) <= {int(p) for p in CollidingPair if "TABLE" in p.name}


def test_a_users_object_brings_parts_region_roles_words_and_mass(box):
    benchmark = read_benchmark(written(box, BRICK))
    cup, brick = benchmark.objects
    assert cup is load_objects(["cup"])[0]
    assert (brick.name, brick.split, brick.mass, brick.part_names) == ("brick", "S1", 0.4, ("low", "high"))
    assert np.array_equal(brick.face_part == 0, brick.receiver_face)
    assert roles_of(benchmark.objects)[1, :2].tolist() == [WRAP, GRASP]
    assert [i.part for i in intents_of(brick)][:1] == ["foot"]
    said = understand("give me the block to hammer with", benchmark.objects)
    assert (said.object, said.part, said.verb) == ("brick", "foot", "hammer")


REFUSED = {
    "objects: [{built_in: cup}, {built_in: cup}]": "two objects are called 'cup'",
    "objects: [{file: /etc/passwd}]": "points outside the folder",
    "objects: [{file: outside.stl}]": "a link that leads outside",
    "objects: [{file: brick.stl, name: ../x}]": "objects.0.name is '../x'",
    "objects: [{built_in: cup, roles: {nose: grasp}}]": "roles name 'nose'; it has wall",
    "objects: [{built_in: cup, split: S1}]": "no receiver's region",
    "hand_model: MANO_RIGHT.pkl": "MANO_RIGHT.pkl: ",
    "home: [0, 0, 4, 0, 0, 0]": "the robot's joint goes from",
    "thresholds: {reach_radius: 0.1}": "did you mean reach_radius_m",
    "thresholds: {safe_margin_m: 0.06}": "safe_margin_m is 0.06; it must be below 0.05",
}


@pytest.mark.parametrize("text", REFUSED)
def test_files_that_are_no_benchmark_are_refused_in_one_line(text, box, capsys):
    (box / "MANO_RIGHT.pkl").write_bytes(b"\x80\x04.")
    (box / "outside.stl").symlink_to("/etc/passwd")
    assert main(["ls", "benchmark", str(written(box, text))]) == 2
    told = capsys.readouterr()
    assert told.out == "" and len(told.err.splitlines()) == 1 and REFUSED[text] in told.err


def test_parts_are_looked_for_before_a_mesh_is_built(box, capsys, monkeypatch):
    def built(*_, **__):
        raise AssertionError("a mesh is built")

    corners = [f"v {x} {y} {z}" for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
    faces = [
        "f 1 2 4",
        "f 1 4 3",
        "f 5 8 6",
        "f 5 7 8",
        "f 1 5 6",
        "f 1 6 2",
        "f 3 4 8",
        "f 3 8 7",
        "f 1 3 7",
        "f 1 7 5",
    ]
    rest = ["f 2 6 8", "f 2 8 4"]
    (box / "one.obj").write_text("\n".join([*corners, "g wall", *faces, *rest]))
    (box / "two.obj").write_text("\n".join([*corners, "g wall", *faces, "g lid", *rest]))
    monkeypatch.setattr("r2h_batch.trials.yaml_file.build_ahead", lambda calls: built() if calls else 0)
    monkeypatch.setattr("r2h_batch.trials.yaml_file.build_object", built)
    for file, words in (
        ("one", "it has body: a mesh file has parts where"),
        ("two", "did you mean lid?; it has wall, lid"),
    ):
        text = f"objects: [{{file: {file}.obj, roles: {{lit: wrap}}}}]"
        assert main(["ls", "benchmark", str(written(box, text))]) == 2
        told = capsys.readouterr().err
        assert f"object {file}: roles name 'lit'" in told and words in told, told


@pytest.mark.parametrize(
    ("hands", "words"),
    [
        ([{"file": f"h{i}.npz"} for i in range(65)], "it may have 64 entries, it has 65"),
        ([["a.npz"]], "hand_set.0 is ['a.npz']; it must hold fields"),
        ([{"file": "h.npz", "count": 0}], "hand_set.0.count is 0; it must be 1 or more"),
        ([{"fil": "h.npz"}], "unknown field hand_set.0.fil, did you mean file?"),
        ([], "hand_set is []; it must have 1 entries or more"),
    ],
)
def test_a_field_that_may_be_one_of_several_things_is_refused_for_its_own_fault(tmp_path, hands, words):
    (tmp_path / "own.yaml").write_text(json.dumps({"hand_set": hands}))
    with pytest.raises(FileError) as error:
        read_benchmark_file(tmp_path / "own.yaml")
    assert words in str(error.value) and "constrained" not in str(error.value)
