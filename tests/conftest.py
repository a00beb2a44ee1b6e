"""Set-up of every run: GPU tests are skipped where there is none, and what was left out is listed with how to get
it."""

import gc
import shutil
import sys
from collections import Counter
from collections.abc import Generator
from contextlib import suppress

import pytest
from needs import is_here, reason
from readers import own_process, read_in_this_process  # noqa: F401 (a fixture)

from r2h_batch.base.io import progress

# CUDA builds of torch bring triton, which ends the process where OSMesa's LLVM was loaded before it (mujoco does that
# with MUJOCO_GL=osmesa); the other order works
with suppress(ImportError):
    import triton  # noqa: F401

read_in_this_process()
progress.SILENT_S = progress.LEAST_S = (
    120.0  # what a command says must not depend on how busy the machine is; tests/base/test_progress.py
)

INTERPRETERS = ("3.11", "3.12", "3.13")
LEFT_OUT = pytest.StashKey[Counter[str]]()


@pytest.fixture(scope="session")
def scene():
    """The scene of all built-in objects and hands: seconds to build, so there is one for all tests. It is not changed."""
    from problems import default_evaluator

    return default_evaluator().scene


@pytest.fixture(scope="session")
def paper_rows(tmp_path_factory):
    """A stored run with the counts and mean times of the paper's Table I. It is not changed."""
    from made_runs import paper_run

    return paper_run(tmp_path_factory.mktemp("paper") / "run")


@pytest.fixture(scope="module")
def syntax_trees(request):
    """For tests that read all code: millions of nodes, which have no cycles, are not searched for them, and do not stay."""
    gc.disable()
    yield
    for kept in vars(request.module).values():
        if hasattr(kept, "cache_clear") and kept.__module__ == request.module.__name__:
            kept.cache_clear()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Imports make half a million objects and no garbage: searching them again and again takes a fifth of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()  # puts all objects aside,
        gc.unfreeze()  # and among the oldest
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    marked = [item for item in items if item.get_closest_marker("gpu")]
    for item in marked if marked and not is_here("gpu") else []:
        item.add_marker(pytest.mark.skip(reason=reason("gpu")))


def pytest_deselected(items: list[pytest.Item]) -> None:
    left_out = items[0].config.stash.setdefault(LEFT_OUT, Counter())
    for item in items:
        for kind in ("gpu", "slow", "whole"):
            if item.get_closest_marker(kind):
                left_out[kind] += 1
                break


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    skipped = Counter(_reason_of(report) for report in terminalreporter.stats.get("skipped", []))
    left_out = config.stash.get(LEFT_OUT, Counter())
    if left_out["gpu"]:
        skipped[reason("gpu")] += left_out["gpu"]
    if left_out["slow"]:
        skipped["time: whole counts, minutes to hours: python -m pytest -m slow"] += left_out["slow"]
    if left_out["whole"]:
        skipped[
            "time: all pages, the site, golden of all benchmarks, the longest of each room: python -m pytest -m whole"
        ] += left_out["whole"]
    own = f"{sys.version_info[0]}.{sys.version_info[1]}"
    others = [v for v in INTERPRETERS if v != own]
    if not skipped:
        return
    terminalreporter.section("not run, for want of")
    for why, count in skipped.most_common():
        terminalreporter.line(f"{count:4d}  {why}")
    for version in others:
        here = "it is here" if shutil.which(f"python{version}") else "install it first: not on this machine"
        terminalreporter.line(f" all  Python {version}: make test PYTHON=python{version} VENV=.venv-{version} ({here})")


def _reason_of(report: pytest.TestReport) -> str:
    """The reason of a skip: the last of (file, line, text)."""
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return text.removeprefix("Skipped: ")
