"""Looking at trials: a viewer, pages, videos, strips, notebooks (extra `view`). Names are loaded
when they are asked for."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from r2h_batch.view.notebook import show as show
    from r2h_batch.view.page import write_page as write_page

__all__ = ["show", "write_page"]

_FROM = {"show": "notebook", "write_page": "page"}


def __getattr__(name: str) -> Any:
    if name not in _FROM:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_FROM[name]}"), name)
