"""The package itself: its version, the folders of its modules, names that it imports when first used."""

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

VERSION = "0.4.0"

ROOT = Path(__file__).resolve().parents[1]
"""r2h_batch/."""

FOLDERS = (ROOT,) if (ROOT / "kernels").exists() else (ROOT, ROOT.parent)
"""Where modules of r2h_batch are found. In a wheel kernels/ and assets/ stand inside the package; in a checkout or an editable
install they stand beside it."""


def lazy_names(
    package: str, home: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that offers names of its modules: imported when
    first used.

    `--help` must not wait for torch and Warp. Type checkers read the imports that stand under
    TYPE_CHECKING in the same file.

    Args:
        package: its dotted name.
        home: public name -> module, relative to the package; a module's own name stands for the
            module.

    Returns:
        `__getattr__` and `__dir__`.
    """

    def find(name: str) -> object:
        if name not in home:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}; it has {', '.join(sorted(home))}"
            )
        with _no_collection():
            module = import_module(f".{home[name]}", package)
        return module if home[name].rpartition(".")[2] == name else getattr(module, name)

    return find, lambda: sorted(home)


@contextmanager
def _no_collection() -> Iterator[None]:
    """The cyclic garbage collector rests inside: importing makes many objects and no garbage, and searching them
    again and again takes a quarter of the time. After it they are old, as if they had been searched."""
    works = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if works:
            if gc.get_freeze_count() == 0:
                gc.freeze()  # puts all objects aside,
                gc.unfreeze()  # and among the oldest
            gc.enable()
