"""Tables that people fill in: refused in one line with line and column."""

import pytest

from r2h_batch.__main__ import main

HEAD = "participant,method,dimension,rating\n"


def table(people=4, methods=("a", "b", "c")):
    return "".join(f"p{p},{m},comfort,{1 + (p + k) % 5}\n" for p in range(people) for k, m in enumerate(methods))


def outcome(path, capsys, *line):
    code = main(["study", *(line or ("ratings",)), str(path)])
    out, err = capsys.readouterr()
    return code, out, err


def with_row(row):
    first, _, rest = table().partition("\n")
    return f"{HEAD}{first}\n{row}\n{rest}".encode()


BAD = {
    "line 3, column 4: rating 0; allowed are whole numbers from 1 to 5": with_row("p9,a,comfort,0"),
    "line 3: 5 cells under 4 columns": with_row("p9,a,comfort,3,4"),
    "line 4: participant p0 rates b twice": with_row("p0,b,comfort,3"),
    "has semicolons between the cells; save it with commas": (HEAD + table()).replace(",", ";").encode(),
    "has tabs between the cells; save it with commas": (HEAD + table()).replace(",", "\t").encode(),
    "save it as 'CSV UTF-8'": (HEAD + table()).encode("utf-16"),
    "no rows under the column names": HEAD.encode(),
}


@pytest.mark.parametrize("words", BAD)
def test_what_is_no_table_of_ratings_is_named_by_its_line(tmp_path, capsys, words):
    (tmp_path / "r.csv").write_bytes(BAD[words])
    code, out, err = outcome(tmp_path / "r.csv", capsys)
    assert code == 2 and out == "" and words in err and err.count("\n") == 1 and len(err) < 600
    assert err.rstrip("\n").isprintable()


@pytest.mark.parametrize(
    ("cells", "trials", "part"),
    [
        ("63.3,13", "-150", "--trials is -150; it must be 1 to"),
        ("163.3,13", "150", "line 2, column 2: real_sr 163.3; allowed are percent from 0 to 100"),
        ("0.85,13", "150", "real_sr 0.85; allowed are percent from 0 to 100, 85 or 85% and not 0.85;"),
        ("63.3,13\nFC-Handover,60,13", "150", "line 3: FC-Handover is there twice"),
    ],
)
def test_real_rates_and_trials_beyond_their_bounds_are_refused(tmp_path, capsys, paper_rows, cells, trials, part):
    (tmp_path / "real.csv").write_text(f"method,real_sr,real_t_tot_s\nFC-Handover,{cells}\n")
    code, out, err = outcome(tmp_path / "real.csv", capsys, "real", "--trials", trials, str(paper_rows.folder))
    assert code == 2 and out == "" and part in err and err.count("\n") == 1
