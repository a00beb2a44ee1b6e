"""Looking at trials in a browser, a notebook, films and strips (extra `view`)."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.view.page import show as show
    from r2h_batch.view.page import write_page as write_page

__all__ = ["show", "write_page"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(__name__, {"show": "page", "write_page": "page"})
