"""The pages that benches make of tables: findings that appear, in part or not; README's table."""

from dataclasses import replace
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
    assert verdicts == [("appears", "")] * 8


def test_a_variants_flags_and_options_are_a_sweeps():
    import sensitivity

    from r2h_batch.sweep import jobs
    from r2h_batch.sweep.options import parse
    from r2h_batch.sweep.request import requested

    found = {}
    for v in sensitivity.variants():
        request = requested(parse(["--method", *v.methods, *v.flags]))
        jobs.resolve(request)
        assert request.names == tuple(v.methods), v.name
        found[v.name] = replace(request, settings={})  # what they mean, however it is said
    # each says something that no other says
    same = [(a, b) for a in found for b in found if a < b and found[a] == found[b]]
    assert same == [] and len(found) == len(sensitivity.variants()) > 20


def test_readmes_table_says_who_is_better_from_both_sides():
    import json

    import families

    pair = {"a": "FC-Handover (oracle hand + noise)", "b": "Intent-Handover (retrieval + noise)"}
    other = {"a": "Contact-Handover (VoxNet)", "b": pair["a"], "verdict": "tied"}
    pairs = [pair | {"verdict": "worse here"}, other]
    assert families.beside("FC", pairs) == "tied with Contact; worse here than Intent"
    assert families.beside("Intent", pairs) == "better here than FC" and families.beside("random", pairs) == ""
    data = json.loads(families.STORED.read_text()) | {"unseen": ["81.2", "63.4", "tied with FC"]}
    found = families.table_one(data)
    titles = [line.split("|")[1].strip() for line in found.splitlines() if line.startswith("|")]
    assert titles[titles.index("Contact-Handover *") + 1] == "Contact-Handover, category not seen"
    assert "| Contact-Handover, category not seen | estimates | 81.2 | 63.4 | tied with FC |" in found
    row = next(r for r in data["table"]["rows"] if r["split"] == "S0" and r["method"] == "oracle")
    assert f"| oracle | judge | {row['sr']:.1f} ({row['sr_new_categories_low']:.1f}-" in found


def test_the_page_of_families_is_of_the_frozen_protocol_and_the_shipped_network():
    import json

    import families

    from r2h_batch import load_benchmark

    stored = json.loads(families.STORED.read_text())
    assert stored["table"]["origin"]["benchmark"].endswith(load_benchmark("r2h-v2").digest)
    assert stored["network"] == json.loads((ROOT / "assets/families/voxnet_axes.json").read_text())["sha256"]


def test_a_pair_of_methods_has_one_difference_on_the_page_of_families():
    import json

    import families

    data = json.loads(families.STORED.read_text())
    avg = {families.short(r["method"]): r["sr"] for r in data["table"]["rows"] if r["split"] == "Avg"}
    (whole,) = [c for c in data["compared"] if c["group"] == "all"]
    assert len(whole["pairs"]) == 6
    for pair in whole["pairs"]:
        a, b = families.short(pair["a"]), families.short(pair["b"])
        assert pair["difference"] == pytest.approx(avg[a] - avg[b])
