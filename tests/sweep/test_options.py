"""Options from YAML: the same fields as the flags, and one line with the field's path for everything else."""

import dataclasses
import json
import re

import pytest
from sweep_command import command

from r2h_batch.sweep.options import Options, UsageError, check, load_config, parse


def write(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.check
def test_every_field_comes_back_from_a_file(tmp_path):
    options = Options(
        method=("random", "contact", "my.rules:best"),
        predictions=("a.npz",),
        motions=("m.npz",),
        trials_from="theirs",
        replan=True,
        splits=("S1",),
        trials=7,
        device="cuda:1",
        out="runs/x",
        force_new=True,
        log="mlflow",
        seed=3,
        predictor="net.pt",
        predicted_hands="h.npz",
        predicted_parts="p.npz",
        predicted_contacts="c.npz",
        predictor_noise=0.5,
        hand_errors="tails",
        receiver="body",
        robot="ur3e_2f85",
        persons="as-for-ur5e",
        candidates="as-generated",
        reach="hull",
        plan_hand="true",
        execution_error="5mm,1deg",
        robustness=True,
        object_mesh=("mug.obj:S0",),
        benchmark="mine.yaml",
        hands="hands.npz",
        hand_model="hand.npz",
        objects="meshes",
        grasps=("mug=mug.npz",),
        trials_file="trials.parquet",
        preset="paper",
        width="whole",
        object_collision="pieces",
        edge_check="moveit",
        ik="pytorch-kinematics",
        stability="physics",
        sim="none",
        sim_model="arm",
        format="csv",
        protocol="r2h-v1",
        save_details=True,
        quiet=True,
        verbose=True,
        no_poses=True,
        save_poses=True,
        save_paths=True,
        threads=2,
        allow_empty_candidates=True,
        allow_missing=True,
        shard="2/3",
        shard_trials=50,
        chunk=9,
        engine="ray",
        address="auto",
        workers=4,
        gpus_per_worker=0.5,
        ray_timeout=7.0,
    )
    default = Options()
    names = {f.name for f in dataclasses.fields(Options)} - {"trust_code"}  # which no file may say
    assert all(getattr(options, name) != getattr(default, name) for name in names)
    assert load_config(write(tmp_path, json.dumps(dataclasses.asdict(options)))) == options
    # these contradict save_poses, execution_error and robustness
    stored = dataclasses.replace(options, no_poses=False, motions=(), trials_from="", robustness=False)
    assert check(stored) == stored


def test_flags_win_over_the_file(tmp_path):
    path = write(tmp_path, "method: [random]\ntrials: 9\nseed: 4\nsave_paths: true\n")
    options = parse(["--config", str(path), "--trials", "5"])
    assert (options.method, options.trials, options.seed, options.save_paths) == (("random",), 5, 4, True)
    assert parse([f"--config={path}", "--method", "oracle"]).method == ("oracle",)


def test_every_option_can_be_set_on_the_command_line(tmp_path, capsys):
    path = write(tmp_path, "method: [random]\nchunk: 9\nno_poses: true\n")
    options = parse(
        ["--config", str(path), "--set", "chunk=8", "edge_check=moveit", "--set=no_poses=false", "--seed", "4"]
    )
    assert (options.chunk, options.edge_check, options.no_poses, options.seed) == (8, "moveit", False, 4)
    assert parse(["--method", "random", "--chunk", "8"]).chunk == 8  # the old flags stay for one version
    for line, part in (
        ("chunks=8", "unknown option 'chunks', did you mean chunk?"),
        ("chunk=many", "'many' is no whole number"),
        ("chunk", "it must be NAME=VALUE"),
        ("verbose=yes", "--set verbose is 'yes'; allowed are true, false"),
    ):
        with pytest.raises(UsageError, match=re.escape(part)):
            parse(["--method", "random", "--set", line])
    with pytest.raises(SystemExit):
        parse(["--set", "help"])
    told = capsys.readouterr().out
    assert "edge_check preset|exact|moveit" in told and "trials" not in re.findall(r"^  ([a-z_]+)", told, re.M)


BILLION = "a: &a [1,1]\nb: &b [*a,*a]\n"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("trails: 3", ["unknown field 'trails'", "did you mean trials?", "save_paths"]),
        ("trials: many", ["trials is 'many'", "whole number"]),
        ("trials: 3.5", ["trials is 3.5"]),
        ("trials: '3'", ["trials is '3'"]),
        ("trials: true", ["trials is True"]),
        ("trials:", ["trials is None"]),
        ("method: random", ["method is 'random'", "a list"]),
        ("method: [random, 3]", ["method.1 is 3", "text"]),
        ("splits: [S0, S2]", ["splits.1 is 'S2'", "'S0' or 'S1'"]),
        ("preset: fast", ["preset is 'fast'", "'default', 'paper' or 'release'"]),
        ("save_paths: 1", ["save_paths is 1", "true or false"]),
        ("out: 2020-01-01\nseed: x", ["seed is 'x'"]),
        ("trials: 3\ntrials: 4", ["line 2", "trials is given twice"]),
        ("method: !!python/object/apply:os.system [ls]", ["line 1", "tag", "not allowed"]),
        ("seed: !mine 3", ["tag", "not allowed"]),
        (BILLION, ["line 1", "anchors and aliases are not allowed"]),
        ("- random", ["must hold fields", "list"]),
        ("", ["must hold fields"]),
        ("a: [", ["sweep.yaml"]),
        ("trials: .nan", ["trials"]),
        ("[" * 50_000, ["sweep.yaml"]),
        ("seed: 1\n\0", ["sweep.yaml"]),
    ],
)
def test_a_bad_file_is_refused_by_the_path_of_the_field(tmp_path, text, parts):
    path = write(tmp_path, text)
    with pytest.raises(UsageError) as refused:
        load_config(path)
    message = " ".join(str(refused.value).split())
    for part in (str(path), *parts):
        assert part in message
    assert len(message) < 1000


def test_a_file_that_is_not_there_is_too_large_or_no_text_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        load_config(tmp_path / "none.yaml")
    with pytest.raises(UsageError, match="at most 1048576"):
        load_config(write(tmp_path, "#" * (1 << 20) + "\n"))
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"b\.yaml"):
        load_config(tmp_path / "b.yaml")


def test_the_command_says_so_in_one_line_and_exits_with_2(tmp_path):
    path = write(tmp_path, "method: [random]\nplan: {budget: 3}\n")
    done = command("--config", path)
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"sweep: {path}: unknown field 'plan'")
    assert command("--config").stderr == "sweep: --config names no file\n"


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("--shard 0/3", "--shard is '0/3'; it must be I/N"),
        ("--shard 4/3", "--shard is '4/3'"),
        ("--shard 2", "--shard is '2'"),
        ("--shard 1/2", "--shard needs --out"),
        ("--workers 2", "belong to --engine ray"),
        ("--chunk -1", "--chunk is -1; it must be 0 or more"),
        ("--engine dask", "dask"),
        ("--predictor-noise -1", "--predictor-noise is -1.0; it must be 0 (the truth) or more"),
        ("--predictor-noise nan", "--predictor-noise: 'nan' is no plain number"),
        ("--method random fc --predicted-hands h.npz --preset paper", "add --plan-hand true"),
        ("--predictor net.pt", "--predictor is the contact network of --method contact; add that method"),
    ],
)
def test_options_of_engines_are_checked(line, part):
    with pytest.raises(UsageError) as refused:
        parse(["--method", "random", *line.split()])
    assert part in " ".join(str(refused.value).split())


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("{[a]: 1}", "a list or mapping is a key"),
        ("{{a: 1}: 1}", "a list or mapping is a key"),
        ("? [1, 2]\n: 3", "a list or mapping is a key"),
        ("<<: {trials: 3}", "'<<' is a key"),
        ("1: 2", "'1' is a key"),
        ("null: 2", "'null' is a key"),
        ("trials: 1:30", "'1:30', no plain number"),
        ("trials: 017", "'017', no plain number"),
        ("trials: 0x1F", "'0x1F', no plain number"),
        ("trials: 1_000", "'1_000', no plain number"),
        ("trials: 0o17", "trials is '0o17'"),
        ("predictor_noise: .inf", "'.inf', no plain number"),
        ("predictor_noise: .nan", "'.nan', no plain number"),
        ("predictor_noise: 1.0e+999", "'1.0e+999', no plain number"),
        ("predictor_noise: 1e999", "predictor_noise is '1e999'"),
        ("trials: " + "9" * 5000, "no plain number"),
        ("trials: 100000000000000000", "--trials is 100000000000000000; it must be 1000000000000 or less"),
        ("seed: 9223372036854775808", "no plain number"),
        ("method: [[[[[[random]]]]]]", "nested too deeply"),
        ("{" * 100_000, "nested too deeply"),
        ("method: ! random", "tag ! is not allowed"),
        ("out: \x1b]0;owned\x07", "special characters are not allowed"),
        ("trials: '" + "x" * 100_000 + "'", "trials is 'xxxxx"),
        ("=: 3", "'=' is a key"),
        ("trials: =", "trials is '=', to YAML a value"),
    ],
    ids=lambda t: t[:30],
)
def test_yaml_that_says_more_than_words_lists_and_decimal_numbers_is_refused_by_its_line(tmp_path, text, part):
    path = write(tmp_path, text if "{" in text or "method" in text else f"method: [random]\n{text}")
    with pytest.raises(UsageError) as refused:
        check(load_config(path))
    message = str(refused.value)
    assert part in message and message.isprintable() and len(message) < 700, message


@pytest.mark.parametrize(
    "shard", ["\u00b2/\u00b3", "1/\u0663", "0x1/2", "1/1e3", "1/9999999999", " 1/2", "1/2 ", "-1/2", "+1/2"]
)
def test_shards_are_plain_numbers(shard):
    with pytest.raises(UsageError, match="--shard is"):
        parse(["--method", "random", "--out", "x", f"--shard={shard}"])


@pytest.mark.parametrize(
    "line", ["--trials 99999999999999999999", "--workers 1e3", "--seed 99999999999999999999", "--gpus-per-worker inf"]
)
def test_numbers_beyond_any_run_are_refused_at_the_command_line(line):
    with pytest.raises(UsageError):
        parse(["--method", "random", "--engine", "ray", *line.split()])
