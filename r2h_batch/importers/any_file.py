"""A user's hand or grasps straight from their file: what `r2h-batch import` would make of it,
told apart by the file's name."""

from __future__ import annotations

from pathlib import Path

from r2h_batch.bodies.grasp_set import GraspSet, read_grasps
from r2h_batch.bodies.hand import HandModel
from r2h_batch.bodies.hand_file import read_hand
from r2h_batch.command_line import nearest, tell
from r2h_batch.importers.grasps.grippers import GRIPPERS
from r2h_batch.io.read import FileError, printable

__all__ = ["GRASP_FILES", "grasps_from", "hand_from", "without_gripper"]

HDF5 = (".h5", ".hdf5")
GRASP_FILES = (".npz", ".safetensors", *HDF5, ".npy")
"""Grasps that need no further word: our own, ACRONYM's, GraspNet's (of one object, in its
frame)."""
YAML = (".yaml", ".yml")


def grasps_from(argument: str | Path) -> GraspSet:
    """The grasps of FILE, or of FILE.yaml:GRIPPER for an isaac_grasp file; what had to be left out
    is told on stderr.

    `.npz`, `.safetensors`: our own. `.h5`, `.hdf5`: ACRONYM's. `.npy`: GraspNet's, N x 17, of one
    object and in its frame. GRIPPER: one of `grippers.GRIPPERS`. Raises `FileError`, one line.
    """
    path, gripper = without_gripper(argument)
    where, ending = printable(path), path.suffix.lower()
    if gripper and ending not in YAML:
        raise FileError(f"{where}: says itself whose grasps it holds; leave :{gripper} out")
    if ending in YAML:
        from r2h_batch.importers.grasps import isaac_grasp

        if not gripper:
            raise FileError(
                f"{where}: does not say whose frame it is in; say FILE:GRIPPER, one of {', '.join(GRIPPERS)}"
            )
        found, left_out = isaac_grasp.read(path, gripper)
    elif ending in HDF5:
        from r2h_batch.importers.grasps import acronym

        found, left_out = acronym.read(path)
    elif ending == ".npy":
        from r2h_batch.importers.grasps import graspnet

        found, left_out = graspnet.read(path)
    else:
        found, left_out = read_grasps(path), 0
    if left_out:
        tell(
            f"{where}: {len(found)} grasps of the {found.gripper}; {left_out} left out, which did not hold in its simulation"
        )
    return found


def without_gripper(argument: str | Path) -> tuple[Path, str]:
    """FILE and GRIPPER of FILE:GRIPPER; the gripper is empty where none is named, a `FileError`
    where it is no gripper."""
    text, _, gripper = str(argument).rpartition(":")
    if text and gripper in GRIPPERS:
        return Path(text), gripper
    if text.lower().endswith(YAML):
        close = nearest(gripper.lower(), GRIPPERS)
        raise FileError(
            f"{printable(argument)}: {printable(gripper)!r} is no gripper{close}; allowed are {', '.join(GRIPPERS)}"
        )
    return Path(argument), ""


def hand_from(path: Path) -> HandModel:
    """The hand of a `hand.npz`, or of one of MANO's own pickles: a left one where its name says so,
    mirrored for the other side.

    Raises `FileError`, one line.
    """
    if path.suffix.lower() not in (".pkl", ".pickle"):
        return HandModel.from_arrays(read_hand(path))
    from r2h_batch.importers.mano import load_mano

    left = "left" in path.stem.lower()
    return load_mano(left=path).model if left else load_mano(right=path).model
