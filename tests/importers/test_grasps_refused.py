"""Files that are no grasps, lie about their size or name other files: refused in one line, before anything is unpacked."""

import numpy as np
import pytest
from grasp_files import poses, write_acronym, write_isaac
from needs import needs

from r2h_batch.benchmark.build import BenchmarkOverrides
from r2h_batch.bodies.grasp_set import read_grasps
from r2h_batch.importers import hdf5
from r2h_batch.importers.grasp_files import read_file_of
from r2h_batch.io.read import FileError


def linked(tmp_path, kind):
    import h5py

    other = write_acronym(tmp_path / "other.h5", poses(3), np.ones(3, int))
    path = write_acronym(tmp_path / "linked.h5", poses(3), np.ones(3, int))
    with h5py.File(path, "a") as f:
        if kind == "group":
            del f["grasps"]
            f["grasps"] = h5py.ExternalLink(str(other), "/grasps")
            return path
        del f["grasps/transforms"]
        if kind == "external":
            f["grasps/transforms"] = h5py.ExternalLink("other.h5", "/grasps/transforms")
        elif kind == "soft":
            f["there"] = h5py.ExternalLink("other.h5", "/")
            f["grasps/transforms"] = h5py.SoftLink("/there/grasps/transforms")
        elif kind == "raw":
            (tmp_path / "raw.bin").write_bytes(b"\0" * 8 * 48)
            f["grasps"].create_dataset(
                "transforms", (3, 4, 4), np.float64, external=[(str(tmp_path / "raw.bin"), 0, 384)]
            )
        elif kind == "virtual":
            layout = h5py.VirtualLayout((3, 4, 4), np.float64)
            layout[:] = h5py.VirtualSource(str(other), "grasps/transforms", (3, 4, 4))
            f["grasps"].create_virtual_dataset("transforms", layout)
        elif kind == "huge":
            f["grasps"].create_dataset("transforms", (10**12, 4, 4), np.float64, chunks=(1000, 4, 4))
        elif kind == "group for a dataset":
            f["grasps"].create_group("transforms")
    return path


@needs("h5py")
@pytest.mark.parametrize("kind, message", [
    ("external", "is a link"), ("soft", "is a link"), ("group", "is a link"), ("raw", "keeps its numbers elsewhere"),
    ("virtual", "keeps its numbers elsewhere"), ("huge", "at most"), ("group for a dataset", "elsewhere"),
])  # fmt: skip
def test_hdf5_that_names_other_files_or_lies_about_its_size_is_refused(tmp_path, kind, message):
    path = linked(tmp_path, kind)
    with pytest.raises(FileError, match=message) as refused:
        read_file_of("acronym", path)
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


def bad_npz(**arrays):
    def write(path):
        np.savez(path, **arrays)

    return write


OWN = {
    "no poses.npz": (bad_npz(width=np.ones(3)), "has no T_obj_ee"),
    "sheared.npz": (bad_npz(T_obj_ee=np.ones((2, 4, 4))), "not a rigid pose"),
    "mirrored.npz": (bad_npz(T_obj_ee=np.diag([1.0, 1, -1, 1])[None]), "not a rigid pose"),
    "millimetres.npz": (bad_npz(T_obj_ee=poses(2) * 1.0 + np.eye(4, k=3) * 500), "more than 10 m away"),
    "short width.npz": (bad_npz(T_obj_ee=poses(2), width=np.ones(3)), "width is"),
    "nan score.npz": (bad_npz(T_obj_ee=poses(2), score=np.full(2, np.nan)), "score holds a number that is not finite in row 0"),
    "negative width.npz": (bad_npz(T_obj_ee=poses(2), width=np.array([0.1, -1.0])), "width of grasp 1 is -1; 0 to 10 m"),
    "another array.npz": (bad_npz(T_obj_ee=poses(2), grip=np.ones(2)), "unknown array 'grip'"),
    "objects.npz": (bad_npz(T_obj_ee=np.array([{}], object)), "Python objects"),
    "grasps.txt": (lambda p: p.write_text("x"), "an .npz file"),
}  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_files_that_are_no_grasps_are_refused_in_one_line(tmp_path, name):
    write, message = OWN[name]
    path = tmp_path / name
    write(path)
    with pytest.raises(FileError, match=message) as refused:
        read_grasps(path)
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


@needs("h5py")
@pytest.mark.usefixtures("own_process")
def test_a_file_that_leads_hdf5_in_circles_is_ended_with_its_process(tmp_path, monkeypatch):
    path = write_acronym(tmp_path / "mug.h5", poses(3), np.ones(3))
    data = bytearray(path.read_bytes())
    data[data.index(b"panda") - 8] = 0  # the word's length in the heap of words
    path.write_bytes(data)
    monkeypatch.setattr(hdf5, "MOST_SECONDS", 2)
    with pytest.raises(FileError, match=r"mug.h5: takes more than 2 s of CPU time to read, or ends its reader"):
        read_file_of("acronym", path)


def test_a_file_that_does_not_say_whose_frame_it_is_in_is_refused(tmp_path):
    write_isaac(tmp_path / "cup.yaml", poses(2), np.ones(2))
    for said, why in (
        ("cup.yaml", "say --gripper, or FILE:GRIPPER, one of"),
        ("cup.npz:ee", "leave :ee out"),
        ("cup.yaml:EE", "'EE' is not a gripper, did you mean ee\\?; allowed are acronym-panda"),
        ("cup.yaml:", "'' is not a gripper; allowed are"),
    ):
        with pytest.raises(FileError, match=why):
            BenchmarkOverrides(grasps=(str(tmp_path / said),)).read()


@needs("h5py")
def test_a_chunk_that_is_larger_than_what_it_holds_is_refused_before_it_is_unpacked(tmp_path):
    import h5py

    write_acronym(tmp_path / "mug.h5", poses(6), np.ones(6))
    with h5py.File(tmp_path / "mug.h5", "a") as f:
        T = f["grasps/transforms"][()]
        del f["grasps/transforms"]
        f.create_dataset("grasps/transforms", data=T, chunks=(200_000, 4, 4), maxshape=(None, 4, 4), compression="gzip")
    with pytest.raises(FileError, match="lies in chunks of 3200000 numbers, more than it holds"):
        read_file_of("acronym", tmp_path / "mug.h5")
