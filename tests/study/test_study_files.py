"""Tables as people save them: read whatever program wrote them, or refused in one line with line and column."""

import pytest
from made_runs import paper_run

from r2h_batch.__main__ import main
from r2h_batch.study.report import read_ratings

HEAD = "participant,method,dimension,rating\n"


def table(people=4, methods=("a", "b", "c"), dimension="comfort"):
    return "".join(f"p{p},{m},{dimension},{1 + (p + k) % 5}\n" for p in range(people) for k, m in enumerate(methods))


def outcome(path, capsys, *line):
    code = main(["study", *(line or ("ratings",)), str(path)])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize(
    ("encoding", "delimiter", "end"),
    [
        ("utf-8", ",", "\n"), ("utf-8-sig", ";", "\r\n"), ("utf-16", "\t", "\r\n"), ("utf-16-le-mark", ",", "\r"),
        ("utf-16-be-mark", ";", "\n"),
    ],
)  # fmt: skip
def test_what_excel_and_others_write_is_read(tmp_path, encoding, delimiter, end):
    text = (HEAD + table(methods=("é", "手", "c"))).replace(",", delimiter).replace("\n", end)
    mark = {"utf-16-le-mark": b"\xff\xfe", "utf-16-be-mark": b"\xfe\xff"}.get(encoding, b"")
    (tmp_path / "r.csv").write_bytes(mark + text.encode(encoding.removesuffix("-mark")))
    values, methods, left_out = read_ratings(tmp_path / "r.csv")["comfort"]
    assert values.shape == (4, 3) and methods == ["é", "手", "c"] and left_out == 0


@pytest.mark.parametrize(
    ("row", "parts"),
    [
        ("p9,a,comfort,0", ["line 3, column 4: rating 0; allowed are whole numbers from 1 to 5"]),
        ("p9,a,comfort,3.5", ["line 3, column 4: rating 3.5"]),
        ("p9,a,comfort,\u0663", ["line 3, column 4: rating"]),
        ("p9,a,comfort,1_0", ["line 3, column 4: rating 1_0"]),
        ("p9,a,comfort,nan", ["line 3, column 4: rating nan"]),
        ("p9,a,comfort," + "9" * 5000, ["line 3, column 4: rating 999", "..."]),
        ("p9,a,comfort", ["line 3, column 4: rating (empty)"]),
        ("p9,,comfort,3", ["line 3, column 2: method (empty)"]),
        ("p9,a,comfort,3,4", ["line 3: 5 cells under 4 columns"]),
        ("p9," + "x" * 100_000 + ",comfort,3", ["line 3, column 2: method xxx", "1 to 200 visible characters"]),
        ('p9,"' + "x\n" * 50_000 + '",comfort,3', ["line 3, column 2: method x\\nx"]),
        ("p9,\x1b[31m,comfort,3", ["line 3, column 2: method \\x1b[31m"]),
        ("p9,\u202ea,comfort,3", ["line 3, column 2: method \\u202ea"]),
        ("p9,a\0,comfort,3", ["neither UTF-8 nor UTF-16"]),
        ("p9,d,comfort,3", ["0 participants rated all of a, d, b, c", "d has 1 ratings, the first in line 3"]),
        ("p9,a,confort,3", ["line 3: 'confort' has 1 ratings only; mend the dimension's name"]),
        ("p0,b,comfort,3", ["line 4: participant p0 rates b twice"]),
    ],
    ids=lambda v: v[:30] if isinstance(v, str) else "",
)
def test_one_bad_row_is_named_by_its_line(tmp_path, capsys, row, parts):
    first, _, rest = table().partition("\n")
    (tmp_path / "r.csv").write_text(f"{HEAD}{first}\n{row}\n{rest}", encoding="utf-8", newline="")
    code, out, err = outcome(tmp_path / "r.csv", capsys)
    assert code == 2 and out == "" and err.count("\n") == 1 and err.rstrip("\n").isprintable() and len(err) < 600
    for part in parts:
        assert part in err, err


@pytest.mark.parametrize(
    ("content", "part"),
    [
        ((HEAD + table()).encode("utf-16-le"), "save it as 'CSV UTF-8'"),
        ((HEAD + "p1,\xe9,comfort,3\n").encode("latin-1"), "neither UTF-8 nor UTF-16"),
        (b"participant,method,dimension,rating,rating\n1,a,b,3,4\n", "column 'rating' is there twice"),
        (b"\xef\xbb\xbf", "no column"),
        (b"", "no column"),
        (b"a,b\n1,2\n", "no column 'participant'"),
        (HEAD.encode(), "no rows under the column names"),
        (HEAD.encode() + table(methods=("a",)).encode(), "all ratings are of a; two or more methods"),
    ],
)
def test_files_that_are_no_table_are_refused(tmp_path, capsys, content, part):
    (tmp_path / "r.csv").write_bytes(content)
    code, _, err = outcome(tmp_path / "r.csv", capsys)
    assert code == 2 and part in err and err.count("\n") == 1


def test_two_methods_are_compared_without_friedmans_test(tmp_path, capsys):
    (tmp_path / "r.csv").write_text(HEAD + table(8, ("a", "b")))
    code, out, _ = outcome(tmp_path / "r.csv", capsys)
    assert code == 0 and "Friedman's test needs three methods" in out and "Wilcoxon" in out and "nan" not in out


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return str(paper_run(tmp_path_factory.mktemp("study") / "run").folder)


@pytest.mark.parametrize(
    ("cells", "trials", "part"),
    [
        ("63.3,13", "-150", "--trials is -150; it must be 1 to"),
        ("63.3,13", "0", "--trials is 0; it must be 1 to"),
        ("163.3,13", "150", "line 2, column 2: real_sr 163.3; allowed are percent from 0 to 100"),
        ("-1,13", "150", "line 2, column 2: real_sr -1; allowed are percent from 0 to 100"),
        (
            "0.85,13",
            "150",
            "line 2, column 2: real_sr 0.85; allowed are percent from 0 to 100, 85 or 85% and not 0.85;",
        ),
        ("1,13", "150", "line 2, column 2: real_sr 1; allowed are percent from 0 to 100, 85 or 85%"),
        ("101%,13", "150", "line 2, column 2: real_sr 101%; allowed are percent"),
        ("63.3,-13", "150", "line 2, column 3: real_t_tot_s -13"),
        ("63.3,inf", "150", "line 2, column 3: real_t_tot_s inf"),
        ("63.3,13\nFC-Handover,60,13", "150", "line 3: FC-Handover is there twice"),
    ],
)
def test_real_rates_and_trials_beyond_their_bounds_are_refused(tmp_path, capsys, run, cells, trials, part):
    (tmp_path / "real.csv").write_text(f"method,real_sr,real_t_tot_s\nFC-Handover,{cells}\n")
    code, out, err = outcome(tmp_path / "real.csv", capsys, "real", "--trials", trials, run)
    assert code == 2 and out == "" and part in err and err.count("\n") == 1


def test_a_percent_sign_is_read_and_what_nobody_can_tell_apart_has_one(tmp_path, capsys, run):
    for cell, shown in (
        ("85%", "85.0"),
        ("85 %", "85.0"),
        ("0.7%", "0.7"),
        ("1%", "1.0"),
        ("0", "0.0"),
        ("1.1", "1.1"),
    ):
        (tmp_path / "real.csv").write_text(f"method,real_sr,real_t_tot_s\nFC-Handover,{cell},13\n")
        code, out, _ = outcome(tmp_path / "real.csv", capsys, "real", "--trials", "150", run)
        assert code == 0 and f" {shown} " in out, out


def test_decimal_commas_of_a_semicolon_table_are_read(tmp_path, capsys, run):
    (tmp_path / "real.csv").write_text("method;real_sr;real_t_tot_s\nFC-Handover;63,3;13,5\n")
    code, out, _ = outcome(tmp_path / "real.csv", capsys, "real", "--trials", "150", run)
    assert code == 0 and "63.3" in out and "13.50" in out
