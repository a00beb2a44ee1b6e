"""Small calls that come back: the memory and the packed launches of the last call of that size are
used again.

A call of one row is mostly the way from kernel to kernel: memory is asked for, arguments are packed,
tables are looked up. Inside `RepeatedCalls` the k-th launch of a call is compared with the k-th of
the call before. Where all arguments are the same objects, it runs as it stands; what differs is
packed anew. Stages are written as if nothing were kept: torch may work between the launches, and a
call that goes another way packs its launches from there on.
"""

import ctypes
import threading
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from itertools import compress
from operator import is_
from typing import Any, cast

import torch
import warp as wp
from torch import Tensor

from r2h_batch.base.launch import cached
from r2h_batch.base.launch.arguments import TensorLayoutGuard, bind, parameters, written_shapes

CHUNK_BYTES, ALIGNMENT = 1 << 13, 64
"""Working memory of a row is taken in pieces of CHUNK_BYTES, and starts at multiples of
ALIGNMENT."""


class RepeatedCalls:
    """Memory and launches of an evaluator's small calls, for each thread and number of rows.

    What launches return inside is overwritten by the next call of that thread: a result that
    somebody keeps is written to `outputs` of its own.
    """

    def __init__(self, sizes: int) -> None:
        """`sizes`: numbers of rows of which a thread keeps a call."""
        self._sizes = sizes
        self._of_thread = threading.local()

    @contextmanager
    def of(self, rows: int) -> Iterator[None]:
        """Around a call of so many rows."""
        kept = cast(dict[int, RepeatedCall], self._of_thread.__dict__)
        # its own until it is put back: a signal's handler may score meanwhile, and an interrupt
        # loses it
        call = kept.pop(rows, None) or RepeatedCall(rows)
        before, _of_thread.call = _of_thread.call, call
        try:
            call.begin()
            yield
        finally:
            _of_thread.call = before
        if call.strayed:
            return
        kept[rows] = call
        while len(kept) > self._sizes:
            del kept[next(iter(kept))]  # the one that was not used for longest


class _OfThread(threading.local):
    call: "RepeatedCall | None" = None


_of_thread = _OfThread()


def current() -> "RepeatedCall | None":
    """The small call that this thread is in."""
    return _of_thread.call


def made_once(make: Callable[..., Any], *arguments: Any) -> Any:
    """`make(*arguments)`; in a repeated call what it made before of the same objects."""
    call = _of_thread.call
    return make(*arguments) if call is None else call.value(make, arguments)


class RepeatedCall:
    """The launches of one call of `rows` rows, in order, and the memory that they write."""

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.strayed = False  # went another way than the call before: its memory would pile up
        self._sites: list[_Launch | _Value] = []
        self._place = 0
        self._memory: list[Tensor] = []
        self._used = 0  # bytes of the last piece
        self._own: dict[int, Tensor] = {}  # tensors of this memory, by id

    def begin(self) -> None:
        """Before its first launch: outputs that a kernel leaves out are zeros, as in new memory."""
        cached.refuse_graph("a small call")
        self._place = 0
        for piece in self._memory:
            piece.zero_()

    def launch(
        self,
        kernel: Any,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any] | None,
        sizes: Mapping[str, int | tuple[int, ...]],
        width: int,
    ) -> dict[str, Any]:
        """Runs a kernel over all rows on this thread; what it wrote to."""
        site = self._next()
        if not (isinstance(site, _Launch) and site.fits(kernel, sizes, width, outputs)):
            made = {
                name: self._take(shape, dtype)
                for name, _, shape, dtype in written_shapes(kernel, self.rows, sizes, outputs or ())
            }
            site = self._put(_Launch(kernel, sizes, width, made, outputs))
        return site.run(inputs, outputs, self.rows, self._own)

    def value(self, make: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """As `made_once`."""
        site = self._next()
        if not (isinstance(site, _Value) and site.fits(make, arguments)):
            own = all(id(x) in self._own for x in arguments if isinstance(x, Tensor))
            site = self._put(_Value(make, arguments, own))
            if own and isinstance(site.value, Tensor):
                self._own[id(site.value)] = site.value
        return site.value

    def _next(self) -> "_Launch | _Value | None":
        place = self._place
        self._place = place + 1
        return self._sites[place] if place < len(self._sites) else None

    def _put(self, site: Any) -> Any:
        if self._place <= len(self._sites):
            self.strayed = True
            del self._sites[self._place - 1 :]
        self._sites.append(site)
        return site

    def _take(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Zeros that this call keeps."""
        needed = dtype.itemsize
        for n in shape:
            needed *= n
        if not self._memory or self._used + needed > len(self._memory[-1]):
            piece = max(needed, CHUNK_BYTES * self.rows)
            with torch.inference_mode(False):  # or it could not be written outside of that mode
                self._memory.append(torch.zeros(piece, dtype=torch.uint8, device="cpu"))
            self._used = 0
        with torch.inference_mode(False):
            part = self._memory[-1][self._used : self._used + needed].view(dtype).view(shape)
        self._used += -(-needed // ALIGNMENT) * ALIGNMENT
        self._own[id(part)] = part
        return part


class _Value:
    """A result of `made_once`; `own`: no memory among them moves."""

    def __init__(self, make: Callable[..., Any], arguments: tuple[Any, ...], own: bool) -> None:
        self._make, self._arguments, self._own = make, arguments, own
        self.value = make(*arguments)

    def fits(self, make: Callable[..., Any], arguments: tuple[Any, ...]) -> bool:
        return (
            self._own
            and make is self._make
            and len(arguments) == len(self._arguments)
            and all(map(is_, arguments, self._arguments))
        )


class _Launch:
    """A kernel with its arguments, packed as the compiled function takes them. Arguments that the
    call keeps (its own memory, tables, numbers) are compared as objects; the memory of other tensors
    may move, and their addresses are written each time."""

    def __init__(
        self,
        kernel: Any,
        sizes: Mapping[str, Any],
        width: int,
        made: dict[str, Tensor],
        outputs: Mapping[str, Any] | None,
    ) -> None:
        self._kernel, self._sizes, self._width, self._made = kernel, sizes, width, made
        self._given = () if outputs is None else tuple(outputs)
        self._names: tuple[str, ...] = ()
        self._packed: cached.CachedLaunch | None = None

    def fits(
        self, kernel: Any, sizes: Mapping[str, Any], width: int, outputs: Mapping[str, Any] | None
    ) -> bool:
        given = () if outputs is None else tuple(outputs)
        same = kernel is self._kernel and width == self._width and given == self._given
        return same and sizes == self._sizes

    def run(
        self,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any] | None,
        rows: int,
        own: Container[int],
    ) -> dict[str, Any]:
        written = self._made if outputs is None else {**self._made, **outputs}
        names, values = (*inputs, *written), (*inputs.values(), *written.values())
        if names != self._names or not self._refill(values):
            self._pack(inputs, written, rows, own)
            if self._packed is None:  # another Warp
                return written
            self._names = names
        self._forward(self._bounds, self._arguments)
        return written

    def _pack(
        self, inputs: Mapping[str, Any], written: Mapping[str, Any], rows: int, own: Container[int]
    ) -> None:
        args = [0, *bind(self._kernel, inputs, written, "cpu", trials=rows)]
        self._packed = packed = cached.pack(self._kernel, args, inputs, written)
        if packed is None:
            dim = (rows, self._width) if self._width > 1 else rows
            wp.launch(self._kernel, dim=dim, inputs=args, device="cpu")
            return
        values = (*inputs.values(), *written.values())
        moves = [isinstance(x, Tensor) and id(x) not in own for x in values]
        self._stay = [not x for x in moves]
        self._kept = tuple(compress(values, self._stay))
        self._moves, moving = moves, list(compress(values, moves))
        self._alike = TensorLayoutGuard(moving) if moving else None
        # an input and an output may have one name
        labels = {(p.name, p.written): p.label for p in parameters(self._kernel)}
        label = [labels[name, False] for name in inputs] + [labels[name, True] for name in written]
        self._descriptors = [getattr(packed.arguments, x) for x in compress(label, moves)]
        self._forward, packed.arguments.first = packed.forward, 0
        self._bounds = packed.bounds(rows, self._width)
        self._arguments = ctypes.byref(packed.arguments)

    def _refill(self, values: tuple[Any, ...]) -> bool:
        """Whether the packed arguments now stand for these values."""
        staying = values if self._alike is None else tuple(compress(values, self._stay))
        if not all(map(is_, staying, self._kept)) and not all(map(_same, staying, self._kept)):
            return False
        if self._alike is None:
            return True
        moving = list(compress(values, self._moves))
        if not self._alike(moving):
            return False
        for descriptor, value in zip(self._descriptors, moving):
            descriptor.data = value.data_ptr()
        return True


def _same(a: object, b: object) -> bool:
    """The same object, or the same whole number: Python makes larger ones anew each time."""
    return a is b or (type(a) is int and type(b) is int and a == b)
