"""Receivers of every size: body and hand of one person, drawn by counters, never in vain."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.assets.hand.build_handset import angles_from_pose
from r2h_batch.base.errors import FileError
from r2h_batch.data.people import (
    GROUPS,
    LENGTHS_M,
    SEXES,
    People,
    built_in_people,
    hand_lengths,
    hand_of_age,
    people_hand,
    people_hand_set,
    read_people,
)
from r2h_batch.scene.arrays import arrays_digest, asset, read_arrays
from r2h_batch.scene.hand import HandModel
from r2h_batch.trials.benchmark import Benchmark, trials_digest
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.draw.people import Owners
from r2h_batch.trials.draw.receivers import JOINT_BELOW_ACROMION, LENGTHS_MM, TABLE_HEIGHT_M, Person, reach
from r2h_batch.trials.draw.wheelchair import KNEES, LAP_M, POPLITEAL_M, clear_of_lap, off_the_lap
from r2h_batch.trials.edit import edited
from r2h_batch.trials.yaml_file import read_benchmark
from r2h_batch.types import PERSON, Trials


@pytest.fixture(scope="module")
def children() -> Benchmark:
    return edited(BenchmarkChoice(people="children"))


@pytest.fixture(scope="module")
def trials(children: Benchmark) -> Trials:
    return children.trials(60)


def column(trials: Trials, name: str) -> np.ndarray:
    assert trials.person is not None
    return trials.person[:, PERSON.index(name)].numpy()


def test_files_and_receivers_speak_of_the_same_lengths() -> None:
    assert set(LENGTHS_MM) | {"stature", "hand_length"} == set(LENGTHS_M)


def test_body_and_hand_are_of_one_person_of_the_table(children: Benchmark, trials: Trials) -> None:
    people = children.people
    assert people is not None and trials.receiver is not None
    # a person is found by age and stature, and then the arm and the hand must be this person's
    age, stature = column(trials, "age_years"), column(trials, "stature_m")
    off = np.abs(people.age[None] - age[:, None]) + np.abs(people.lengths["stature"][None] - stature[:, None])
    who = off.argmin(1)
    assert off.min(1).max() < 1e-6
    arm = trials.receiver.double().numpy()
    upper = np.linalg.norm(arm[:, 1, :3] - arm[:, 0, :3], axis=1)
    lower = np.linalg.norm(arm[:, 2, :3] - arm[:, 1, :3], axis=1)
    assert np.allclose(upper, (1 - JOINT_BELOW_ACROMION) * people.lengths["acromion_radiale"][who], atol=1e-6)
    assert np.allclose(lower, people.lengths["radiale_stylion"][who], atol=1e-6)
    assert np.allclose(arm[:, 0, 3], people.lengths["biceps_circumference"][who] / (2 * np.pi), atol=1e-6)
    assert (people.sex[who] == column(trials, "female")).all()
    # 200 hands a side stand for 500 people: the hand is that of a neighbour in size, of whom the largest have few
    off_m = np.abs(column(trials, "hand_length_m") - people.lengths["hand_length"][who])
    assert np.quantile(off_m, 0.98) < 0.003 and off_m.max() < 0.008
    hands = hand_lengths(children.hand_set.model, children.hand_set.shape.numpy())
    assert np.allclose(hands[trials.hand_index], column(trials, "hand_length_m"), atol=1e-6)


def test_a_trial_is_the_same_alone_and_among_others(children: Benchmark, trials: Trials) -> None:
    redrawn = np.flatnonzero(column(trials, "redrawn") > 0)
    assert len(redrawn), "no trial of these draws a second person: take more trials"
    for row in (*redrawn[:2], 7):
        alone = children.trials_with_ids(trials.trial_id[row : row + 1])
        for name in ("hand_index", "T_world_hand", "receiver", "person"):
            assert torch.equal(getattr(alone, name)[0], getattr(trials, name)[row]), name


def test_seated_children_whom_no_posture_fits_are_drawn_again_and_counted(trials: Trials) -> None:
    assert column(trials, "redrawn").max() >= 1
    assert len(trials) == 120


def test_hands_keep_their_sides_when_a_trial_is_drawn_again(children: Benchmark, trials: Trials) -> None:
    own = load_benchmark().trials(60)
    usual = load_benchmark().hand_set.side[own.hand_index.long()]
    assert torch.equal(children.hand_set.side[trials.hand_index.long()], usual)


def test_every_person_is_some_hands_and_hands_are_in_the_order_of_their_people() -> None:
    people = built_in_people("elderly")
    owners = Owners(people, people_hand_set(people))
    for side in (0, 1):
        hands = owners.members(side)
        found = {int(p) for u in np.linspace(0.001, 0.999, 200) for p in owners.person(hands, np.full(len(hands), u))}
        assert found == set(range(len(people)))


def test_people_in_wheelchairs_sit_as_high_as_these_and_keep_hand_and_forearm_off_their_lap() -> None:
    benchmark = edited(BenchmarkChoice(people="wheelchair"))
    trials, people = benchmark.trials(60), built_in_people("adults")
    assert column(trials, "seated").all() and trials.receiver is not None
    off = np.abs(people.age[None] - column(trials, "age_years")[:, None])
    who = (off + np.abs(people.lengths["stature"][None] - column(trials, "stature_m")[:, None])).argmin(1)
    row, size = trials.receiver.double().numpy(), {k: v[who] for k, v in people.lengths.items()}
    joint = 0.485 - 0.74 + size["seated_shoulder"] - JOINT_BELOW_ACROMION * size["acromion_radiale"]
    assert np.allclose(row[:, 0, 2], joint, atol=1e-6)
    # the skin of the hand, and a line along the forearm, in a frame of the lap
    hands, T = benchmark.hand_set.geometry.vertices[trials.hand_index.long()].double(), trials.T_world_hand.double()
    skin = (hands @ T[:, :3, :3].mT + T[:, None, :3, 3]).numpy()
    arm = row[:, 1:2, :3] + np.linspace(0, 1, 30)[None, :, None] * (row[:, 2:3, :3] - row[:, 1:2, :3])
    facing = np.stack([row[:, 3, 3], row[:, 4, 3]], 1)
    for points, thick in ((skin, 0.0), (arm, row[:, 1, 3])):
        way = points[..., :2] - row[:, None, 3, :2]
        ahead = (way * facing[:, None]).sum(2)
        aside = way[..., 1] * facing[:, None, 0] - way[..., 0] * facing[:, None, 1]
        over = (
            (ahead > 0)
            & (ahead < 0.35 * size["stature"][:, None] - size["chest_depth"][:, None] / 2)
            & (np.abs(aside) < 0.22)
        )
        assert (
            points[..., 2][over] > 0.685 - 0.74 + np.broadcast_to(np.reshape(thick, (-1, 1)), over.shape)[over]
        ).all()


def test_an_arm_that_rests_in_the_lap_is_refused() -> None:
    people = built_in_people("wheelchair")
    size = {name: value[:200] for name, value in people.lengths.items()}
    seated, v = np.ones(200, bool), np.random.default_rng(5).random((12, 200))
    found = reach(seated, {**size, "popliteal_height": np.full(200, POPLITEAL_M)}, v, np.zeros(200, np.int64), 0.45)
    clear = clear_of_lap(found, KNEES * size["stature"], size["hand_length"])
    tip = found.wrist + found.hand * size["hand_length"][:, None]
    low = np.stack([found.elbow[:, 2], found.wrist[:, 2], tip[:, 2]]).min(0) - (LAP_M - TABLE_HEIGHT_M)
    way = (found.wrist - found.torso)[:, :2]
    ahead = (way * found.facing).sum(1)
    aside = way[:, 1] * found.facing[:, 0] - way[:, 0] * found.facing[:, 1]
    rests = (
        (low < 0) & (found.wrist[:, 2] < LAP_M - TABLE_HEIGHT_M) & (ahead > 0) & (ahead < 0.4) & (np.abs(aside) < 0.2)
    )
    assert rests.sum() > 5 and not clear[rests].any()
    assert (low > 0.1).sum() > 5 and clear[low > 0.1].all()


@pytest.mark.parametrize(("stature", "chest_depth"), [(1.5, 0.20), (1.8, 0.26)])
def test_the_lap_ends_at_the_knees_buttock_knee_length_from_the_back(stature: float, chest_depth: float) -> None:
    """A forearm across the person, level with the lap: refused up to its own thickness before the knees, and no farther."""
    n, radius, height = 61, 0.04, LAP_M - TABLE_HEIGHT_M
    ahead = np.linspace(0.2, 0.8, n)  # from the torso's middle
    of = np.zeros((n, 3))
    elbow, wrist = (np.stack([ahead, np.full(n, y), np.full(n, height)], 1) for y in (0.1, -0.1))
    facing, half = np.tile([1.0, 0.0], (n, 1)), np.full((n, 3), 0.2)
    person = Person(
        elbow, elbow, wrist, np.tile([0.0, -1.0, 0.0], (n, 1)), of, np.full((n, 2), radius), of, facing, half
    )

    def every(people: Person, rows: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray, Person]:
        return np.ones(n, bool), np.tile(np.eye(4, dtype=np.float32), (n, 1, 1)), people

    sizes = (np.full(n, x) for x in (stature, chest_depth, 0.18))
    fits, T, _ = off_the_lap(every, *sizes)(person, np.arange(n), np.zeros(n, np.int64))
    knees = 0.356 * stature - chest_depth / 2
    assert np.array_equal(fits, ahead > knees + radius) and 5 < fits.sum() < n - 5 and len(T) == fits.sum()


def test_without_people_trials_are_the_protocols_own() -> None:
    assert load_benchmark("r2h-v1").trials(4).person is None
    both = [load_benchmark("r2h-v1").trials(20), load_benchmark("r2h-v1").trials(20)]
    assert trials_digest(both[0]) == trials_digest(both[1])


def test_people_make_another_benchmark(children: Benchmark) -> None:
    own = load_benchmark("r2h-v1")
    digests = {own.digest, children.digest, replace(children, people=None).digest}
    assert len(digests) == 3


def test_people_need_a_protocol_with_bodies() -> None:
    with pytest.raises(FileError, match="trials of r2h-v0 have no body; take --benchmark r2h-v1"):
        edited(BenchmarkChoice(benchmark="r2h-v0", people="adults"))
    with pytest.raises(FileError, match="people is adlts, did you mean adults"):
        edited(BenchmarkChoice(people="adlts"))


def test_the_hand_is_watertight_at_every_stature() -> None:
    import trimesh

    people, hand = built_in_people("all"), people_hand()
    shown = people.by_hand[np.linspace(0, len(people) - 1, 25).astype(int)]
    shape = torch.from_numpy(people.hand_shape[shown])
    for side in (0, 1):
        posed = hand.pose(torch.zeros(25, 48), shape, torch.full((25,), side, dtype=torch.int8))
        for skin in each(posed.vertices.numpy()):
            mesh = trimesh.Trimesh(skin, hand.faces_by_side[side].numpy(), process=False)
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 5e-5


def test_capsules_and_box_hold_the_body_as_the_report_says() -> None:
    report = json.loads(asset("people", "report.json").read_text())
    assert report["digests"]["people"] == arrays_digest(read_arrays(asset("people", "people.npz")))
    assert report["digests"]["hand"] == arrays_digest(read_arrays(asset("people", "hand.npz")))
    for group in GROUPS:
        for shape, found in report["shapes"][group].items():
            assert found["skin_held_share"] > 0.95, (group, shape)
            assert found["skin_outside_max_mm"] <= 20.0, (group, shape)
            assert found["overshoot_p95_mm"] < 80.0, (group, shape)


def test_lengths_are_those_of_bodies_between_a_child_and_a_tall_man() -> None:
    # ANSUR II's medians (bench/people.py has the source)
    adults = built_in_people("adults")
    for sex, medians in (
        (0, (1.755, 1.439, 0.335, 0.267, 0.430, 0.608)),
        (1, (1.626, 1.332, 0.311, 0.240, 0.387, 0.567)),
    ):
        names = (
            "stature",
            "acromial_height",
            "acromion_radiale",
            "radiale_stylion",
            "popliteal_height",
            "seated_shoulder",
        )
        for name, published in zip(names, medians, strict=True):
            own = np.median(adults.lengths[name][adults.sex == sex])
            assert abs(own / published - 1) < 0.05, (name, own)
    children = built_in_people("children")
    assert np.corrcoef(children.age, children.lengths["stature"])[0, 1] > 0.8


def test_the_old_are_shorter_as_a_survey_has_them_and_it_is_their_trunk() -> None:
    """NHANES 2009 to 2012 (assets/people/proportions.py): mean statures at 80 and older over those at 20 to 29 years."""
    people = built_in_people("all")
    young, old = (people.age >= 20) & (people.age < 30), people.age >= 80
    for sex, published in ((0, 171.23 / 176.40), (1, 155.68 / 162.90)):
        both = [(people.sex == sex) & rows for rows in (young, old)]
        mean = {name: [values[rows].mean() for rows in both] for name, values in people.lengths.items()}
        assert abs(mean["stature"][1] / mean["stature"][0] - published) < 0.01, sex
        lost = mean["stature"][0] - mean["stature"][1]
        assert mean["seated_shoulder"][0] - mean["seated_shoulder"][1] > 0.5 * lost
        for name in ("popliteal_height", "iliac_height", "acromion_radiale"):
            assert abs(mean[name][1] / mean[name][0] - 1) < 0.03, name


NORMS = {
    # flexion (extension negative), degrees: reference values of The Electronic Textbook of Hand Surgery (e-hand.com,
    # "Normal Range of Motion Reference Values"); abduction of the fingers: AAOS
    (0,): ((-70, 75), (-35, 35)),
    (1, 4, 7, 10): ((-45, 90), (-20, 20)),
    (2, 5, 8, 11): ((0, 100), None),
    (3, 6, 9, 12): ((0, 80), None),
    (14,): ((-10, 55), None),
    (15,): ((-15, 80), None),
}


def test_receiving_postures_keep_to_clinical_ranges_of_the_joints() -> None:
    stored, axes = read_arrays(asset("people", "postures.npz")), people_hand().joint_axes.double().numpy()
    right = np.where(stored["side"][:, None, None] == 1, [[1.0, -1.0, -1.0]], 1.0) * stored["pose"].reshape(-1, 16, 3)
    angles = np.array([angles_from_pose(pose.astype(np.float64).reshape(48), axes) for pose in right])
    for joints, (flexion, abduction) in NORMS.items():
        for j in each(joints):
            assert angles[:, j, 0].min() >= flexion[0] and angles[:, j, 0].max() <= flexion[1], j
            if abduction is not None:
                assert abduction[0] <= angles[:, j, 1].min() and angles[:, j, 1].max() <= abduction[1], j


def test_shape_numbers_give_back_the_length_of_each_persons_hand() -> None:
    people = built_in_people("all")
    made = hand_lengths(people_hand(), people.hand_shape)
    assert np.abs(made - people.lengths["hand_length"]).max() < 0.0015


def test_a_child_of_eight_has_a_smaller_hand_than_an_adult() -> None:
    lengths = []
    for age in (8.0, 30.0):
        model = HandModel.from_arrays(hand_of_age(age))
        lengths.append(float(hand_lengths(model, np.zeros((1, 10), np.float32))[0]))
    assert 0.13 < lengths[0] < 0.17 < lengths[1] < 0.22
    with pytest.raises(FileError, match="--age 3: the built-in people are 6 to 12"):
        hand_of_age(3.0)


def written(path: Path, people: People, change: Callable[[dict[str, str]], None] = lambda row: None) -> Path:
    rows = []
    for k in range(len(people)):
        row = {"sex": SEXES[people.sex[k]], "age": f"{people.age[k]:.2f}"}
        row |= {name: f"{people.lengths[name][k]:.5f}" for name in LENGTHS_M}
        change(row)
        rows.append(row)
    with path.open("w", newline="") as out:
        table = csv.DictWriter(out, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path


def some(count: int) -> People:
    every, rows = built_in_people("adults"), slice(0, count)
    lengths = {name: values[rows] for name, values in every.lengths.items()}
    return People("some", every.sex[rows], every.age[rows], lengths, every.hand_shape[rows])


def test_a_file_of_people_gives_their_trials(tmp_path: Path) -> None:
    file = written(tmp_path / "staff.csv", some(3))
    (tmp_path / "benchmark.yaml").write_text("people: staff.csv\n")
    trials = read_benchmark(tmp_path / "benchmark.yaml").trials(10)
    assert set(column(trials, "stature_m").round(4)) <= set(some(3).lengths["stature"].round(4).astype(np.float32))
    same = edited(BenchmarkChoice(people=str(file))).trials(10)
    assert torch.equal(same.T_world_hand, trials.T_world_hand)


WRONG: dict[str, tuple[Callable[[dict[str, str]], object], str]] = {
    "millimetres": (lambda row: row.update(stature="1755"), "stature of person 1 is 1755; a body's is 0.6 to 2.35 m"),
    "no length": (
        lambda row: row.update(acromion_radiale="long"),
        "acromion_radiale of person 1: 'long' is not a plain number",
    ),
    "missing": (lambda row: row.pop("hand_length"), "has no column hand_length"),
    "hand": (lambda row: row.update(hand_length="0.255"), "hand_length of person 1 is 0.255 m; hands of"),
    "order": (lambda row: row.update(iliac_height="1.44", acromial_height="1.40"), "iliac_height must be less"),
    "nan": (lambda row: row.update(age="nan"), "age of person 1: 'nan' is not a plain number"),
    "sex": (lambda row: row.update(sex="x"), "sex of person 1 is 'x'; allowed are male, female"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_file_that_describes_no_body_gets_one_line(tmp_path: Path, fault: str) -> None:
    change, words = WRONG[fault]
    with pytest.raises(FileError) as error:
        read_people(written(tmp_path / "people.csv", some(2), lambda row: (change(row), None)[1]))
    assert words in str(error.value) and "\n" not in str(error.value)
