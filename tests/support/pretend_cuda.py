"""Tensors that say they are on cuda:0 and live on the CPU: what a GPU would refuse or wait for, found on a machine without one.

    with pretending() as seen:
        evaluator = Evaluator(device="cuda:0")
        evaluator.score(...)
    seen.waits, seen.launches

Inside, `device="cuda:0"` makes such tensors and Warp's arrays carry the same mark. An operator or a kernel that is given some
of each raises RuntimeError as CUDA would, and `numpy()` of one raises TypeError. Every operator that makes the host wait for
the device is written down with the line of ours that asked: `item`, `bool`, `nonzero`, masks as indices, copies to the CPU.
Kernels run on the CPU. What it cannot show: streams, races, memory, and what the GPU's arithmetic is like.
"""

import inspect
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
import warp as wp
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from r2h_batch.base import launch

CUDA = torch.device("cuda:0")
SHAPED_BY_VALUES = {
    "aten::nonzero", "aten::masked_select", "aten::_unique2", "aten::unique_dim", "aten::repeat_interleave", "aten::equal",
}  # fmt: skip
"""Operators whose result's shape, or the result itself, the host has to wait for."""
INDEXED = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}


@dataclass
class Seen:
    """Recorded events: (what, where in our code) of everything the host waited for; where Warp's arrays were made on
    the device; names of the launched kernels."""

    waits: list[tuple[str, str]] = field(default_factory=list)
    arrays: list[str] = field(default_factory=list)
    launches: list[str] = field(default_factory=list)


_seen = Seen()
_structs: dict[int, tuple[Any, bool]] = {}
"""Structs of tensors and whether these were on cuda:0; the struct itself, that no other gets its number."""


def _where() -> str:
    """The innermost line of the package, or of a test, that is running."""
    for frame in reversed(traceback.extract_stack()[:-2]):
        if ("/r2h_batch/" in frame.filename or "/test_" in frame.filename) and "pretend_cuda" not in frame.filename:
            return f"{frame.filename.rpartition('/')[2]}:{frame.lineno} {(frame.line or '').strip()}"
    return "?"


def _waits(what: str) -> None:
    _seen.waits.append((what, _where()))


class OnCuda(torch.Tensor):
    """A tensor that says cuda:0; `inner` is where its numbers are."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "OnCuda":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device="cpu",
        )
        made.inner = inner
        return made

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def get_device(self) -> int:
        return 0

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        done = _by_name(func, args, kwargs or {})
        if done is not NotImplemented:
            return done
        with torch._C.DisableTorchFunctionSubclass():
            return func(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def real(value: Any) -> Any:
    return value.inner if isinstance(value, OnCuda) else value


def _is_cuda(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _by_name(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Torch's answer before any operator is reached: `to`, `cpu`, NumPy, lists; NotImplemented: something else."""
    if func is torch.Tensor.to:
        return _to(args[0], args[1:], kwargs)
    if func is torch.Tensor.cpu:
        return _to(args[0], ("cpu",), {})
    if func in (torch.Tensor.numpy, torch.Tensor.__array__):
        raise TypeError(f"can't convert cuda:0 device type tensor to numpy: {_where()}")
    if func is torch.Tensor.tolist:
        _waits("tolist")
        return args[0].inner.tolist()
    if func is torch.nn.functional.one_hot:
        return OnCuda(func(args[0].inner, *args[1:], **kwargs))
    return NotImplemented


def _to(x: torch.Tensor, args: Any, kwargs: dict[str, Any]) -> torch.Tensor:
    dtype, cuda = kwargs.get("dtype"), isinstance(x, OnCuda)
    goal = cuda
    for value in (*args, kwargs.get("device"), kwargs.get("other")):
        if isinstance(value, torch.Tensor):
            dtype, goal = value.dtype, isinstance(value, OnCuda)
        elif isinstance(value, torch.dtype):
            dtype = value
        elif isinstance(value, (str, torch.device)):
            goal = _is_cuda(value)
    if cuda and not goal:
        _waits("copy to the CPU")
    if cuda == goal and dtype in (None, x.dtype):
        return x
    with torch._C.DisableTorchFunctionSubclass():
        moved = real(x).to(dtype or x.dtype, copy=True)
        if cuda and goal and _graph is not None:  # another data type: a graph does it again
            _graph.add(torch.ops.aten._to_copy.default, (real(x),), {"dtype": dtype}, moved)
    return OnCuda(moved) if goal else moved


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operator: refused when devices mix, noted when the host waits, computed on the CPU."""
    flat, _ = tree_flatten((args, kwargs))
    tensors = [t for t in flat if isinstance(t, torch.Tensor)]
    cuda = [t for t in tensors if isinstance(t, OnCuda)]
    name, device = func._schema.name, kwargs.get("device")
    there = bool(cuda)
    if name == "aten::copy_":
        there = isinstance(args[0], OnCuda)
        if not there and cuda:
            _waits("copy to the CPU")
    elif device is not None:
        there = _is_cuda(device)
        if cuda and not there:
            _waits("copy to the CPU")
    elif cuda:
        _refuse_mixed(name, args, tensors)
    if cuda:
        _note_waits(name, args)
    plain_args, plain = tree_map(real, (args, kwargs))
    if _is_cuda(plain.get("device")):
        plain = {**plain, "device": torch.device("cpu")}
    out = func(*plain_args, **plain)
    if there and _graph is not None:
        _graph.add(func, plain_args, plain, out)
    if func._schema.is_mutable and isinstance(out, torch.Tensor):
        return kwargs.get("out", args[0])
    return tree_map(lambda t: OnCuda(t) if isinstance(t, torch.Tensor) else t, out) if there else out


def _refuse_mixed(name: str, args: Any, tensors: list[torch.Tensor]) -> None:
    """As CUDA: all on one device; numbers as tensors (0-d) go with either, and CPU indices into a tensor there."""
    here = [t for t in tensors if not isinstance(t, OnCuda) and t.ndim > 0]
    if name in INDEXED and isinstance(args[0], OnCuda):
        if any(t is i for t in here for i in args[1]):
            _waits("index that is on the CPU")
        here = [t for t in here if not any(t is i for i in args[1])]
    if here:
        shapes = ", ".join(str(tuple(t.shape)) for t in here)
        raise RuntimeError(f"{name}: expected all tensors on one device, cuda:0 and cpu ({shapes}): {_where()}")


def _note_waits(name: str, args: Any) -> None:
    if name == "aten::_local_scalar_dense":
        _waits("item")
    elif name in SHAPED_BY_VALUES:
        _waits(name.removeprefix("aten::"))
    elif name in INDEXED:
        masks = [i for i in args[1] if i is not None and i.dtype in (torch.bool, torch.uint8)]
        if masks and (name == "aten::index" or args[2].ndim > 0):  # one number is filled in under the mask
            _waits("index with a mask")


class Graph:
    """As torch.cuda.CUDAGraph: what was launched while it was captured runs again, on the same memory and nothing else.

    Numbers that the host read or made meanwhile stay as they were, so a call that depends on them repeats old results.
    """

    def __init__(self) -> None:
        self._nodes: list[Callable[[], object]] = []
        self._memory: list[Any] = []  # as the graph's pool: nothing is freed

    def add(self, func: Any, args: Any, kwargs: dict[str, Any], out: Any) -> None:
        """An operator; views compute nothing, and what is in place has its own memory."""
        self._memory.append((args, kwargs, out))
        if func._schema.is_mutable:
            self._nodes.append(lambda: func(*args, **kwargs))
        elif not func.is_view:
            self._nodes.append(lambda: _copied(out, func(*args, **kwargs)))

    def launch(self, *args: Any, **options: Any) -> None:
        """A kernel with its packed arguments."""
        self._memory.append(args)
        self._nodes.append(lambda: _launch(*args, **options))

    def replay(self) -> None:
        for node in self._nodes:
            node()


_graph: Graph | None = None
_launch = wp.launch


def _copied(old: Any, new: Any) -> None:
    for x, y in zip(tree_flatten(old)[0], tree_flatten(new)[0], strict=True):
        if isinstance(x, torch.Tensor):  # a number that the host read stays as it was
            x.copy_(y)


def _launched(*args: Any, **options: Any) -> Any:
    if _graph is not None:
        _graph.launch(*args, **options)
    return _launch(*args, **options)


@contextmanager
def _capturing(graph: Graph) -> Iterator[None]:
    global _graph
    _graph = graph
    try:
        yield
    finally:
        _graph = None


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and _is_cuda(kwargs.get("device")):
            del kwargs["device"]
            return OnCuda(func(*args, **kwargs))
        if func is torch.Tensor.to:
            return _to(args[0], args[1:], kwargs)
        return func(*args, **kwargs)


class _Device:
    """Warp's name of it."""

    is_cpu, is_cuda, ordinal = False, True, 0

    def __str__(self) -> str:
        return "cuda:0"


class _Stream:
    cuda_stream, device = 0, CUDA

    def wait_stream(self, other: Any) -> None: ...

    def synchronize(self) -> None:
        _waits("synchronize")


def _array_init(original: Callable[..., None]) -> Callable[..., None]:
    def init(self: Any, *args: Any, device: Any = None, **kwargs: Any) -> None:
        self.on_cuda = device is not None and str(device).startswith("cuda")
        if self.on_cuda:
            _seen.arrays.append(_where())
        original(self, *args, device="cpu" if self.on_cuda else device, **kwargs)

    return init


def _from_torch(original: Callable[..., Any]) -> Callable[..., Any]:
    def from_torch(t: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        array = original(real(t), *args, **kwargs)
        array.on_cuda, array.owner = isinstance(t, OnCuda), t
        return array

    return from_torch


def _to_torch(original: Callable[..., Any]) -> Callable[..., Any]:
    def to_torch(array: wp.array, *args: Any, **kwargs: Any) -> torch.Tensor:
        tensor: torch.Tensor = original(array, *args, **kwargs)
        return OnCuda(tensor) if getattr(array, "on_cuda", False) else tensor

    return to_torch


def _device_from_torch(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda device: _Device() if _is_cuda(device) else original(device)


def _struct_of(original: Callable[..., Any]) -> Callable[..., Any]:
    def struct_of(kind: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
        made = original(kind, tensors)
        (marked,) = {isinstance(t, OnCuda) for t in tensors.values()}
        _structs[id(made)] = (made, marked)
        return made

    return struct_of


def _bind(original: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    def bind(kernel: Any, inputs: Mapping[str, Any], outputs: Mapping[str, Any], device: str, **more: Any) -> list[Any]:
        cuda = str(device) != "cpu"
        for name, value in {**inputs, **outputs}.items():
            if cuda in _others(value):
                raise RuntimeError(f"kernel {kernel.key} on {device}: `{name}` is on the other device: {_where()}")
        if cuda:
            _seen.launches.append(kernel.key)
        plain = ({k: real(v) for k, v in values.items()} for values in (inputs, outputs))
        return original(kernel, *plain, "cpu", **more)

    return bind


def _others(value: Any) -> set[bool]:
    """False where something in a kernel's argument is on cuda:0, True where something is on the CPU."""
    if id(value) in _structs:
        return {not _structs[id(value)][1]}
    fields = [getattr(value, k) for k in value._cls.vars] if hasattr(value, "_cls") else [value]
    there = [getattr(x, "on_cuda", False) for x in fields if isinstance(x, wp.array) and x.size]
    return {not x for x in (*there, *(isinstance(x, OnCuda) for x in fields if isinstance(x, torch.Tensor)))}


@contextmanager
def pretending() -> Iterator[Seen]:
    """Inside there is a GPU."""
    global _seen
    _seen = Seen()
    with ExitStack() as stack:
        for name, value in {
            "_lazy_init": lambda: None,
            "is_available": lambda: True,
            "device_count": lambda: 1,
            "current_device": lambda: 0,
            "current_stream": lambda device=None: _Stream(),
            "synchronize": lambda device=None: _waits("synchronize"),
            "mem_get_info": lambda device=None: (64 << 30, 80 << 30),
            "stream": lambda stream: nullcontext(),
            "Stream": lambda device=None: _Stream(),
            "CUDAGraph": Graph,
            "graph": _capturing,
        }.items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        stack.enter_context(mock.patch.object(wp.array, "__init__", _array_init(wp.array.__init__)))
        stack.enter_context(mock.patch.object(wp, "from_torch", _from_torch(wp.from_torch)))
        stack.enter_context(mock.patch.object(wp, "to_torch", _to_torch(wp.to_torch)))
        stack.enter_context(mock.patch.object(wp, "device_from_torch", _device_from_torch(wp.device_from_torch)))
        stack.enter_context(mock.patch.object(wp, "synchronize_device", lambda device: _waits("synchronize")))
        stack.enter_context(mock.patch.object(wp, "launch", _launched))
        stack.enter_context(mock.patch.object(launch, "bind", _bind(launch.bind)))
        stack.enter_context(mock.patch.object(launch, "_stream", lambda device: None))
        for module in _ours():
            if hasattr(module, "struct_of"):
                stack.enter_context(mock.patch.object(module, "struct_of", _struct_of(module.struct_of)))
        stack.callback(_forget_tables)
        stack.enter_context(_Dispatch())
        stack.enter_context(_Functions())
        yield _seen


def _forget_tables() -> None:
    """Tables that functions keep by device: a real GPU's tests in the same process must not find the pretended ones."""
    _structs.clear()
    for module in _ours():
        for kept in vars(module).values():
            if hasattr(kept, "cache_clear") and "device" in inspect.signature(kept).parameters:
                kept.cache_clear()


def _ours() -> list[Any]:
    return [module for name, module in list(sys.modules.items()) if name.startswith("r2h_batch.")]
