"""Files that are no grasps, lie about their size or name other files: refused in one line, before anything is unpacked."""

import re

import numpy as np
import pytest
from grasp_files import poses, write_acronym, write_isaac
from needs import needs
from refusals import one_line

from r2h_batch.data import hdf5
from r2h_batch.data.grasp_files import read_file_of
from r2h_batch.scene.grasp_set import read_grasps
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited


def linked(tmp_path, kind):
    import h5py

    other, path = (write_acronym(tmp_path / f"{n}.h5", poses(3), np.ones(3, int)) for n in ("other", "linked"))
    with h5py.File(path, "a") as f:
        del f["grasps/transforms"]
        if kind == "soft link":
            f["there"] = h5py.ExternalLink("other.h5", "/")
            f["grasps/transforms"] = h5py.SoftLink("/there/grasps/transforms")
        elif kind == "raw":
            (tmp_path / "raw.bin").write_bytes(b"\0" * 8 * 48)
            raw = [(str(tmp_path / "raw.bin"), 0, 384)]
            f["grasps"].create_dataset("transforms", (3, 4, 4), np.float64, external=raw)
        elif kind == "virtual":
            layout = h5py.VirtualLayout((3, 4, 4), np.float64)
            layout[:] = h5py.VirtualSource(str(other), "grasps/transforms", (3, 4, 4))
            f["grasps"].create_virtual_dataset("transforms", layout)
        elif kind == "huge":
            f["grasps"].create_dataset("transforms", (10**12, 4, 4), np.float64, chunks=(1000, 4, 4))
        elif kind == "chunk":
            f["grasps"].create_dataset(
                "transforms", data=poses(6), chunks=(200_000, 4, 4), maxshape=(None, 4, 4), compression="gzip"
            )
        elif kind == "group":
            f["grasps"].create_group("transforms")
    return path


@needs("h5py")
@pytest.mark.parametrize("kind, message", [
    ("soft link", "is a link"), ("raw", "keeps its numbers elsewhere"), ("virtual", "keeps its numbers elsewhere"),
    ("huge", "at most"), ("group", "elsewhere"), ("chunk", "lies in chunks of 3200000 numbers, more than it holds"),
])  # fmt: skip
def test_hdf5_that_names_other_files_or_lies_about_its_size_is_refused(tmp_path, kind, message):
    path = linked(tmp_path, kind)
    with one_line(f"^{re.escape(str(path))}.*{message}"):
        read_file_of("acronym", path)


POSES = poses(2)
OWN = {
    "has no T_obj_ee; needed are T_obj_ee(?!,)": {"width": np.ones(3)},
    "more than 10 m away": {"T_obj_ee": POSES + np.eye(4, k=3) * 500},
    "score holds a number that is not finite in row 0": {"T_obj_ee": POSES, "score": np.full(2, np.nan)},
    "width of grasp 1 is -1; 0 to 10 m": {"T_obj_ee": POSES, "width": np.array([0.1, -1.0])},
    "unknown array 'grip'": {"T_obj_ee": POSES, "grip": np.ones(2)},
    "Python objects": {"T_obj_ee": np.array([{}], object)},
}


@pytest.mark.parametrize("message", OWN)
def test_files_that_are_no_grasps_are_refused_in_one_line(tmp_path, message):
    path = tmp_path / "grasps.npz"
    np.savez(path, **OWN[message])
    with one_line(f"^{re.escape(str(path))}.*{message}"):
        read_grasps(path)


@needs("h5py")
@pytest.mark.usefixtures("own_process")
def test_a_file_that_leads_hdf5_in_circles_is_ended_with_its_process(tmp_path, monkeypatch):
    path = write_acronym(tmp_path / "mug.h5", poses(3), np.ones(3))
    data = bytearray(path.read_bytes())
    data[data.index(b"panda") - 8] = 0  # the word's length in the heap of words
    path.write_bytes(data)
    monkeypatch.setattr(hdf5, "MOST_SECONDS", 2)
    with one_line(r"mug.h5: takes more than 2 s of CPU time, or ends its reader"):
        read_file_of("acronym", path)


def test_a_file_that_does_not_say_whose_frame_it_is_in_is_refused(tmp_path):
    write_isaac(tmp_path / "cup.yaml", poses(2), np.ones(2))
    for said, why in (
        ("cup.yaml", "say --gripper, or FILE:GRIPPER, one of"),
        ("cup.npz:ee", "leave ee out"),
        ("cup.yaml:EE", "'EE' is not a gripper, did you mean ee\\?; allowed are acronym-panda"),
    ):
        with one_line(why):
            edited(BenchmarkChoice("r2h-v1", grasps=(str(tmp_path / said),)))


@pytest.mark.parametrize("source, gripper, message", [
    ("isaac", "2f-85", "'2f-85' has several frames; say graspgen-2f-85 or 2f-85-base; allowed are acronym-panda, "),
    ("isaac", "panda", "'panda' is not a gripper, did you mean panda-hand.; allowed are acronym-panda, "),
    ("poses", "qqqq", "'qqqq' is not a gripper; allowed are acronym-panda, "),
    ("isaac", None, "does not say whose frame it is in"),
    ("own", "ee", "says itself whose grasps it holds; leave ee out"),
    ("isac", "ee", "no source is called 'isac', did you mean isaac.; allowed are acronym, graspnet, "),
])  # fmt: skip
def test_a_gripper_or_a_source_that_is_none_is_refused_with_what_is_allowed(source, gripper, message, tmp_path):
    path = write_isaac(tmp_path / "g.yaml", POSES, np.ones(2))
    with one_line(f"^{re.escape(str(path))}: {message}"):
        read_file_of(source, path, gripper)
