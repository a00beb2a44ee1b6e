"""Whoever asks for what r2h_batch 0.3 had is told in one line what to use instead."""

import pytest
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.gone import GONE, gone


def line_of(name: str) -> list[str]:
    """A command line that asks for an entry of `GONE`."""
    command, _, asked = name.partition(" ")
    if command == "--method":
        return ["sweep", "--method", f"{asked}=1", "--execute.sim", "none"]
    return [command, *asked.split()]


@pytest.mark.parametrize("name", GONE)
def test_what_went_is_refused_in_one_line_that_says_what_to_use(name, capsys):
    assert main(line_of(name)) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if ": working, " not in line]
    assert len(said) == 1 and said[0].endswith(gone(name)) and "r2h_batch 0.3 had it" in said[0]


@pytest.mark.check
def test_an_attribute_that_went_says_what_to_write_and_another_one_that_there_is_none():
    benchmark = load_benchmark("r2h-v0")
    for name in each(("evaluator", "baselines")):
        with pytest.raises(AttributeError, match=rf"^Benchmark\.{name}: r2h_batch 0.3 had it.*\(benchmark"):
            getattr(benchmark, name)
    with pytest.raises(AttributeError, match=r"^'Benchmark' object has no attribute 'evaluate'$"):
        benchmark.evaluate  # noqa: B018


@pytest.mark.check
def test_what_was_never_there_is_no_entry():
    assert gone("sweep --nonsense") == ""
