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
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import warp as wp
from torch import Tensor

from r2h_batch.base.launch.arguments import Parameter, TensorLayoutGuard, parameters

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
        self.bounds = lru_cache(MOST_SIZES)(self._bounds)
        self.sizes = (len(inputs), len(outputs))
        self.tensors: list[tuple[str, bool, Any, Any]] = []  # name, written, data type, descriptor
        self.others: list[tuple[str, bool, Parameter]] = []
        values: list[Tensor] = []
        for p in parameters(kernel):
            value = (outputs if p.written else inputs)[p.name]
            argument = getattr(self.arguments, p.label)
            if p.array is not None and type(value) is Tensor:
                self.tensors.append((p.name, p.written, p.array.torch, argument))
                values.append(value)
            else:
                self.others.append((p.name, p.written, p))
        self._keep(values)

    def _keep(self, values: Sequence[Tensor]) -> None:
        """These are what the descriptors stand for, but for their addresses."""
        self.shapes = [x.shape for x in values]
        self.alike = TensorLayoutGuard(values)
        written = [
            x.shape[0]
            for x, (_, written, _, _) in zip(values, self.tensors, strict=True)
            if written
        ]
        self.rows = min(written, default=sys.maxsize)

    def refill(self, inputs: Mapping[str, Any], outputs: Mapping[str, Any], rows: int) -> bool:
        """Whether the launch now stands for these arguments; if not, they have to be packed anew
        (or refused)."""
        if (len(inputs), len(outputs)) != self.sizes:
            return False
        try:
            values = [
                (outputs if written else inputs)[name] for name, written, _, _ in self.tensors
            ]
        except KeyError:
            return False
        if not self.alike(values) and not self._reshape(values):
            return False
        if rows > self.rows:
            return False
        for (*_, descriptor), value in zip(self.tensors, values, strict=True):
            descriptor.data = value.data_ptr()
        for name, written, p in self.others:
            value = (outputs if written else inputs).get(name)
            if value is None:
                return False
            packed = p.pack(p, value, cpu(), rows)
            if hasattr(packed, "__ctype__"):  # an array or a struct
                packed = packed.__ctype__()
            setattr(self.arguments, p.label, packed)
        return True

    def _reshape(self, values: Sequence[Any]) -> bool:
        """Whether these differ in their numbers of rows alone; the descriptors have them then."""
        for (_, _, dtype, descriptor), known, value in zip(
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
        self.forward(self.bounds(rows, width), ctypes.byref(arguments))

    def _bounds(self, rows: int, width: int) -> Any:
        """A pointer to the bounds of so many trials, which a launch only reads; several workers may
        ask at once."""
        made = copy.copy(self.packed)
        made.params = list(made.params)
        made.set_dim((rows, width) if width > 1 else rows)
        return ctypes.byref(made.bounds)


@cache
def _structure(labels: tuple[str, ...], kinds: tuple[type, ...]) -> type[ctypes.Structure]:
    """Arguments side by side, as the compiled function of a kernel with these parameters takes
    them."""
    return type(
        "Arguments", (ctypes.Structure,), {"_fields_": list(zip(labels, kinds, strict=True))}
    )


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


class _OfThread(threading.local):
    def __init__(self) -> None:
        self.kernels: dict[Any, CachedLaunch] = {}


_of_thread = _OfThread()


def taken(kernel: Any) -> CachedLaunch | None:
    """Arguments that this thread has packed for a kernel, None if it has none; its own until
    `kept`, so that an interrupt loses it only."""
    return _of_thread.kernels.pop(kernel, None)


def kept(repeated: CachedLaunch) -> None:
    """Puts it back: no launch uses its descriptors any more."""
    _of_thread.kernels[repeated.kernel] = repeated
