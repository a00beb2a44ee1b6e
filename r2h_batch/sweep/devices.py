"""Why a GPU cannot be had, or is not there any more: what torch and Warp raise, as one line."""

import re

import torch

__all__ = ["device_trouble", "why_no_cuda"]

_OF_DEVICE = re.compile(
    r"CUDA (error|out of memory|driver)|CUDNN_STATUS|CUBLAS_STATUS|NVIDIA driver|on device '?cuda|Torch not compiled with CUDA"
)
"""torch.AcceleratorError ("CUDA error: ..."), torch.OutOfMemoryError ("CUDA out of memory. ..."),
torch.cuda.init ("Found no NVIDIA driver ...", "The NVIDIA driver on your system is too old ..."),
Warp's RuntimeError ("CUDA error 719 detected on device cuda:0: ...", "Failed to allocate 8 bytes on
device 'cuda:0'")."""


def device_trouble(error: BaseException) -> str | None:
    """The first line of an error that speaks of the GPU; None for every other error."""
    text = str(error).strip()
    of_torch = isinstance(error, (torch.OutOfMemoryError, torch.AcceleratorError))
    if not of_torch and not (
        isinstance(error, (RuntimeError, AssertionError)) and _OF_DEVICE.search(text)
    ):
        return None
    return text.partition("\n")[0][:300] or type(error).__name__


def why_no_cuda() -> str:
    """Why torch sees no CUDA device, in its own words: no driver, one that is too old, a build
    without CUDA."""
    try:
        torch.cuda.init()
    except (RuntimeError, AssertionError) as error:
        return str(error).strip().partition("\n")[0].partition(". ")[0][:200]
    return "the driver shows none"
