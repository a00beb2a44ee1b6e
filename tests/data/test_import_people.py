"""`import people` and `import hand --from anny`: what they write and what they refuse, in one line."""

from pathlib import Path

import numpy as np
import pytest

from r2h_batch.__main__ import main
from r2h_batch.data.people import built_in_people, hand_lengths
from r2h_batch.scene.hand import load_hand

HEAD = (
    "sex,age,stature,acromial_height,biacromial_breadth,acromion_radiale,radiale_stylion,chest_depth,chest_breadth,"
    "biceps_circumference,forearm_circumference,wrist_circumference,iliac_height,popliteal_height,seated_shoulder,"
    "hand_length"
)
WOMAN = "female,34,1.63,1.33,0.365,0.311,0.241,0.245,0.268,0.304,0.263,0.154,0.993,0.387,0.567,0.180"


def said(capsys: pytest.CaptureFixture[str], *words: str, code: int) -> str:
    assert main(["import", *words]) == code
    out = capsys.readouterr()
    return (out.err if code else out.out).strip()


@pytest.mark.check
def test_a_table_of_people_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "staff.csv").write_text(f"{HEAD}\n{WOMAN}\n")
    text = said(capsys, "people", str(tmp_path / "staff.csv"), code=0)
    assert "34 to 34 years, stature 1.63 to 1.63 m, hands 180 to 180 mm; sweep with --people" in text


def test_a_table_of_nobody_gets_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for text, words in (
        (HEAD, "0 people; 1 to 100000 are allowed"),
        (f"{HEAD[4:]}\n{WOMAN[7:]}", "has no column sex"),
        (f"{HEAD}\n{WOMAN[:-5]}1.80", "hand_length of person 1 is 1.8; a body's is 0.08 to 0.26 m"),
        (f"{HEAD}\n{WOMAN[:-6]}", "person 1 has 15 cells, the header has 16"),
        (f"{HEAD}\n{WOMAN}\n{WOMAN},1", "person 2 has 17 cells, the header has 16"),
        (f"{HEAD},stature\n{WOMAN},1.7", "column stature is there twice; leave one out"),
        (f"{HEAD}\n{WOMAN.replace('1.63', 'inf')}", "stature of person 1: 'inf' is not a plain number"),
        (f"{HEAD}\n{WOMAN.replace('1.63', '١.٦٣')}", "stature of person 1: '١.٦٣' is not a plain number"),
        (f"{HEAD}\n{WOMAN.replace('1.63', '')}", "stature of person 1: '' is not a plain number"),
    ):
        (tmp_path / "staff.csv").write_text(text + "\n")
        line = said(capsys, "people", str(tmp_path / "staff.csv"), code=2)
        assert words in line and "\n" not in line


def test_the_hand_of_a_child_is_a_hand_model_of_its_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "hand", "--from", "anny", "--age", "8", "--out", str(tmp_path / "hand.npz"), code=0)
    people = built_in_people("children")
    own = people.lengths["hand_length"][np.abs(people.age - 8) <= 1.5]
    length = hand_lengths(load_hand(tmp_path / "hand.npz"), np.zeros((1, 10), np.float32))[0]
    assert abs(length - np.median(own)) < 0.002
    assert f"{1000 * length:.0f} mm long" in text


def test_flags_of_the_two_sources_do_not_mix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "hand.npz")]
    assert "--from anny needs --age YEARS" in said(capsys, "hand", "--from", "anny", *out, code=2)
    assert "say --from anny" in said(capsys, "hand", "--age", "8", *out, code=2)
    words = ("hand", "--from", "anny", "--age", "8", "--mano-right", "x.pkl", *out)
    assert "takes no files of MANO" in said(capsys, *words, code=2)
