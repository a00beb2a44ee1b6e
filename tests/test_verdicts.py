"""The words of a verdict need the standard library only, and whoever reads stored rows needs neither torch nor Warp."""

import subprocess
import sys

from r2h_batch import types, verdicts

READERS = (
    "report.page",
    "runs.store",
    "commands.compare",
    "sweep.results.command",
    "sweep.results.rethreshold",
    "sweep.study.report",
)


def modules_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after running `code`."""
    code += "\nimport sys; print(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_reading_stored_rows_needs_neither_torch_nor_warp() -> None:
    every = "; ".join(f"import r2h_batch.{module}" for module in READERS)
    assert not {"torch", "warp", "mujoco", "jaxtyping"} & modules_after(every)


def test_verdicts_are_words_of_the_standard_library_and_types_offers_the_same_objects() -> None:
    loaded = modules_after("import r2h_batch.verdicts")
    assert not loaded - {"r2h_batch", "__main__"} - set(sys.stdlib_module_names) - modules_after("pass")
    for name in ("CRITERIA", "SPLITS", "SIDES", "Outcome", "PlanReason", "CollidingPair"):
        assert getattr(types, name) is getattr(verdicts, name)
