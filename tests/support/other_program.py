"""The package inside a program whose torch makes other tensors by default: `R2H_DEFAULTS=float64 python -m pytest -m check`.

R2H_DEFAULTS is a dtype (float64, bfloat16) or a device (meta, which fails whatever touches it). The other defaults hold for every
call of torch that does not come from a test: what a test makes without saying its dtype is its input, and stays what it is.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._device import _device_constructors  # what set_default_device itself asks

TESTS = str(Path(__file__).resolve().parents[1])
TORCH = str(Path(torch.__file__).resolve().parent)
SETTINGS = ("float64", "bfloat16", "meta")


class OtherProgram(TorchFunctionMode):
    """Other defaults for calls from the package and what it uses; counts those that they could have changed."""

    def __init__(self, setting: str) -> None:
        super().__init__()
        if setting not in SETTINGS:
            raise ValueError(f"R2H_DEFAULTS is {setting!r}; allowed are {', '.join(SETTINGS)}")
        self.device = setting if setting == "meta" else None
        self.dtype = getattr(torch, setting) if self.device is None else None
        self.calls = 0

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        given = kwargs or {}
        if _asked_by_a_test():
            return func(*args, **given)
        self.calls += 1
        if self.device:
            if func in _device_constructors() and given.get("device") is None:
                given = {**given, "device": self.device}
            return func(*args, **given)
        before = torch.get_default_dtype()
        torch.set_default_dtype(self.dtype)
        try:
            return func(*args, **given)
        finally:
            torch.set_default_dtype(before)


def _asked_by_a_test() -> bool:
    """Whether the nearest frame outside torch is a test's."""
    frame = sys._getframe(2)
    while frame is not None:
        file = frame.f_code.co_filename
        if not file.startswith((TORCH, "<")) or file.startswith(TESTS):
            return file.startswith(TESTS)
        frame = frame.f_back  # type: ignore[assignment]
    return False
