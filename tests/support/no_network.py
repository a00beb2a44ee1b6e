"""Work in a fork of this process that has no network: it need not import and build everything again."""

import ctypes
import multiprocessing
from collections.abc import Callable

NEW_USER, NEW_NETWORK = 0x10000000, 0x40000000
"""Linux: CLONE_NEWUSER, CLONE_NEWNET. `@needs("unshare")` says whether they are allowed here."""


def _cut_off(work: Callable[..., object], arguments: tuple[object, ...]) -> None:
    unshare = ctypes.CDLL(None).unshare
    if unshare(NEW_NETWORK) and unshare(NEW_USER | NEW_NETWORK):
        raise OSError("the network cannot be taken away here")
    work(*arguments)


def without_network(work: Callable[..., object], *arguments: object, seconds: float = 600) -> None:
    """`work(*arguments)` where not even this machine's own addresses answer. It must not raise or exit with a code."""
    child = multiprocessing.get_context("fork").Process(target=_cut_off, args=(work, arguments))
    child.start()
    child.join(seconds)
    child.kill()
    assert child.exitcode == 0, child.exitcode
