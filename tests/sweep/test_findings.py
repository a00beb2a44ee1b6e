"""The pages that benches make of tables: findings that appear, in part or not; ranks; README's table exchanged."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def benches(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")


def test_the_papers_own_table_shows_all_eight_findings():
    import findings

    paper = findings.paper_cells()
    verdicts = [findings.verdict(f, paper) for f in findings.findings()]
    assert verdicts == [("appears", "")] * 8 and len(findings.CAUSES) == 8


def test_a_variants_flags_and_options_are_a_sweeps():
    import sensitivity

    from r2h_batch.sweep import jobs
    from r2h_batch.sweep.options import parse
    from r2h_batch.sweep.request import requested

    for v in sensitivity.variants():
        request = requested(parse(["--method", *v.methods, *(v.flags or sensitivity.BASE)]))
        jobs.resolve(request.methods, request.loop)
