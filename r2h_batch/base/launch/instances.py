"""Kernels for another number of joints: the same files, imported once more as another package."""

import sys
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from typing import TypeVar

import r2h_batch.kernels

Compiled = TypeVar("Compiled")


@cache
def of_joints(thing: Compiled, joints: int) -> Compiled:
    """A kernel, function or struct of `r2h_batch.kernels` as it is for an arm with so many joints.

    Ask for what depends on their number alone (kernels/robot/joints.py, and what imports it): all
    else is shared. Warp compiles and caches the second package under its own name,
    r2h_batch.kernels_7 for seven joints.
    """
    if joints == r2h_batch.kernels.JOINTS:
        return thing
    made = getattr(thing, "cls", None) or thing.func  # type: ignore[attr-defined]
    package = f"{r2h_batch.kernels.__name__}_{joints}"
    if package not in sys.modules:
        spec = ModuleSpec(package, None, is_package=True)
        spec.submodule_search_locations = list(r2h_batch.kernels.__path__)
        second = module_from_spec(spec)
        second.JOINTS = joints  # type: ignore[attr-defined]
        sys.modules[package] = second
    found = import_module(made.__module__.replace(r2h_batch.kernels.__name__, package, 1))
    other: Compiled = getattr(found, made.__qualname__)
    return other
