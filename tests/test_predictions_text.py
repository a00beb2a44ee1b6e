"""Predictions as CSV and JSON: the same rows as a binary file's, and refused as strictly."""

import csv
import json

import numpy as np
import pytest
import torch

from r2h_batch.predictions import PredictionsError, load_predictions, write_predictions
from r2h_batch.types import Predictions

NAMES = ["trial_id", *(f"{k}_{i}" for k in ("T_obj_ee", "T_world_ee") for i in range(16))]


def some(n=4, seconds=True):
    rng = np.random.default_rng(0)
    T = [torch.from_numpy(rng.normal(size=(n, 4, 4)).astype(np.float32)) for _ in range(2)]
    T[0][1, 0, 0] = torch.nan  # the evaluator's INVALID_INPUT, as in a binary file
    return Predictions(torch.arange(n) * 3, *T, torch.linspace(0, 1, n) if seconds else None, "mine")


def as_csv(path, p, *, names=None, end="\n"):
    columns = [p.trial_id[:, None], p.T_obj_ee.reshape(-1, 16), p.T_world_ee.reshape(-1, 16)]
    names = list(NAMES if names is None else names)
    if p.t_method_s is not None:
        names.append("t_method_s")
        columns.append(p.t_method_s[:, None])
    with path.open("w", newline="") as file:
        out = csv.writer(file, lineterminator=end)
        out.writerow(names)
        for i in range(len(p)):
            out.writerow([int(p.trial_id[i]), *(repr(float(x)) for c in columns[1:] for x in c[i])])
    return path


def as_json(path, p, *, nested=True):
    rows = []
    for i in range(len(p)):
        T = {k: getattr(p, k)[i] for k in ("T_obj_ee", "T_world_ee")}
        rows.append(
            {"trial_id": int(p.trial_id[i]), **{k: (v if nested else v.flatten()).tolist() for k, v in T.items()}}
        )
        if p.t_method_s is not None:
            rows[-1]["t_method_s"] = float(p.t_method_s[i])
    path.write_text(json.dumps({"method": p.method, "predictions": rows}))
    return path


def equal(a, b):
    assert torch.equal(a.trial_id, b.trial_id)
    for name in ("T_obj_ee", "T_world_ee", "t_method_s"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None) and (x is None or torch.equal(x.nan_to_num(7), y.nan_to_num(7)))


@pytest.mark.parametrize("seconds", [True, False])
def test_text_gives_the_same_bits_as_a_binary_file(tmp_path, seconds):
    p = some(seconds=seconds)
    write_predictions(tmp_path / "p.npz", p)
    wanted = load_predictions(tmp_path / "p.npz")
    for path in (
        as_csv(tmp_path / "a.csv", p), as_csv(tmp_path / "b.CSV", p, end="\r\n"), as_json(tmp_path / "a.json", p),
        as_json(tmp_path / "b.json", p, nested=False),
    ):  # fmt: skip
        found = load_predictions(path)
        if path.suffix == ".json" and not seconds:
            assert found.t_method_s.isnan().all()
            found = Predictions(found.trial_id, found.T_obj_ee, found.T_world_ee, None, found.method)
        equal(found, wanted)
        assert found.method == ("mine" if path.suffix == ".json" else path.stem)


def lines(p, tmp_path):
    return as_csv(tmp_path / "x.csv", p).read_text().splitlines()


CSV = {
    "unknown column 'trial id'": lambda t: ["trial id" + t[0][8:], *t[1:]],
    "column T_world_ee_15 is missing": lambda t: [t[0].replace(",T_world_ee_15", ""), *t[1:]],
    "line 3 has 35 cells; the first line has 34": lambda t: [t[0], t[1], t[2] + ",1"],
    "line 2: trial_id is 0.5": lambda t: [t[0], "0.5" + t[1][1:]],
    "'=1+1'": lambda t: [t[0], t[1].replace(t[1].split(",")[5], "=1+1")],
    "T_obj_ee is empty; it must be 16 numbers": lambda t: [t[0], t[1].replace(t[1].split(",")[5], "")],
    "write commas between columns": lambda t: [x.replace(",", ";") for x in t],
    "no rows": lambda t: t[:1],
    "no readable CSV": lambda t: [t[0], '"' + t[1]],
    "is -1; 0 to 1e+09 seconds are allowed": lambda t: [t[0], t[1].rpartition(",")[0] + ",-1"],
}


@pytest.mark.parametrize("words", CSV)
def test_a_csv_that_cannot_be_scored_is_refused_with_line_and_column(words, tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("\n".join(CSV[words](lines(some(), tmp_path))) + "\n")
    with pytest.raises(PredictionsError) as error:
        load_predictions(path)
    assert words in str(error.value) and "\n" not in str(error.value)


def changed(data, **row):
    data["predictions"][0] |= row
    return data


JSON = {
    "must hold an object with a list 'predictions'": lambda d: d["predictions"],
    "unknown field 'methods'": lambda d: d | {"methods": "x"},
    "method must be text": lambda d: d | {"method": 3},
    "predictions.0.trial_id is True": lambda d: changed(d, trial_id=True),
    "predictions.0.trial_id is 92233": lambda d: changed(d, trial_id=1 << 63),
    "predictions.0.T_obj_ee is 15 numbers; it must be 16 numbers": lambda d: changed(d, T_obj_ee=[1.0] * 15),
    "predictions.0.T_world_ee is '1'; it must be 16 numbers": lambda d: changed(d, T_world_ee=["1"] * 16),
    "'method' must be": lambda d: d | {"method": ""},
}


@pytest.mark.parametrize("words", JSON)
def test_a_json_that_cannot_be_scored_is_refused_with_row_and_name(words, tmp_path):
    path = tmp_path / "p.json"
    path.write_text(json.dumps(JSON[words](json.loads(as_json(path, some()).read_text()))))
    with pytest.raises(PredictionsError) as error:
        load_predictions(path)
    assert words.replace("'method' must", "method '' must") in str(error.value) and "\n" not in str(error.value)


def test_hostile_text_is_refused_in_one_line_before_it_is_parsed(tmp_path):
    for name, data in {
        "deep.json": b"[" * 200_000,
        "twice.json": b'{"predictions": [], "predictions": []}',
        "latin.csv": b"trial_id,\xff\n",
        "huge.json": None,
        "huge.csv": None,
    }.items():
        path = tmp_path / name
        if data is None:
            with path.open("wb") as file:
                file.truncate(1 << 41)
        else:
            path.write_bytes(data)
        with pytest.raises(PredictionsError) as error:
            load_predictions(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 700


def test_a_text_file_that_is_not_there_or_not_right_is_told_how_text_is_written(tmp_path) -> None:
    for suffix, how in ((".csv", "T_obj_ee_0 to _15"), (".json", '{"predictions": [')):
        path = tmp_path / f"mine{suffix}"
        for content in (None, "nonsense"):
            if content is not None:
                path.write_text(content)
            with pytest.raises(PredictionsError) as error:
                load_predictions(path)
            said = str(error.value)
            assert how in said and "savez" not in said and "\n" not in said
