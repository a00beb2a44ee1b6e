"""Options from YAML: the same fields as the flags, and one line with the field's path for everything else."""

import dataclasses
import json
import re

import pytest

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
        receiver_motion="moves",
        policy="servo",
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
        quiet=True,
        verbose=True,
        no_poses=True,
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
    # these contradict save_paths, execution_error and robustness
    stored = dataclasses.replace(options, no_poses=False, motions=(), trials_from="", robustness=False)
    stored = dataclasses.replace(stored, receiver_motion="", policy="planned")
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
        ("method: random", ["method is 'random'", "a list"]),
        ("splits: [S0, S2]", ["splits.1 is 'S2'", "'S0' or 'S1'"]),
        ("preset: fast", ["preset is 'fast'", "'default', 'paper' or 'release'"]),
        ("trials: 3\ntrials: 4", ["line 2", "trials is given twice"]),
        ("method: !!python/object/apply:os.system [ls]", ["line 1", "tag", "not allowed"]),
        (BILLION, ["line 1", "anchors and aliases are not allowed"]),
        ("- random", ["must hold fields", "list"]),
        ("", ["must hold fields"]),
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


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("--shard 0/3", "--shard is '0/3'; it must be I/N"),
        ("--shard 1/2", "--shard needs --out"),
        ("--workers 2", "belong to --engine ray"),
        ("--chunk -1", "--chunk is -1; it must be 0 or more"),
        ("--predictor-noise -1", "--predictor-noise is -1.0; it must be 0 (the truth) or more"),
        ("--method random fc --predicted-hands h.npz --preset paper", "add --plan-hand true"),
        ("--predictor net.pt", "--predictor is the contact network of --method contact; add that method"),
    ],
)
def test_options_of_engines_are_checked(line, part):
    with pytest.raises(UsageError) as refused:
        parse([*(() if "--method" in line else ("--method", "random")), *line.split()])
    assert part in " ".join(str(refused.value).split())


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("? [1, 2]\n: 3", "a list or mapping is a key"),
        ("<<: {trials: 3}", "'<<' is a key"),
        ("trials: 1:30", "'1:30', no plain number"),
        ("trials: 0x1F", "'0x1F', no plain number"),
        ("predictor_noise: .inf", "'.inf', no plain number"),
        ("trials: " + "9" * 5000, "no plain number"),
        ("trials: 100000000000000000", "--trials is 100000000000000000; it must be 1000000000000 or less"),
        ("method: [[[[[[random]]]]]]", "nested too deeply"),
        ("{" * 100_000, "nested too deeply"),
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
