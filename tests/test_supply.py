"""Code of others: the lock is whole, licences are listed, an audit that was not made is no clean bill, no downloads."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
import torch
from needs import needs
from no_network import without_network
from sweep_command import in_process

from r2h_batch.runs.store import load_run

ROOT = Path(__file__).resolve().parents[1]
PIN = re.compile(r"([a-z0-9-]+)==([0-9][A-Za-z0-9.]*)")


@pytest.fixture(scope="module")
def supply() -> ModuleType:
    spec = importlib.util.spec_from_file_location("supply", ROOT / "tools" / "supply.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found = [PIN.fullmatch(line) for line in lines if not line.startswith("#")]
    assert all(found)  # exact versions, no address, no option
    return {m[1]: m[2] for m in found if m}


def test_the_lock_has_every_package_that_is_installed_for_the_project_in_the_version_that_is(
    supply: ModuleType, pins: dict[str, str]
) -> None:
    closure = supply.closure()
    assert len(pins) > 80
    public = {name: str(supply.Version(installed.version).public) for name, (installed, _) in closure.items()}
    if torch.version.cuda:  # the lock is a CPU's: a CUDA build brings packages that it does not name
        public = {n: v for n, v in public.items() if n in pins}
    assert {n: v for n, v in public.items() if pins.get(n) != v} == {}, "run `make lock`"


def test_every_package_and_every_bundled_file_stands_in_the_table_of_licences(
    supply: ModuleType, pins: dict[str, str]
) -> None:
    text = (ROOT / "docs" / "licences.md").read_text()
    rows = [row for row in text.partition("## Packages")[2].splitlines() if row.startswith("|")]
    listed = {re.sub(r"[-_.]+", "-", name).lower() for row in rows for name in re.split(r"[|,]\s*", row)}
    listed = {name.strip() for name in listed}
    assert [p for p in pins if p not in listed] == [], "run `make licences`"
    sources = (ROOT / "assets" / "SOURCES.md").read_text()
    data = [p for p in (ROOT / "assets").rglob("*") if p.suffix in (".npz", ".npy", ".safetensors")]
    assert len(data) >= 5
    for path in data:
        assert path.name in sources or f"{path.parent.name}/*{path.suffix}" in sources, path
    assert "not stated" not in text


def test_an_audit_that_looked_nothing_up_is_not_a_clean_one(
    supply: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {"name": "a", "version": "1", "vulns": []}
    unknown = {"name": "b", "skip_reason": "not found"}
    bad = {"name": "c", "version": "1", "vulns": [{"id": "X-1"}]}
    assert supply.verdict([known]) == 0
    assert supply.verdict([known, unknown]) == supply.verdict([]) == supply.NOT_CHECKED
    assert "NOT CHECKED, the source does not know 1 of 2" in capsys.readouterr().err
    assert supply.verdict([known, unknown, bad]) == 1


@needs("unshare")
def test_a_sweep_fetches_nothing_it_runs_with_the_network_cut_off(tmp_path: Path) -> None:
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "1",
        "--execute.sim",
        "none",
        "--out",
        str(tmp_path / "run"),
    ]
    without_network(in_process, *line)
    assert load_run(tmp_path / "run").trials("random").num_rows == 2
