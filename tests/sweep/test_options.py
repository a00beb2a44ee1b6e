"""Options from YAML: the same fields as the flags, and one line with the field's path for everything else."""

import dataclasses
import json
import re
from typing import Literal, get_args, get_origin, get_type_hints

import pytest

from r2h_batch.base.errors import UsageError
from r2h_batch.sweep.options import Options, check, load_config, parse


def write(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def another(hint, value):
    """A value of this type that is not the default."""
    if get_origin(hint) is Literal:
        return next(choice for choice in get_args(hint) if choice != value)
    if get_origin(hint) is tuple:
        return ("S1",)  # which a list of splits may hold as well
    return {bool: not value, float: 0.5, str: f"x{value}"}.get(hint, 7)


@pytest.mark.check
def test_every_field_comes_back_from_a_file(tmp_path):
    hints = get_type_hints(Options)
    names = [f.name for f in dataclasses.fields(Options) if f.name != "trust_code"]  # which no file may say
    options = Options(**{name: another(hints[name], getattr(Options(), name)) for name in names})
    assert all(getattr(options, name) != getattr(Options(), name) for name in names)
    assert load_config(write(tmp_path, json.dumps(dataclasses.asdict(options)))) == options


def test_flags_win_over_the_file(tmp_path):
    path = write(tmp_path, "method: [random]\ntrials: 9\nseed: 4\nsave_paths: true\n")
    options = parse(["--config", str(path), "--trials", "5"])
    assert (options.method, options.trials, options.seed, options.save_paths) == (("random",), 5, 4, True)
    assert parse([f"--config={path}", "--benchmark", "r2h-v1", "--method", "oracle"]).method == ("oracle",)


def test_every_option_can_be_set_on_the_command_line(tmp_path, capsys):
    path = write(tmp_path, "method: [random]\nchunk: 9\nno_poses: true\n")
    options = parse(
        ["--config", str(path), "--set", "chunk=8", "edge_check=moveit", "--set=no_poses=false", "--seed", "4"]
    )
    assert (options.chunk, options.edge_check, options.no_poses, options.seed) == (8, "moveit", False, 4)
    assert (
        parse(["--benchmark", "r2h-v1", "--method", "random", "--chunk", "8"]).chunk == 8
    )  # the old flags stay for one version
    for line, part in (
        ("chunks=8", "unknown option 'chunks', did you mean chunk?"),
        ("chunk=many", "'many' is not a whole number"),
        ("chunk", "it must be NAME=VALUE"),
        ("verbose=yes", "--set verbose is 'yes'; allowed are true, false"),
    ):
        with pytest.raises(UsageError, match=re.escape(part)):
            parse(["--benchmark", "r2h-v1", "--method", "random", "--set", line])
    with pytest.raises(SystemExit):
        parse(["--set", "help"])
    told = capsys.readouterr().out
    assert "edge_check preset|exact|moveit" in told and "trials" not in re.findall(r"^  ([a-z_]+)", told, re.M)


BILLION = "a: &a [1,1]\nb: &b [*a,*a]\n"


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("trials: many", "trials is 'many'"),
        ("splits: [S0, S2]", "splits.1 is 'S2'"),
        ("trials: 3\ntrials: 4", "trials is given twice"),
        ("method: !!python/object/apply:os.system [ls]", "not allowed"),
        (BILLION, "anchors and aliases are not allowed"),
        ("? [1, 2]\n: 3", "a list or mapping is a key"),
        ("<<: {trials: 3}", "'<<' is a key"),
        ("trials: 0x1F", "'0x1F', not a plain number"),
        ("trials: " + "9" * 5000, "not a plain number"),
        ("trials: 100000000000000000", "--trials is 100000000000000000; it must be 1000000000000 or less"),
        ("method: [[[[[[random]]]]]]", "nested too deeply"),
        ("method: ! random", "tag ! is not allowed"),
        ("out: \x1b]0;owned\x07", "special characters are not allowed"),
        ("trials: '" + "x" * 100_000 + "'", "trials is 'xxxxx"),
    ],
    ids=lambda t: t[:30],
)
def test_yaml_that_says_more_than_words_lists_and_decimal_numbers_is_refused_by_its_line(tmp_path, text, part):
    path = write(tmp_path, text if "{" in text or "method" in text else f"method: [random]\n{text}")
    with pytest.raises(UsageError) as refused:
        check(load_config(path))
    message = str(refused.value)
    assert part in message and message.isprintable() and len(message) < 700, message
