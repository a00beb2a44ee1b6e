"""Launches on a CPU that a thread keeps: the next call of a kernel writes its addresses into packed
arguments.

Packing the arguments of a kernel takes about 30 microseconds, more than a small batch computes
(2.35 against 0.60 ms for a call of one row). The second call of a kernel mostly differs in
addresses and in the number of rows. Whatever else differs (dimensions, types, names, a struct) is
packed, and refused, as the first time.

This reads privates of `wp.Launch` (Warp 1.19): the compiled function, the packed parameters and the
bounds. Where they are missing, `launch_trials` calls `wp.launch` for each chunk instead.
"""

import copy
import ctypes
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from operator import itemgetter
from typing import Any

import warp as wp
from torch import Tensor

from r2h_batch.launch.arguments import Parameter, TensorLayoutGuard, parameters

MOST_KERNELS = 256
"""A thread that has launched more kernels (tests make their own) forgets those that it did not use
last."""


MOST_SIZES = 64
"""Numbers of trials (with widths) whose bounds a kernel's launch remembers."""


PRIVATES = ("hooks", "params", "bounds", "fwd_args")
"""Attributes of a recorded `wp.Launch` that `CachedLaunch` reads."""


def pack(
    kernel: Any, packed: Sequence[Any], inputs: Mapping[str, Any], outputs: Mapping[str, Any]
) -> "CachedLaunch | None":
    """The launch of a kernel, kept; None where this Warp has not the privates for it.

    `packed`: all arguments in the order of the kernel, as `bind` packs them, `first` before them.
    """
    command = wp.launch(kernel, dim=1, inputs=list(packed), device="cpu", record_cmd=True)
    if not all(hasattr(command, name) for name in PRIVATES):
        return None
    return CachedLaunch(kernel, command, inputs, outputs)


class CachedLaunch:
    """One kernel's launch, as one thread repeats it: all arguments in one structure, and a copy of
    it for each other worker.

    The compiled function takes two pointers, to the launch's bounds and to its arguments side by
    side. `wp.Launch` puts them side by side anew at each launch; here they stay, and an array's
    descriptor among them is written where it stands.
    """

    def __init__(
        self,
        kernel: Any,
        command: wp.Launch,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any],
    ) -> None:
        """`command`: a launch of the kernel with these arguments, recorded by Warp."""
        self.kernel = kernel
        self.packed = command
        self.packed.fwd_args = None  # or the tables of a scene that is gone would be kept
        self.forward = self.packed.hooks.forward
        labels = [a.label for a in kernel.adj.args]
        packed = self.packed.params[1:]
        self.arguments = _structure(tuple(labels), tuple(type(x) for x in packed))(*packed)
        self.copies: list[ctypes.Structure] = [self.arguments]  # each worker's
        self.bounds: dict[tuple[int, int], Any] = {}
        self.sizes = (len(inputs), len(outputs))
        self.tensors: list[tuple[bool, Any, Any]] = []  # is written, data type, descriptor
        self.structs: list[list[Any]] = []
        self.others: list[list[Any]] = []
        values: list[Tensor] = []
        names: tuple[list[str], list[str]] = ([], [])
        for p in sorted(parameters(kernel), key=lambda p: p.written):
            value = (outputs if p.written else inputs)[p.name]
            here = getattr(self.arguments, p.label)
            if p.array is not None and type(value) is Tensor:
                self.tensors.append((p.written, p.array.torch, here))
                names[p.written].append(p.name)
                values.append(value)
            elif _is_struct(p):
                self.structs.append([p.name, p.written, p, _known(p, value)])
            else:
                self.others.append([p.name, p.written, p, _known(p, value)])
        self.of_inputs, self.of_outputs = (_values(n) for n in names)
        self._keep(values)

    def _keep(self, values: Sequence[Tensor]) -> None:
        """These are what the descriptors stand for, but for their addresses."""
        self.shapes = [x.shape for x in values]
        self.alike = TensorLayoutGuard(values)
        written = [
            x.shape[0] for x, (written, _, _) in zip(values, self.tensors, strict=True) if written
        ]
        self.rows = min(written, default=sys.maxsize)

    def refill(self, inputs: Mapping[str, Any], outputs: Mapping[str, Any], rows: int) -> bool:
        """Whether the launch now stands for these arguments; if not, they have to be packed anew
        (or refused)."""
        if (len(inputs), len(outputs)) != self.sizes:
            return False
        try:
            values = self.of_inputs(inputs) + self.of_outputs(outputs)
        except KeyError:
            return False
        if not self.alike(values) and not self._reshape(values):
            return False
        if rows > self.rows:
            return False
        for (_, _, descriptor), value in zip(self.tensors, values, strict=True):
            descriptor.data = value.data_ptr()
        for slot in self.structs:
            name, written, p, known = slot
            value = (outputs if written else inputs).get(name)
            if value is None:
                return False
            if known() is not value:
                p.pack(p, value, cpu(), rows)
                slot[3] = _known(p, value)
            setattr(self.arguments, p.label, value.__ctype__())  # its numbers may have changed
        for slot in self.others:
            name, written, p, known = slot
            value = (outputs if written else inputs).get(name)
            if value is None:
                return False
            if known() is value:
                continue
            packed = p.pack(p, value, cpu(), rows)
            setattr(
                self.arguments,
                p.label,
                packed.__ctype__() if isinstance(packed, wp.array) else packed,
            )
            slot[3] = _known(p, value)
        return True

    def _reshape(self, values: Sequence[Any]) -> bool:
        """Whether these differ in their numbers of rows alone; the descriptors have them then."""
        for (_, dtype, descriptor), known, value in zip(
            self.tensors, self.shapes, values, strict=True
        ):
            # a kind of tensor of its own may say anything of itself: it is looked at with care
            if (
                type(value) is not Tensor
                or value.dtype is not dtype
                or not value.is_cpu
                or not value.is_contiguous()
            ):
                return False
            if value.shape[1:] != known[1:] or len(value.shape) != len(known):
                return False
            descriptor.shape[0] = value.shape[0]  # of contiguous memory no stride depends on it
        self._keep(values)
        return True

    def prepare(self, workers: int) -> None:
        """The arguments as they are now, for so many workers."""
        while len(self.copies) < workers:
            self.copies.append(type(self.arguments)())
        for copied in self.copies[1:workers]:
            ctypes.memmove(
                ctypes.addressof(copied), ctypes.addressof(self.arguments), ctypes.sizeof(copied)
            )

    def run(self, worker: int, first: int, rows: int, width: int) -> None:
        """Runs trials first..first+rows-1 on the calling thread, which is `worker` for as long."""
        arguments = self.copies[worker]
        arguments.first = first
        self.forward(
            self.bounds.get((rows, width)) or self._bounds(rows, width), ctypes.byref(arguments)
        )

    def _bounds(self, rows: int, width: int) -> Any:
        """A pointer to the bounds of so many trials, which a launch only reads; several workers may
        ask at once."""
        if len(self.bounds) >= MOST_SIZES:
            self.bounds.clear()
        made = copy.copy(self.packed)
        made.params = list(made.params)
        made.set_dim((rows, width) if width > 1 else rows)
        pointer = self.bounds[rows, width] = ctypes.byref(made.bounds)
        return pointer


@cache
def _structure(labels: tuple[str, ...], kinds: tuple[type, ...]) -> type[ctypes.Structure]:
    """Arguments side by side, as the compiled function of a kernel with these parameters takes
    them."""
    return type(
        "Arguments", (ctypes.Structure,), {"_fields_": list(zip(labels, kinds, strict=True))}
    )


def _values(names: Sequence[str]) -> Callable[[Mapping[str, Any]], tuple[Any, ...]]:
    """What takes these from a mapping; KeyError where one is missing."""
    if len(names) > 1:
        return itemgetter(*names)
    return lambda mapping: tuple(mapping[name] for name in names)


def _known(p: Parameter, value: Any) -> Callable[[], Any]:
    """What was packed, to be known again by identity; what owns memory is not kept alive for
    that."""
    if isinstance(value, wp.array) or _is_struct(p):
        # its descriptor is the one that was packed, and its memory does not move
        return weakref.ref(value)
    if p.array is not None:
        # an array of NumPy, a tensor of a class of its own: what it says now may not hold later
        return _nothing
    return lambda: value


def _is_struct(p: Parameter) -> bool:
    return p.array is None and hasattr(p.type, "vars")


def _nothing() -> None:
    return None


@cache
def cpu() -> Any:
    """Warp's name for this machine's own cores."""
    return wp.get_device("cpu")


def refuse_graph(name: str) -> None:
    """RuntimeError while Warp records a graph on the CPU."""
    if cpu().is_capturing:
        raise RuntimeError(
            f"Warp records a graph on the CPU, and {name} would be missing in it: it runs on threads of its own; call "
            "it before or after the recording (Evaluator.capture records calls on a GPU)"
        )


_of_thread = threading.local()


def taken(kernel: Any) -> CachedLaunch | None:
    """What this thread has packed for a kernel, if anything; its own until `kept`, so that an
    interrupt loses it only."""
    found: CachedLaunch | None = _kernels().pop(kernel, None)
    return found


def kept(repeated: CachedLaunch) -> None:
    """Puts it back: no launch uses its descriptors any more."""
    kernels = _kernels()
    while len(kernels) >= MOST_KERNELS:
        del kernels[next(iter(kernels))]  # in the order of their last use
    kernels[repeated.kernel] = repeated


def _kernels() -> dict[Any, CachedLaunch]:
    if not hasattr(_of_thread, "kernels"):
        _of_thread.kernels = {}
    kernels: dict[Any, CachedLaunch] = _of_thread.kernels
    return kernels
