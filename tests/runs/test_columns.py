"""The table of columns: schemas, documentation and the reading of older rows follow it."""

import importlib
from pathlib import Path

import pytest
from rounds import each

from r2h_batch.base.package import VERSION
from r2h_batch.closed_loop.env import End
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.runs.columns import ENDS, TABLES, later, schema_of_kind
from r2h_batch.runs.store import load_run

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.check
def test_the_page_of_files_has_a_place_for_each_table_and_each_table_has_every_column(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(ROOT / "tools")
    columns = importlib.import_module("columns")
    text = (ROOT / "docs" / "run_folder.md").read_text(encoding="utf-8")
    assert sorted(columns.PLACE.findall(text)) == sorted(TABLES)
    shown = columns.on_page_markdown(text)
    assert "<!-- columns" not in shown
    for kind, listed in each(TABLES.items()):
        table = columns.table(listed)
        assert table in shown and all(f"`{c.name}`" in table and c.meaning in table for c in listed), kind


def test_every_column_says_what_it_means_and_its_unit_agrees_with_its_name() -> None:
    endings = {"_m": "m", "_s": "s", "_deg": "deg", "_m_s": "m/s", "q": "rad"}
    for kind, columns in TABLES.items():
        names = [c.name for c in columns]
        assert len(set(names)) == len(names) and names[0] == "trial_id", kind
        for column in columns:
            assert column.meaning and not column.meaning.endswith("."), column.name
            unit = next((endings[e] for e in sorted(endings, key=len, reverse=True) if column.name.endswith(e)), None)
            assert unit in (None, column.unit), f"{kind}: {column.name} is in {column.unit!r}"
            assert column.nullable or not column.since, f"{kind}: {column.name}: older rows lack it, so it may be null"
            first = tuple(map(int, column.since.split("."))) if column.since else ()
            assert first <= tuple(map(int, VERSION.split("."))), f"{column.name} is of a version that no run.json names"


def test_postures_are_as_long_as_the_arm_has_joints_and_nothing_else_changes() -> None:
    for kind in TABLES:
        six, seven = schema_of_kind(kind), schema_of_kind(kind, 7)
        assert six.names == seven.names
        longer = {a.name for a, b in zip(six, seven) if a.type != b.type}
        assert longer == {"q_goal", "q", "executed_q", "planned_q"} & set(six.names)
        assert all(str(seven.field(name).type).count("[7]") == 1 for name in longer)


def test_shipped_rows_hold_every_column_of_the_table_or_one_that_came_later() -> None:
    for folder in each(stored_rows()):
        run = load_run(folder, verify=False)
        for shard in (s for entry in run.entries for s in entry.shards.values()):
            for kind in each(shard.kinds):
                names = schema_of_kind(kind).names
                assert set(names) - set(shard.table(kind, names).schema.names) <= set(later(kind)), folder
        table = run.trials(run.methods[0])
        assert table.schema.names == schema_of_kind("trials", asks=run.header.get("asks", ())).names


def test_the_ends_of_episodes_are_those_of_the_closed_loop() -> None:
    assert tuple(end.name.lower() for end in End) == ENDS
