"""How methods get into a sweep: names, stand-ins, noise, a user's predictor, and the documented example itself."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from problems import default_evaluator

from r2h_batch.__main__ import main
from r2h_batch.base.errors import UsageError
from r2h_batch.runs.provenance import file_digest
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.sweep.request import Sweep

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def bench():
    return jobs.Setting(default_evaluator(), {}, lambda *_: None, lambda _: None)


def names(bench, **given) -> list[str]:
    return [j.name for j in jobs.make_jobs(replace(bench, sweep=Sweep(**given)), [])]


def test_a_users_network_is_named_and_reaches_contact_alone(bench, tmp_path, monkeypatch):
    (tmp_path / "my_net.py").write_text("def half(grid):\n    return 0.5 * grid[:, 0]\n")
    monkeypatch.syspath_prepend(tmp_path)
    given = jobs.make_jobs(replace(bench, sweep=Sweep(method=("fc", "contact"), predictor="my_net:half")), [])
    assert [j.name for j in given] == ["FC-Handover (oracle hand + noise)", "Contact-Handover (my_net:half + noise)"]
    contact = {"file": "my_net:half", "sha256": file_digest([tmp_path / "my_net.py"])}
    assert json.loads(given[1].source["predictors"])["contact"] == contact


def test_the_learned_method_says_what_it_learned_from_and_its_weights_are_part_of_what_it_is(bench, tmp_path):
    weights = (DOCS.parent / "assets" / "ranker" / "ranker.safetensors").read_bytes()
    (tmp_path / "mine.safetensors").write_bytes(weights)
    words = ("learned", f"learned,weights={tmp_path}/mine.safetensors")
    shipped, mine = jobs.make_jobs(replace(bench, sweep=Sweep(method=words)), [])
    assert shipped.name == "Learned (ranker, oracle labels + noise)" and "weights=" in mine.name
    assert shipped.source["trained on"] == mine.source["trained on"]
    assert shipped.source["trained on"].endswith(" and 76 more objects")
    (tmp_path / "mine.safetensors").write_bytes(weights[:-4] + b"\0\0\0\0")
    (other,) = jobs.make_jobs(replace(bench, sweep=Sweep(method=words[1:])), [])
    assert len({j.source["sha256"] for j in (shipped, mine, other)}) == 3
    header = {"seed": 0, "predictors": {"noise_factor": 1.0}}
    assert jobs.job_of_run(header, shipped.source, bench.evaluator).name == shipped.name
    with pytest.raises(jobs.NotBuiltIn, match="weights came from a file of its own, which is not opened"):
        jobs.job_of_run(header, mine.source, bench.evaluator)
    seen = {"function": "r2h_batch.methods.contact:predict", "options": "depth_lost=0.1, cameras=2"}
    with pytest.raises(jobs.NotBuiltIn, match=r"contact,cameras: r2h_batch 0\.3 had it"):  # its poses are judged again
        jobs.job_of_run(header, seen, bench.evaluator)


def test_the_documented_example_is_a_method_and_runs(tmp_path, monkeypatch, capsys):
    code, *_ = re.findall(r"```python\n(.*?)```", (DOCS / "howto" / "method.md").read_text(), re.S)
    assert len([line for line in code.splitlines() if line]) <= 15
    (tmp_path / "my_rules.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    try:
        line = [
            "--benchmark",
            "r2h-v1",
            "--method",
            "my_rules:predict",
            "--trials",
            "6",
            "--execute.sim",
            "none",
            "--format",
            "json",
            "--out",
            "run",
        ]
        assert sweep.main([*line, "--predictor-noise", "0"]) == 0
    finally:
        sys.modules.pop("my_rules", None)
    table = json.loads(capsys.readouterr().out)
    assert table["origin"]["predictor noise"] == "0"
    run = load_run(tmp_path / "run")
    assert run.trials("my_rules:predict").num_rows == 12
    assert run.header["predictors"]["noise"]["target_translation_m"] == 0
    margins = np.array(run.trials("my_rules:predict")["margin_reach_m"])
    assert (margins[~np.isnan(margins)] > 0.05).all()  # the TCP is where the object is wanted


@pytest.mark.parametrize("more", ["", ", *, seed", ", seed=3", ", **given"])
def test_a_users_method_takes_a_seed_or_none(bench, tmp_path, more, trials_of_six=6):
    got = "None" if more == "" else "given['seed']" if "**" in more else "seed"
    file = tmp_path / "mine.py"
    file.write_text(
        "import torch\nSEEN = []\n"
        f"def predict(trials, scene{more}):\n"
        f"    SEEN.append({got})\n"
        "    T = torch.eye(4).repeat(len(trials), 1, 1)\n"
        "    return T, T\n"
    )
    (job,) = jobs.make_jobs(replace(bench, sweep=Sweep(method=(f"{file}:predict",), seed=11)), [])
    answer = job.predict(bench.evaluator.benchmark.trials(trials_of_six, splits="S0"), None)
    assert len(answer) == trials_of_six
    module = next(m for m in list(sys.modules.values()) if getattr(m, "__file__", None) == str(file))
    assert [None if more == "" else 11] == module.SEEN


def test_a_method_of_other_arguments_is_refused_with_what_it_takes(bench, tmp_path):
    (tmp_path / "mine.py").write_text("def predict(trials):\n    return trials\n")
    takes = r"the function takes \(trials, scene\), or \(seen\) with --sees, and seed if it draws numbers"
    with pytest.raises(UsageError, match=takes):
        jobs.make_jobs(replace(bench, sweep=Sweep(method=(f"{tmp_path}/mine.py:predict",))), [])


WRONG = """
from r2h_batch.methods import oracle

def predict(trials, scene):
    answer = oracle.predict(trials, scene)
    return answer.T_obj_ee, answer.T_world_ee.inverse()
"""


def test_a_sweep_says_in_which_convention_answers_pass(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(WRONG)
    line = [
        "--method",
        f"{tmp_path}/mine.py:predict",
        "--benchmark",
        "r2h-v0",
        "--trials",
        "5",
        "--execute.sim",
        "none",
    ]
    assert sweep.main([*line, "--out", str(tmp_path / "run")]) == 0
    said = [text for text in capsys.readouterr().err.splitlines() if "rows fail" in text]
    assert len(said) == 1 and "mine.py:predict: all 10 rows fail" in said[0], said
    assert "T_world_ee inverted" in said[0]
    log = (tmp_path / "run" / "log.txt").read_text()
    assert said[0].partition(": ")[2] in log


LEARNED = "from r2h_batch.methods.random import predict\n\nTRAINED_ON = {}\n"


def test_what_a_method_was_trained_on_stands_in_tables_and_comparisons(tmp_path, capsys):
    (tmp_path / "taught.py").write_text(LEARNED.format("('cup_s1005_*', 'mug')"))
    words = [
        "--method",
        f"{tmp_path}/taught.py:predict",
        "random",
        "--trials",
        "12",
        "--execute.sim",
        "none",
        "--benchmark",
        "r2h-v1",
    ]
    assert sweep.main([*words, "--out", str(tmp_path / "run")]) == 0
    said = r"trained on cup_s1005\_\*, mug. None of them is tested here."  # Markdown: a name is no markup
    assert " ".join(capsys.readouterr().out.split()).count(said) == 1
    assert main(["compare", str(tmp_path / "run")]) == 0
    assert said in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ("('cu*',)", "was trained on cup, says its TRAINED_ON"),
        ("'cup'", "TRAINED_ON is 'cup'; write names or patterns of objects"),
        ("(3,)", "TRAINED_ON is"),
        ("3", "TRAINED_ON is 3"),
        ("tuple(f'x{k}_*' for k in range(10_001))", "TRAINED_ON has more than 10000 names; write patterns"),
        ("iter(str, 1)", "TRAINED_ON has more than 10000 names; write patterns"),
        ("lambda **options: ['hammer']", "was trained on hammer"),
    ],
)
def test_a_method_is_not_judged_on_what_it_was_trained_on(bench, tmp_path, told, said):
    (tmp_path / "cheat.py").write_text(LEARNED.format(told))
    with pytest.raises(UsageError, match=re.escape(said)) as error:
        names(bench, method=(f"{tmp_path}/cheat.py:predict",))
    assert "\n" not in str(error.value)
