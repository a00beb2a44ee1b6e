"""Options from YAML: the same fields as the flags, and one line with the field's path for everything else."""

import dataclasses
import json
import re
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from rounds import each

from r2h_batch.base.errors import UsageError
from r2h_batch.config import MADE_BY, OBJECT_ERRORS, EvalConfig, ExecutionError, ObjectErrors
from r2h_batch.sweep.options import Flags, Options, check, full_help, load_config, parse
from r2h_batch.sweep.request import Sweep, requested
from r2h_batch.sweep.settings import ELSEWHERE, configured, flag_of, settings, value_of
from r2h_batch.trials.load import load_benchmark


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
    hints = get_type_hints(Flags)
    names = [f.name for f in dataclasses.fields(Flags)]
    options = Options(**{name: another(hints[name], getattr(Options(), name)) for name in names})
    assert all(getattr(options, name) != getattr(Options(), name) for name in names)
    data = {name: value for name, value in dataclasses.asdict(options).items() if name != "settings"}
    assert load_config(write(tmp_path, json.dumps(data))) == options


def test_flags_win_over_the_file(tmp_path):
    path = write(tmp_path, "method: [random]\ntrials: 9\nseed: 4\nsave_paths: true\n")
    options = parse(["--config", str(path), "--trials", "5"])
    assert (options.method, options.trials, options.seed, options.save_paths) == (("random",), 5, 4, True)
    assert parse([f"--config={path}", "--benchmark", "r2h-v1", "--method", "oracle"]).method == ("oracle",)


def test_every_option_is_a_flag_and_a_switch_of_the_file_can_be_turned_off(tmp_path):
    path = write(tmp_path, "method: [random]\nchunk: 9\nno_poses: true\nplan.edge_check: moveit\n")
    options = parse(["--config", str(path), "--chunk=8", "--no-no-poses", "--seed", "4"])
    assert (options.chunk, options.no_poses, options.seed) == (8, False, 4)
    assert options.settings == {"plan.edge_check": "moveit"}
    for line, part in (
        ("--chunks=8", "unknown flag --chunks, did you mean --chunk?"),
        ("--chunk=many", "'many' is not a whole number"),
        ("--set=chunk=8", "sweep --set: r2h_batch 0.3 had it, this version has not; write each option as its flag"),
        (
            "--sim=none",
            "sweep --sim: r2h_batch 0.3 had it, this version has not; write --execute.sim, in a file execute.sim",
        ),
    ):
        with pytest.raises(UsageError, match=re.escape(part)):
            parse(["--benchmark", "r2h-v1", "--method", "random", line])


# ---- settings of the configuration


def leaves(kind, at=""):
    """(dotted name, type) of every field of a configuration."""
    for name, hint in get_type_hints(kind).items():
        inner = dataclasses.is_dataclass(hint)
        yield from leaves(hint, f"{at}{name}.") if inner else [(at + name, hint)]


def typed(value):
    return [str(v) for v in value] if isinstance(value, tuple) else [str(value)]


def other(hint, value):
    """A value of the setting that is allowed and not its default."""
    if get_origin(hint) is tuple:
        return (7, 8)
    return {float: value / 4 + 0.001, int: 5}[hint] if hint in (float, int) else another(hint, value)


@pytest.mark.check
def test_each_field_of_the_configuration_is_one_flag_of_its_name_or_is_set_elsewhere():
    names = set(settings())
    rest = {name for name, _ in leaves(EvalConfig)} - names
    assert all(name in ELSEWHERE or name.partition(".")[0] in ELSEWHERE for name in rest)
    assert not names & {f.name for f in dataclasses.fields(Flags)}  # one setting has one name in one place


@pytest.mark.check
@pytest.mark.parametrize("name", settings())
def test_a_flag_and_a_field_of_a_file_change_that_field_alone(tmp_path, name):
    hint, usual = settings()[name], value_of(EvalConfig(), name)
    value = other(hint, usual)
    given = {name: value}
    line = ["--benchmark", "r2h-v1", "--method", "random"]
    assert parse([*line, flag_of(name), *typed(value)]).settings == given
    assert load_config(write(tmp_path, json.dumps({"method": ["random"], name: value}))).settings == given
    changed = configured(EvalConfig(), given)
    different = [n for n, _ in leaves(EvalConfig) if value_of(changed, n) != value_of(EvalConfig(), n)]
    assert different == [name] and value_of(changed, name) == value


@pytest.mark.parametrize("preset", MADE_BY)
def test_a_preset_stays_what_it_is_but_for_what_is_given(preset):
    words = ["--benchmark", "r2h-v1", "--method", "random", "--preset", preset, "--out", "x", "--seed", "4"]
    found = requested(parse([*words, "--plan.shortcuts", "3"])).configuration
    of_preset = EvalConfig.preset(preset)
    assert found.plan == dataclasses.replace(of_preset.plan, shortcuts=3)
    assert found.width == of_preset.width and found.execute.scale == of_preset.execute.scale
    assert found.execute.sim == ("none" if preset == "release" else "mujoco")
    seen = requested(parse([*words, "--predictor-noise", "2"]))
    planned = dataclasses.replace(of_preset.estimate, factor=2.0, seed=4)
    estimated = of_preset.plan.hand == "estimated"
    assert seen.configuration.estimate == (planned if estimated else type(planned)())
    assert seen.errors == of_preset.estimate.errors  # methods see them whatever the planner does


@pytest.mark.parametrize(
    ("word", "error"),
    [
        ("5mm,1deg", ExecutionError(0.005, 1, "trial", 0.005, 1)),
        ("camera:5mm,1deg", ExecutionError(0.005, 1)),
        ("object:5mm,1deg", ExecutionError(0, 0, "trial", 0.005, 1)),
        ("bias:5mm,1deg", ExecutionError(0.005, 1, "run")),
        ("bias:5mm,1deg+object:2mm,.5deg", ExecutionError(0.005, 1, "run", 0.002, 0.5)),
        ("object:2mm,.5deg+camera:5mm,1deg", ExecutionError(0.005, 1, "trial", 0.002, 0.5)),
    ],
)
def test_a_word_says_all_of_the_executed_errors_and_the_seed_comes_from_the_command_line(word, error):
    words = ["--benchmark", "r2h-v1", "--method", "random", "--out", "x", "--seed", "4", "--execution-error", word]
    assert requested(parse(words)).configuration.execution_error == dataclasses.replace(error, seed=4)


def test_errors_of_the_command_line_win_over_those_of_the_file(tmp_path):
    path = write(tmp_path, "method: [random]\nexecution_error: 5mm,1deg\nout: x\n")
    error = requested(
        parse(["--config", str(path), "--execution-error", "object:2mm,1deg"])
    ).configuration.execution_error
    assert (error.camera_m, error.object_m) == (0, 0.002)


def test_a_level_of_object_errors_is_a_word_and_gross_errors_are_settings_of_their_own(tmp_path):
    line = ["--method", "random", "--out", "x", "--seed", "4"]

    def errors(*words):
        return requested(parse([*line, *words])).configuration.object_errors

    sizes = {"lab": (0.002, 1.0), "field": (0.005, 4.0), "rgb": (0.010, 8.0), "7mm,3deg": (0.007, 3.0)}
    shown = " ".join(full_help("sweep").split())
    for level, (m, deg) in OBJECT_ERRORS.items():
        assert not m or f"{level} ({1000 * m:g} mm, {deg:g} degrees)" in shown
    for level, (m, deg) in each(sizes.items()):
        assert errors("--object-errors", level) == ObjectErrors(m, deg, seed=4)
    assert errors("--object-errors", "none") == errors("--object-errors.gross-turn", "symmetry") == ObjectErrors()
    gross = ["--object-errors.gross", "0.1", "--object-errors.gross-turn", "symmetry"]
    assert errors(*gross) == ObjectErrors(gross=0.1, gross_turn="symmetry", seed=4)
    assert errors("--object-errors", "rgb", "--object-errors.gross=0.1") == ObjectErrors(0.01, 8.0, 0.1, seed=4)
    both = errors("--object-errors=lab", "--execution-error", "5mm,1deg")
    assert both == ObjectErrors(0.002, 1.0, seed=4)
    path = write(tmp_path, "method: [random]\nobject_errors: field\nobject_errors.gross: 0.2\n")
    assert errors("--config", str(path)) == ObjectErrors(0.005, 4.0, 0.2, seed=4)
    with pytest.raises(UsageError, match="motions are judged as they are; leave --motions out"):
        parse(["--motions", "m.npz", "--out", "x", "--object-errors", "lab"])
    with pytest.raises(UsageError, match="motions are judged as they are; leave --motions out"):
        parse(["--motions", "m.npz", "--out", "x", "--object-errors.gross", "0.1"])
    with pytest.raises(UsageError, match="leave --object-errors out"):
        parse([*line, "--receiver-motion", "moves", "--object-errors", "lab"])


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--plan.edge-chek", "moveit"], "did you mean --plan.edge-check?; see --help-all"),
        (["--plan.edge-check", "sampled"], "--plan.edge-check is 'sampled'; allowed are exact, moveit"),
        (["--execute.sim", "mujco"], "--execute.sim is 'mujco', did you mean mujoco?"),
        (["--execute.scale", "-1"], "--execute.scale is -1.0; it must be above 0"),
        (["--execute.scale", "1.1"], "--execute.scale is 1.1; it must be 1 or less"),
        (["--plan.seed", str(1 << 63)], f"--plan.seed is {1 << 63}; it must be below {1 << 63}: a seed of 64 bits"),
        (["--plan.rounds", "0"], "--plan.rounds[0] is 0; it must be 1 or more"),
        (["--thresholds.w-max-m=1"], "write thresholds into a benchmark.yaml"),
        (["--estimate.seed", "3"], "say --seed"),
        (["--execution-error", "5mm"], "it must be such as 5mm,1deg"),
        (["--execution-error", "camera:5mm,1deg+bias:5mm,1deg"], "or two of these with + between them"),
        (["--execution-error", "5mm,1deg+object:5mm,1deg"], "or two of these with + between them"),
        (["--execution-error.camera-m", "1"], "say --execution-error, such as camera:5mm,1deg"),
        (["--object-errors.translation-m", "1"], "say --object-errors, such as 5mm,4deg"),
        (["--object-errors", "feild"], "'feild', did you mean field?; allowed are none, lab, field, rgb, or such as"),
        (["--object-errors", "5mm,200deg"], "--object-errors: "),
        (["--object-errors.gross", "2"], "--object-errors.gross is 2.0; it must be 1 or less"),
        (["--object-errors.seed", "2"], "say --seed"),
    ],
)
def test_a_setting_that_cannot_be_is_one_line(words, part):
    with pytest.raises(UsageError, match=re.escape(part)):
        parse(["--benchmark", "r2h-v1", "--method", "random", *words])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("plan.edge_chek: moveit", "unknown field 'plan.edge_chek', did you mean plan.edge_check?"),
        ("plan.edge_check: sampled", "--plan.edge-check is 'sampled'"),
        ("execute.scale: fast", "--execute.scale is 'fast'; it must be a number"),
        ("estimate.seed: 3", "say --seed"),
        ("plan: {edge_check: moveit}", "plan is a section; write its fields on their own, as plan.edge_check: ..."),
        (
            "sim: none",
            "sweep --sim: r2h_batch 0.3 had it, this version has not; write --execute.sim, in a file execute.sim",
        ),
        ("plan: exact", "unknown field 'plan'"),
        ("robustness: true", "sweep --robustness: r2h_batch 0.3 had it, this version has not; sweep once"),
    ],
)
def test_a_setting_of_a_file_that_cannot_be_is_one_line_with_the_file(tmp_path, text, part):
    path = write(tmp_path, f"method: [random]\n{text}\n")
    with pytest.raises(UsageError) as refused:
        load_config(path)
    assert str(path) in str(refused.value) and part in str(refused.value), refused.value


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


@pytest.mark.check
@pytest.mark.parametrize("trials", [8, 40])
def test_objects_of_a_command_line_say_how_many_trials_they_get(trials):
    usual = load_benchmark("r2h-v0")
    cup = next(o for o in usual.objects if o.split == "S0")
    added = [dataclasses.replace(cup, name=name) for name in ("mug", "jar")]
    benchmark = dataclasses.replace(usual, objects=(*usual.objects, *added))
    plan = Sweep(object_mesh=("mug.obj", "jar.obj"), trials=trials or 500)
    line = plan.shares(benchmark, {"S0": trials, "S1": trials})
    drawn = benchmark.trials(trials).object_index
    for place, model in enumerate(benchmark.objects[-2:], len(usual.objects)):
        own = int((drawn == place).sum())
        assert f"{model.name} gets {own or 'none'} of {trials} trials of S0" in line
    assert "--objects FOLDER" in line
    assert Sweep(splits=("S0",), trials=8).shares(usual, {"S0": 8}) == ""
