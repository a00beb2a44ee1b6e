"""Small calls that come back: their launches are recorded once, and run again without the code between
them.

A call of one row is mostly the way from kernel to kernel: memory is asked for, arguments are packed,
tables are looked up. A function that does nothing but launch kernels over its rows does the same each
time, so `RepeatedCalls` keeps what it launched, and the memory that was written. Only the addresses of
the inputs differ from call to call.

Nobody has to say which functions these are. A recording is refused where torch computes, where a
kernel runs over anything but the rows, or where an argument is neither memory of the recording nor
an input nor the same object as in the recording before. Such functions run as they are written.
"""

import ctypes
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.overrides import TorchFunctionMode

from r2h_batch.base.launch import cached
from r2h_batch.base.launch.arguments import bind, parameters, written_shapes
from r2h_batch.base.launch.threads import CHUNK, cpu_threads, share

PIECE_BYTES, ALIGNMENT = 1 << 13, 64
"""Working memory is taken in pieces of PIECE_BYTES a row, and starts at multiples of ALIGNMENT."""

TRIES = 4
"""So many calls of a size are recorded until two in a row are the same; then none is any more."""

FREE, SHARE = 16, 16
"""A thread records FREE calls and a SHARE-th of all: where sizes change all the time recording would
cost more than it saves."""


class RepeatedCalls:
    """Recordings of one function, for each thread and number of rows."""

    def __init__(self, sizes: int) -> None:
        """`sizes`: numbers of rows of which a thread keeps a recording."""
        self._sizes = sizes
        self._of_thread = threading.local()

    def __call__(self, function: Callable[..., Any], *inputs: Tensor) -> Any:
        """The function's result for contiguous tensors on the CPU with the same number of rows;
        the next call of this thread overwrites it."""
        cached.refuse_graph("a small call")
        thread = self._of_thread.__dict__.setdefault("calls", _Calls())
        return thread.call(function, inputs, self._sizes)


class _Calls:
    """The calls of one thread."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, int], _Size] = {}
        self._calls = self._recorded = 0

    def call(self, function: Callable[..., Any], inputs: tuple[Tensor, ...], sizes: int) -> Any:
        key = len(inputs[0]), len(inputs)
        # its own until it is put back: a signal's handler may score meanwhile, and an interrupt
        # loses it
        size = self._kept.pop(key, None) or _Size()
        self._calls += 1
        if size.last is not None and size.last.repeats:
            found = size.last.run(inputs)
        elif size.left and self._recorded < FREE + self._calls // SHARE:
            self._recorded += 1
            found = size.record(function, inputs)
        else:
            found = function(*inputs)
        self._kept[key] = size
        while len(self._kept) > sizes:
            del self._kept[next(iter(self._kept))]  # the one that was not used for longest
        return found


class _Size:
    """Calls with one number of rows."""

    def __init__(self) -> None:
        self.last: Recording | None = None
        self.left = TRIES

    def record(self, function: Callable[..., Any], inputs: tuple[Tensor, ...]) -> Any:
        """The function's result, with its launches recorded."""
        self.left -= 1
        new = Recording(inputs)
        with new.listening():
            new.result = function(*inputs)
        new.repeats = self.last is not None and self.last.same_as(new)
        self.last = None if new.refused else new
        return new.result


class _OfThread(threading.local):
    recording: "Recording | None" = None


_of_thread = _OfThread()


def current() -> "Recording | None":
    """The recording that this thread makes."""
    return _of_thread.recording


def refuse() -> None:
    """Something happens that a recording would not repeat."""
    if _of_thread.recording is not None:
        _of_thread.recording.refused = True


class Recording:
    """The launches of one call in order, and the memory that they write."""

    def __init__(self, inputs: Sequence[Tensor]) -> None:
        self.rows = len(inputs[0])
        self.refused = False
        self.repeats = False  # the call before went the same way
        self.result: Any = None
        self._spans = [(x.data_ptr(), x.data_ptr() + x.nbytes) for x in inputs]
        self._memory: list[Tensor] = []
        self._used = 0  # bytes of the last piece
        self._launches: list[tuple[cached.CachedLaunch, int]] = []
        self._given: list[tuple[Any, int]] = []  # descriptors of inputs, and of which
        self._way: list[tuple[Any, ...]] = []  # kernels, and what their arguments are
        self._objects: list[Any] = []  # arguments that stay, kept alive
        self._alone: list[tuple[Any, Any, Any]] = []  # the launches as one thread makes them

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Around the call: launches go through `launch`, and torch's work is noticed."""
        before, _of_thread.recording = _of_thread.recording, self
        try:
            with _TorchWork():
                yield
        finally:
            _of_thread.recording = before
        self._alone = [
            (x.forward, x.bounds(self.rows, width), ctypes.byref(x.arguments))
            for x, width in self._launches
        ]

    def same_as(self, other: "Recording") -> bool:
        """Whether both went the same way; only inputs and memory may differ."""
        return not (self.refused or other.refused) and self._way == other._way

    def launch(
        self,
        kernel: Any,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any],
        sizes: Mapping[str, int | tuple[int, ...]],
        width: int,
    ) -> dict[str, Any]:
        """Runs a kernel over all rows on this thread; what it wrote to."""
        written = {
            name: self._take(shape, dtype)
            for name, _, shape, dtype in written_shapes(kernel, self.rows, sizes, outputs)
        }
        written.update(outputs)
        args = [0, *bind(kernel, inputs, written, "cpu", trials=self.rows)]
        packed = cached.pack(kernel, args, inputs, written)
        if packed is None:  # another Warp
            self.refused = True
            dim = (self.rows, width) if width > 1 else self.rows
            wp.launch(kernel, dim=dim, inputs=args, device="cpu")
            return written
        places = []
        for p in parameters(kernel):
            place = self._place((written if p.written else inputs)[p.name])
            places.append(place)
            if place[0] == "input":
                self._given.append((getattr(packed.arguments, p.label), place[1]))
        self._way.append((kernel, width, *places))
        self._launches.append((packed, width))
        packed.run(0, 0, self.rows, width)
        return written

    def run(self, inputs: Sequence[Tensor]) -> Any:
        """The same launches for other inputs: what the call returned, with their numbers."""
        for piece in self._memory:  # outputs that a kernel leaves out are zeros, as in new memory
            piece.zero_()
        for descriptor, i in self._given:
            descriptor.data = inputs[i].data_ptr()
        workers = min(cpu_threads(), -(-self.rows // CHUNK))
        if workers > 1:
            for packed, _ in self._launches:
                packed.prepare(workers)
            share(self._piece, 0, self.rows, workers, None)
        else:
            for forward, bounds, arguments in self._alone:
                forward(bounds, arguments)
        return self.result

    def _piece(self, worker: int, first: int, rows: int) -> None:
        for packed, width in self._launches:
            packed.run(worker, first, rows, width)

    def _take(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Zeros that this recording keeps."""
        needed = dtype.itemsize * prod(shape)
        refused = self.refused  # it is not the call that works here
        with torch.inference_mode(False):  # or it could not be written outside of that mode
            if not self._memory or self._used + needed > len(self._memory[-1]):
                piece = max(needed, PIECE_BYTES * self.rows)
                self._memory.append(torch.zeros(piece, dtype=torch.uint8, device="cpu"))
                self._used = 0
            part = self._memory[-1][self._used : self._used + needed].view(dtype).view(shape)
        self.refused = refused
        self._used += -(-needed // ALIGNMENT) * ALIGNMENT
        return part

    def _place(self, value: Any) -> tuple[Any, ...]:
        """The kind of an argument: this recording's memory, an input, a number, or an object that
        stays."""
        if isinstance(value, Tensor):
            start = value.data_ptr()
            for i, piece in enumerate(self._memory):
                if 0 <= start - piece.data_ptr() < len(piece):
                    return "own", i, start - piece.data_ptr(), value.shape
            of = [i for i, (low, high) in enumerate(self._spans) if low <= start < high]
            if of:
                # the kernel takes a part of an input, or inputs overlap
                self.refused |= len(of) > 1 or start != self._spans[of[0]][0]
                return "input", of[0]
        elif isinstance(value, (int, float)):
            return type(value), value
        elif isinstance(tensors := getattr(value, "tensors", None), dict):  # of `struct_of`
            places = [self._place(x) for x in tensors.values()]
            self.refused |= any(place[0] == "input" for place in places)
            return type(value), *places
        self._objects.append(value)
        return "object", id(value)


_VIEWS = frozenset(
    {Tensor.__getitem__, Tensor.contiguous, Tensor.detach, Tensor.flatten, Tensor.to, Tensor.view}
)
"""Methods that mostly return a view of their tensor, and otherwise compute."""

_LAYOUT = frozenset(
    {
        Tensor.__len__,
        Tensor.data_ptr,
        Tensor.dim,
        Tensor.element_size,
        Tensor.get_device,
        Tensor.is_contiguous,
        Tensor.numel,
        Tensor.size,
        Tensor.stride,
        Tensor.untyped_storage,
    }
)
"""Methods that say where a tensor's memory is and how it is laid out, beside the getters of
attributes."""


class _TorchWork(TorchFunctionMode):
    """Notices what torch computes, and what is asked of a tensor's numbers; views of memory are
    neither."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        found = func(*args, **(kwargs or {}))
        if func in _VIEWS:
            if found.untyped_storage().data_ptr() != args[0].untyped_storage().data_ptr():
                refuse()
        elif func not in _LAYOUT and getattr(func, "__name__", "") != "__get__":
            refuse()
        return found
