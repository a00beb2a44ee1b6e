"""Looking at trials in a browser, a notebook, films and strips (extra `view`); trials as files of
other programs."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.view.page import show
    from r2h_batch.view.why import explain

__all__ = ["explain", "show"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(__name__, {"explain": "why", "show": "page"})
