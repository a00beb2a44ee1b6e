"""Predictions as CSV and JSON: the same rows as a binary file's, and refused as strictly."""

import gzip
import json

import numpy as np
import pytest
import torch
from prediction_files import arrays, refused

from r2h_batch.trials.predictions import load_answers, load_predictions

GOOD = {name: array.tolist() for name, array in arrays(3).items()}


def test_json_gives_the_same_bits_as_a_binary_file(tmp_path):
    data = arrays(4, T_obj_ee=np.full((4, 4, 4), np.float32(1 / 3)), t_method_s=np.array([0.5, np.nan, 1, 2]))
    np.savez(tmp_path / "p.npz", **data)
    text = {name: array.tolist() for name, array in data.items()}
    (tmp_path / "p.json").write_text(json.dumps({"method": "mine", **text}))
    wanted, found = load_predictions(tmp_path / "p.npz"), load_predictions(tmp_path / "p.json")
    assert found.method == "mine" and torch.equal(found.trial_id, wanted.trial_id)
    for name in ("T_obj_ee", "T_world_ee", "t_method_s"):
        assert torch.equal(getattr(found, name).nan_to_num(7), getattr(wanted, name).nan_to_num(7))


def as_csv(data, **columns):
    """The text of a CSV file: arrays as columns, and other columns by name."""
    table = {"trial_id": data["trial_id"].tolist()}
    for name in ("T_obj_ee", "T_world_ee"):
        table |= {f"{name}_{k}": data[name].reshape(-1, 16)[:, k].tolist() for k in range(16)}
    table |= columns
    return "\n".join([",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))])


def test_csv_gives_the_same_bits_as_a_binary_file(tmp_path):
    data = arrays(4, T_obj_ee=np.full((4, 4, 4), np.float32(1 / 3)))
    np.savez(tmp_path / "p.npz", **data)
    (tmp_path / "p.csv").write_text(as_csv(data, t_method_s=[0.5, "nan", 1, 2]), encoding="utf-8-sig")
    wanted, found = load_predictions(tmp_path / "p.npz"), load_predictions(tmp_path / "p.csv")
    assert found.method == "p" and found.t_method_s.isnan().tolist() == [False, True, False, False]
    for name in ("trial_id", "T_obj_ee", "T_world_ee"):
        assert torch.equal(getattr(found, name), getattr(wanted, name))


def test_csv_says_in_a_column_what_it_answers_and_what_its_method_reads(tmp_path):
    said = {"benchmark": ["r2h-v2@12"] * 2, "reads": ["cloud"] * 2}
    (tmp_path / "p.csv").write_text(as_csv(arrays(2), **said))
    answers = load_answers(tmp_path / "p.csv")
    assert (answers.benchmark, answers.reads) == ("r2h-v2@12", "cloud")
    (tmp_path / "p.csv").write_text(as_csv(arrays(2), benchmark=["r2h-v2@12", "r2h-v3@34"]))
    refused(tmp_path / "p.csv", "'benchmark' is <U9 (2,); it must be one string")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("trial_id", "trial"), "column 'trial' is unknown; allowed are trial_id, T_obj_ee"),
        (("\n0,", "\nx,"), "no readable CSV (In CSV column #0"),
        (("\n0,", "\n,"), "trial_id is empty in 1 rows"),
    ],
)
def test_csv_that_cannot_be_scored_is_refused_by_its_column(change, words, tmp_path):
    (tmp_path / "p.csv").write_text(as_csv(arrays(1)).replace(*change))
    refused(tmp_path / "p.csv", words, "write the columns trial_id")


WRONG_HEADS = {
    "its columns are apart by semicolons; save it with commas": lambda text: text.replace(",", ";"),
    "its columns are apart by tabs": lambda text: text.replace(",", "\t"),
    "column ' T_obj_ee_0' has spaces around its name": lambda text: text.replace(",", ", "),
    "its first line holds numbers; it must name the columns": lambda text: text.partition("\n")[2],
    "begins with a comment": lambda text: f"# mine\n{text}",
    "write whole numbers as 7": lambda text: text.replace("\n0,", "\n0.0,"),
    "is in UTF-16": lambda text: text.encode("utf-16"),
    "is compressed (gzip)": lambda text: gzip.compress(text.encode()),
    "is an archive, such as a spreadsheet's": lambda text: b"PK\x03\x04" + text.encode(),
}


@pytest.mark.parametrize("words", WRONG_HEADS)
def test_csv_of_another_kind_is_told_what_it_is(words, tmp_path):
    data = WRONG_HEADS[words](as_csv(arrays(2)))
    (tmp_path / "p.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    refused(tmp_path / "p.csv", words)


@pytest.mark.parametrize("change", [("\n", "\r\n"), ("\n", "\n\n")])
def test_csv_with_windows_line_ends_or_empty_lines_is_the_same(change, tmp_path):
    for name, text in (("a", as_csv(arrays(2))), ("b", as_csv(arrays(2)).replace(*change))):
        (tmp_path / f"{name}.csv").write_bytes(text.encode())
    found = [load_predictions(tmp_path / f"{name}.csv").T_world_ee for name in "ab"]
    assert torch.equal(*found)


BAD = {
    "must hold an object of lists": [GOOD],
    "unknown array 'methods', did you mean method?; allowed are trial_id, T_obj_ee, T_world_ee, t_method_s, method,"
    " benchmark, reads, frame, length_unit, angle_unit, time_unit, quaternion_order, joint_names;": GOOD
    | {"methods": "x"},
    "'T_obj_ee' is not a list of numbers or texts of one shape": GOOD | {"T_obj_ee": [[1.0], [2.0, 3.0], []]},
    "'trial_id' has true or false among numbers": GOOD | {"trial_id": [False, True, *GOOD["trial_id"][2:]]},
    "'T_obj_ee' has true or false among numbers": GOOD
    | {"T_obj_ee": [[[True, *[0.0] * 3]] * 4] * len(GOOD["trial_id"])},
    "T_world_ee is (3, 4, 4) ": GOOD | {"T_world_ee": [[["1"] * 4] * 4] * 3},
    "has no T_world_ee": {k: v for k, v in GOOD.items() if k != "T_world_ee"},
}


@pytest.mark.parametrize("words", BAD)
def test_json_that_cannot_be_scored_is_refused_by_its_name_and_told_how_it_is_written(words, tmp_path):
    (tmp_path / "p.json").write_text(json.dumps(BAD[words]))
    refused(tmp_path / "p.json", words, 'write {"trial_id"')


@pytest.mark.parametrize("data", [b"[" * 200_000, b'{"trial_id": [], "trial_id": []}', b"nonsense", None])
def test_hostile_text_is_refused_in_one_line_before_it_is_parsed(tmp_path, data):
    path = tmp_path / "p.json"
    path.write_bytes(data or b"")
    if data is None:
        with path.open("wb") as file:
            file.truncate(1 << 41)
    assert len(refused(path)) < 700
