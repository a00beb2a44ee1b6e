"""Names that a package imports when they are first used: the garbage collector rests meanwhile, and no longer."""

import gc
import sys

import pytest

from r2h_batch.base.package import lazy_names


@pytest.mark.parametrize("works", [True, False])
def test_the_collector_rests_during_an_import_and_is_as_before_afterwards(works, tmp_path, monkeypatch):
    (tmp_path / "rested").mkdir()
    (tmp_path / "rested" / "__init__.py").write_text("")
    (tmp_path / "rested" / "part.py").write_text("import gc\ncollects = gc.isenabled()\n")
    (tmp_path / "rested" / "wrong.py").write_text("raise RuntimeError('no such luck')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("rested", "rested.part", "rested.wrong"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    find, names = lazy_names("rested", {"collects": "part", "thing": "wrong"})
    before = gc.isenabled()
    try:
        (gc.enable if works else gc.disable)()
        assert find("collects") is False and gc.isenabled() is works
        with pytest.raises(RuntimeError, match="luck"):
            find("thing")
        assert gc.isenabled() is works and names() == ["collects", "thing"]
    finally:
        (gc.enable if before else gc.disable)()


def test_what_an_import_made_is_old_and_what_a_program_froze_stays_frozen(tmp_path, monkeypatch):
    (tmp_path / "aging").mkdir()
    (tmp_path / "aging" / "__init__.py").write_text("")
    for name in ("first", "second"):
        (tmp_path / "aging" / f"{name}.py").write_text("made = [[]]\n")
    monkeypatch.syspath_prepend(tmp_path)
    find, _ = lazy_names("aging", {"first": "first", "second": "second"})
    assert gc.get_freeze_count() == 0
    made = find("first").made
    assert any(x is made for x in gc.get_objects(generation=2))
    gc.freeze()
    try:
        find("second")
        assert gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()
