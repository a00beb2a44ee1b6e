"""Launches that are repeated on a CPU: a thread keeps what it packed for a kernel, and fills in the next call's memory.

Packing a kernel's arguments anew costs more than a small batch's arithmetic: some 30 microseconds a launch. The second
call of a kernel mostly differs in addresses, and in how many rows there are; these are written into the descriptors that
are there. Whatever else differs (dimensions, kinds, names, a struct) is packed, and refused, as the first time.
"""

import copy
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import warp as wp
from torch import Tensor

from r2h_batch.launch.arguments import Parameter, parameters

MOST_KERNELS = 256
"""A thread that has launched more kernels (tests make their own) forgets those that it did not use last."""


class Repeated:
    """One kernel's launch, as one thread repeats it: a command for each worker, all on the same descriptors."""

    def __init__(
        self, kernel: Any, packed: Sequence[Any], inputs: Mapping[str, Any], outputs: Mapping[str, Any]
    ) -> None:
        """`packed`: all arguments in the kernel's order, as `bind` packs them, `first` before them."""
        self.kernel = kernel
        self.packed: wp.Launch = wp.launch(kernel, dim=1, inputs=list(packed), device="cpu", record_cmd=True)
        self.packed.fwd_args = None  # the tables of a scene that is gone are not kept for a launch that may never come
        self.sizes = (len(inputs), len(outputs))
        self.commands: list[wp.Launch] = []
        self.rows: list[int] = []  # each command's trials
        self.width = 1
        self.tensors: list[list[Any]] = []
        self.others: list[list[Any]] = []
        for i, p in enumerate(parameters(kernel), start=1):
            value = (outputs if p.written else inputs)[p.name]
            if p.array is not None and type(value) is Tensor:
                self.tensors.append([p.name, p.written, p.array.torch, value.shape, packed[i]])
            else:
                self.others.append([p.name, p.written, p, i, _known(p, value)])

    def refill(self, inputs: Mapping[str, Any], outputs: Mapping[str, Any], rows: int) -> bool:
        """Whether the commands now stand for these arguments; if not, they have to be packed anew (or refused)."""
        if (len(inputs), len(outputs)) != self.sizes:
            return False
        for slot in self.tensors:
            name, written, dtype, shape, descriptor = slot
            value = (outputs if written else inputs).get(name)
            # a kind of tensor of its own may say anything of itself: it is looked at with care
            if type(value) is not Tensor or value.dtype is not dtype or not value.is_cpu or not value.is_contiguous():
                return False
            given = value.shape
            if given != shape:
                if given[1:] != shape[1:]:
                    return False
                slot[3] = given
                descriptor.shape[0] = given[0]  # of contiguous memory no stride depends on it
            if written and given[0] < rows:
                return False
            descriptor.data = value.data_ptr()
        for slot in self.others:
            name, written, p, i, known = slot
            value = (outputs if written else inputs).get(name)
            if value is None:
                return False
            if known() is value:
                continue
            packed = p.pack(p, value, _cpu(), rows)
            if type(packed) is int or type(packed) is float:
                self.packed.params[i + 1].value = packed  # shared by all commands
            else:
                for command in (self.packed, *self.commands):
                    command.set_param_at_index(i, packed)
            slot[4] = _known(p, value)
        return True

    def prepare(self, workers: int, rows: int, width: int) -> None:
        """Commands for so many workers."""
        if width != self.width:
            self.commands, self.rows, self.width = [], [], width
        dim = (rows, width) if width > 1 else rows
        while len(self.commands) < workers:
            made = copy.copy(self.packed)
            made.params = list(made.params)
            made.set_param_at_index(0, 0)  # a number of its own: the others are shared
            made.set_dim(dim)
            self.commands.append(made)
            self.rows.append(rows)

    def run(self, worker: int, first: int, rows: int, width: int) -> None:
        """Runs trials first..first+rows-1 on the calling thread, which is `worker` for as long."""
        if width != self.width or worker >= len(self.commands):
            self.prepare(worker + 1, rows, width)
        command = self.commands[worker]
        if self.rows[worker] != rows:
            self.rows[worker] = rows
            command.set_dim((rows, width) if width > 1 else rows)
        command.set_param_at_index_from_ctype(0, first)
        command.launch()


def _known(p: Parameter, value: Any) -> Callable[[], Any]:
    """What was packed, to be known again by identity; what owns memory is not kept alive for that."""
    if isinstance(value, wp.array) or hasattr(p.type, "vars"):
        return weakref.ref(value)  # its descriptor is the one that was packed, and its memory does not move
    if p.array is not None:
        return _nothing  # an array of NumPy, a tensor of a class of its own: what it says now may not hold later
    return lambda: value


def _nothing() -> None:
    return None


def _cpu() -> Any:
    return wp.get_device("cpu")


_of_thread = threading.local()


def taken(kernel: Any) -> Repeated | None:
    """What this thread has packed for a kernel, if anything; its own until `kept`, so that an interrupt loses it only."""
    found: Repeated | None = _kernels().pop(kernel, None)
    return found


def kept(repeated: Repeated) -> None:
    """Puts it back: nobody is using its descriptors any more."""
    kernels = _kernels()
    while len(kernels) >= MOST_KERNELS:
        del kernels[next(iter(kernels))]  # in the order of their last use
    kernels[repeated.kernel] = repeated


def _kernels() -> dict[Any, Repeated]:
    if not hasattr(_of_thread, "kernels"):
        _of_thread.kernels = {}
    kernels: dict[Any, Repeated] = _of_thread.kernels
    return kernels
