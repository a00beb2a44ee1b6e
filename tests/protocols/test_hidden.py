"""Held-out trials: other ones of the same rule, and a promise that no later seed keeps."""

import json
import re

import pytest
from refusals import one_line

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.protocols.benchmark import trials_digest
from r2h_batch.protocols.hidden import check_told, commitment_of, read_commitment

SEED = "0123456789abcdef" * 2


@pytest.mark.check
def test_a_seed_draws_other_trials_of_the_same_rule_and_none_draws_the_published_ones():
    base = load_benchmark("r2h-v2")
    other, third = base.with_seed(SEED), base.with_seed(SEED[::-1])
    drawn = [b.trials(6) for b in (base, other, third)]
    assert len({trials_digest(t) for t in drawn}) == len({b.digest for b in (base, other, third)}) == 3
    assert all(t.object_index.equal(drawn[0].object_index) for t in drawn)
    moved = [(t.T_world_hand[:, :3, 3] - drawn[0].T_world_hand[:, :3, 3]).norm(dim=1) for t in drawn[1:]]
    assert all((m > 1e-3).all() for m in moved) and not moved[0].equal(moved[1])
    assert other.with_seed("").digest == base.digest
    assert trials_digest(other.with_seed("").trials(6)) == trials_digest(drawn[0])
    alone = other.trials_with_ids(drawn[1].trial_id[[7]])
    assert alone.T_world_hand[0].equal(drawn[1].T_world_hand[7])


def test_what_is_no_seed_is_refused():
    base = load_benchmark("r2h-v1")
    for seed in ("7", SEED.upper(), SEED + "0", "g" * 32):
        with pytest.raises(ValueError, match="it must be 32 hexadecimal digits, or empty"):
            base.with_seed(seed)


@pytest.fixture
def told(tmp_path, capsys):
    assert main(["benchmark", "hide", "r2h-v1", "--out", str(tmp_path / "told.yaml"), "--trials", "3"]) == 0
    out = capsys.readouterr().out
    assert "publish it now" in out and "keep it secret" in out
    return tmp_path


def test_the_promise_holds_for_its_seed_alone(told):
    promise, file = told / "told.commitment.json", told / "told.yaml"
    seed = re.search(r'seed: "([0-9a-f]{32})"', file.read_text())[1]
    assert seed not in promise.read_text() and file.stat().st_mode & 0o077 == 0
    assert check_told(promise, load_benchmark(file)).trials == 3
    with one_line(r"the seed of r2h-v1 is not the committed one.*nobody should trust"):
        check_told(promise, load_benchmark("r2h-v1").with_seed(SEED))
    with one_line("has no seed; give the file that was told"):
        check_told(promise, load_benchmark("r2h-v1"))
    with one_line("is of benchmark .* without its seed"):
        check_told(promise, load_benchmark("r2h-v2").with_seed(seed))
    said = read_commitment(promise)
    for change in ({"trials": 4}, {"sha256": "0" * 64}, {"benchmark": "0" * 64}):
        promise.write_text(said.model_copy(update=change).model_dump_json())
        with one_line("not the committed one|without its seed"):
            check_told(promise, load_benchmark(file))


@pytest.mark.parametrize(
    "text",
    ["[]", "7", "{}", '{"format": 2}', "{", '{"format": 1, "benchmark": "x", "trials": 0, "sha256": ""}', "[" * 9999],
)
def test_another_file_is_no_promise(told, text):
    (told / "told.commitment.json").write_text(text)
    with one_line("told.commitment.json: "):
        read_commitment(told / "told.commitment.json")


def test_a_benchmark_file_keeps_what_it_says_and_gets_a_seed(tmp_path, capsys):
    own = tmp_path / "mine.yaml"
    own.write_text("protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: hammer}\n")
    assert main(["benchmark", "hide", str(own), "--out", str(tmp_path / "told.yaml")]) == 0
    found = load_benchmark(tmp_path / "told.yaml")
    assert [o.name for o in found.objects] == ["cup", "hammer"]
    assert found.with_seed("").digest == load_benchmark(own).digest
    capsys.readouterr()
    for given, words in (
        ([str(own), "--out", str(tmp_path / "away" / "told.yaml")], "where the files that mine.yaml names are"),
        ([str(own), "--out", str(tmp_path / "told.yaml")], "told.yaml"),
        ([str(tmp_path / "told.yaml"), "--out", str(tmp_path / "twice.yaml")], "has a seed"),
        (["r2h-v1", "--out", str(tmp_path / "told.json")], "is a .yaml file"),
        (["r2h-v1", "--out", str(tmp_path / "no.yaml"), "--trials", "0"], "--trials"),
    ):
        assert main(["benchmark", "hide", *given]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert json.loads((tmp_path / "told.commitment.json").read_text())["trials"] == 500


def test_a_commitment_needs_a_seed():
    with pytest.raises(ValueError, match="has no seed"):
        commitment_of(load_benchmark("r2h-v1"), 5)
