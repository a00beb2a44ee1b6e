"""Other people's hands, hand sets, grasps and objects as files that this package reads: `r2h-batch
import ...`."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from r2h_batch.base.command_line import Command, counted
from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import check_output_file, check_output_folder

if TYPE_CHECKING:
    from r2h_batch.scene.grasp_set import GraspSet

Frame = Literal["aperture", "first", "middle", "last"]
Gripper = Literal[
    "acronym-panda", "panda-hand", "graspgen-franka", "graspgen-2f-140", "2f-85-base", "graspgen-2f-85", "ee"
]  # fmt: skip


def hand(
    *,
    out: Path,
    source: Annotated[
        Literal["mano", "anny"], tyro.conf.arg(name="from", metavar="SOURCE")
    ] = "mano",
    age: float | None = None,
    sex: Literal["male", "female"] | None = None,
    mano_right: Path | None = None,
    mano_left: Path | None = None,
    negate_left_shape: bool = False,
    overwrite: bool = False,
) -> int:
    """Write MANO's own files as one hand model, or a hand of the built-in people.

    Args:
        out: The hand model to write, .npz. MANO's licence forbids you to pass a hand of MANO on.
        source: mano: the files below; anny: the median hand of the built-in people of an age, which are made
            from the body model Anny.
        age: anny: years, 6 to 12, 18 to 65 or 70 to 90.
        sex: anny: of one sex; by default of either.
        mano_right: MANO_RIGHT.pkl, or the same arrays as .npz.
        mano_left: MANO_LEFT.pkl. A side without a file is the other's mirror image.
        negate_left_shape: Change the sign of the left file's shapedirs[:, 0]. Only for data that
            were fitted with the corrected sign.
        overwrite: Replace a file that is there.
    """
    target = _npz(out, overwrite)
    mano = mano_right is not None or mano_left is not None or negate_left_shape
    if source == "anny":
        return _hand_of_people(target, age, sex, mano)
    if age is not None or sex is not None:
        raise UsageError(
            "--age and --sex choose a hand of --from anny; leave them out, or say --from anny"
        )
    return _hand_of_mano(target, mano_right, mano_left, negate_left_shape)


def _hand_of_mano(out: Path, right: Path | None, left: Path | None, negate_left_shape: bool) -> int:
    """Writes the hand of MANO's own files."""
    from r2h_batch.base.io.write import write_npz
    from r2h_batch.data.mano import hand_arrays

    arrays = hand_arrays(right, left, negate_left_shape=negate_left_shape)
    write_npz(out, arrays)
    print(
        f"a hand of {len(arrays['vertices'])} vertices in {len(arrays['piece_names'])} convex pieces in {out};"
        " it holds MANO's data: do not pass it on"
    )
    return 0


def _hand_of_people(out: Path, age: float | None, sex: str | None, mano: bool) -> int:
    """Writes the median hand of the built-in people of an age."""
    import numpy as np

    from r2h_batch.base.io.write import write_npz
    from r2h_batch.data.people import hand_lengths, hand_of_age
    from r2h_batch.scene.hand import HandModel

    if mano:
        raise UsageError(
            "--from anny takes no files of MANO; leave --mano-right and --mano-left out"
        )
    if age is None:
        raise UsageError("--from anny needs --age YEARS, such as --age 8")
    arrays = hand_of_age(age, sex)
    length = hand_lengths(HandModel.from_arrays(arrays), np.zeros((1, 10), np.float32))[0]
    write_npz(out, arrays)
    print(f"the median hand of people of {age:g} years, {1000 * length:.0f} mm long, in {out}")
    return 0


def people(file: Annotated[Path, tyro.conf.Positional], /) -> int:
    """Check a table of your own people for --people and for a benchmark's people.

    Args:
        file: A .csv, one person a row: sex (male, female), age (years), and lengths in metres by the names of
            docs/benchmark.md.
    """
    from r2h_batch.data.people import read_people

    found = read_people(file)
    stature, hand_m = (found.lengths[k] for k in ("stature", "hand_length"))
    print(
        f"{counted(len(found), 'people')} in {printable(file)}: {found.age.min():g} to {found.age.max():g} years,"
        f" stature {stature.min():.2f} to {stature.max():.2f} m, hands {1000 * hand_m.min():.0f} to"
        f" {1000 * hand_m.max():.0f} mm; sweep with --people {shlex.quote(str(file))}"
    )
    return 0


def hands(
    folder: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    *,
    source: Annotated[
        tuple[Literal["grab", "arctic", "h2o", "oakink", "dexycb", "built-in"], ...],
        tyro.conf.arg(name="from", metavar="SOURCE"),
    ],
    out: Path,
    frame: Frame | int = "aperture",
    mano_right: Path | None = None,
    mano_left: Path | None = None,
    negate_left_shape: bool = False,
    smplx: Path | None = None,
    idle: bool = False,
    strict: bool = False,
    overwrite: bool = False,
) -> int:
    """Write one receiving hand of each sequence and side of a data set, and their motions beside
    them.

    Args:
        folder: The data set as its owners give it; several become one hand set.
        source: Name of each folder's data set; built-in: this project's own postures.
        out: The hand set to write, .npz; the motions go beside it as NAME_motion.npz.
        frame: Which frame of a sequence: aperture (the widest grip of the last second before the
            object moves), first, middle, last, or a number (-1: the last). In oakink, aperture
            takes receivers' hands only.
        mano_right: MANO_RIGHT.pkl, for data relative to MANO's mean hand or in its components
            (arctic, dexycb), for shapes of subjects (grab) and for the wrist's exact place.
        mano_left: MANO_LEFT.pkl.
        negate_left_shape: The same as in `import hand`.
        smplx: A folder with SMPLX_MALE.npz, SMPLX_FEMALE.npz, SMPLX_NEUTRAL.npz, for the arms of
            bodies (grab, arctic). Receivers of r2h-v1 keep these arms.
        idle: Keep hands that do not carry the object. By default the command leaves them out and counts
            them.
        strict: Refuse a data set with a file that cannot be read, instead of skipping it.
        overwrite: Replace files that are there.
    """
    from r2h_batch.data import hand_sets
    from r2h_batch.data.mano import load_mano
    from r2h_batch.data.smplx import Bodies
    from r2h_batch.scene.hand import load_hand_set

    if smplx is not None and not list(smplx.glob("SMPLX_*.npz")):
        raise UsageError(f"--smplx {smplx}: has no SMPLX_MALE.npz, _FEMALE.npz or _NEUTRAL.npz")
    target = _npz(out, overwrite)
    motions = hand_sets.motion_file(target)
    check_output_file(motions, overwrite=overwrite, flag="--out with the motions in")
    if source == ("built-in",):
        hand_sets.write(target, hand_sets.built_in())
        print(f"{counted(len(load_hand_set()), 'hands')} of r2h_batch in {target}; 0 files skipped")
        return 0
    names = ", ".join(source)
    if len(folder) != len(source) or "built-in" in source:
        many = counted(len(folder), "folders") if folder else "no folder"
        raise UsageError(f"{many}; give one for each of {names}, as its owners give it")
    rule = int(frame) if isinstance(frame, int) or str(frame).lstrip("-").isdigit() else frame
    found = hand_sets.Collected()
    mano = None
    if mano_right is not None or mano_left is not None:
        mano = load_mano(mano_right, mano_left, negate_left_shape=negate_left_shape)
    bodies = None if smplx is None else Bodies(smplx)
    for at, name in zip(folder, source, strict=True):
        hand_sets.collect(name, at, mano, rule, strict=strict, idle=idle, into=found, bodies=bodies)
    hand_sets.write(target, found)
    right, left = found.counts()
    print(
        f"{counted(right + left, 'hands')} of {names} ({right} right, {left} left) in {target},"
        f" motions in {motions}; {counted(found.idle, 'idle hands')} left out,"
        f" {counted(len(found.skipped), 'files')} skipped"
    )
    return 0


def grasps(
    file: Annotated[Path, tyro.conf.Positional],
    *,
    source: Annotated[
        Literal["acronym", "graspnet", "graspgen", "isaac", "poses", "own"],
        tyro.conf.arg(name="from", metavar="SOURCE"),
    ],
    out: Path,
    gripper: Gripper | None = None,
    object_id: int | None = None,
    pose: Path | None = None,
    overwrite: bool = False,
) -> int:
    """Write the grasps of one object as a file for a benchmark: T_obj_ee, width, score, part in our
    own ee frame.

    A sweep moves grasps of another gripper until they hold the object, or drops them. It counts both.

    Args:
        file: ACRONYM's .h5, graspnetAPI's .npy (N x 17) or GraspNet's _labels.npz, an isaac_grasp
            .yaml, GraspGen's .json, poses as .npy (N x 4 x 4), or our own .npz to check.
        source: Format: acronym, graspnet, graspgen, isaac (also GraspGen's predictions), poses, own.
        out: The grasps to write, .npz.
        gripper: Gripper in whose frame the grasps are; graspgen, isaac and poses need it.
        object_id: Object of a graspnet file whose grasps you want.
        pose: T_obj_source, .npy of 4 x 4, for a graspnet file: the frame that the network saw in
            the object's frame.
        overwrite: Replace a file that is there.
    """
    import numpy as np

    from r2h_batch.base.io.read import read_npy
    from r2h_batch.base.io.write import write_npz
    from r2h_batch.data.arrays import numbers
    from r2h_batch.data.grasp_files import NEED_GRIPPER, read_file_of

    target = _npz(out, overwrite)
    given = {"--gripper": gripper, "--object-id": object_id, "--pose": pose}
    allowed = ["--gripper"] if source in NEED_GRIPPER else []
    allowed = ["--object-id", "--pose"] if source == "graspnet" else allowed
    if wrong := [k for k, v in given.items() if v is not None and k not in allowed]:
        raise UsageError(f"{wrong[0]} says nothing about grasps from {source}")
    T = None if pose is None else numbers(read_npy(pose, most=4096), (4, 4), str(pose))
    found, left_out = read_file_of(source, file, gripper, object_id=object_id, T_obj_source=T)
    write_npz(target, {**found.arrays(), "gripper": np.array(found.gripper)})
    print(
        f"{counted(len(found), 'grasps')} of the {found.gripper} in {target}; {left_out} left out"
    )
    return 0


def objects(
    folder: Annotated[Path, tyro.conf.Positional],
    *,
    source: Annotated[Literal["oakink"], tyro.conf.arg(name="from", metavar="SOURCE")],
    out: Path,
    only: tuple[str, ...] = (),
    grasps: Path | None = None,
    gripper: Gripper | None = None,
    hands: int | None = None,
    strict: bool = False,
) -> int:
    """Write a data set's objects as a folder for --objects: meshes in the frame of its hands, part
    labels, grasps, benchmark.yaml.

    Args:
        folder: The data set as its owners give it: OakInk's with shape/metaV2 or image/obj;
            OakBase's parts anywhere below it.
        source: Data set: oakink.
        out: A new or empty folder. It will hold the data set's meshes: mind their licence.
        only: Names or IDs of the objects to take; else all.
        grasps: A folder of grasps in files called after the objects, in formats of `import grasps`.
        gripper: Gripper in whose frame the grasps are, if the files do not say it.
        hands: Also enter hand.npz and this many hands of each side of hands.npz into benchmark.yaml.
            `import hand` and `import hands` write these files.
        strict: Refuse a data set with an object that cannot be read, instead of skipping it.
    """
    from r2h_batch.data.oakink_objects import OakObject, collect, write

    check_output_folder(out, overwrite=None)
    found, skipped = [], 0
    for name, made in collect(folder, only):
        if isinstance(made, OakObject):
            found.append(made)
            continue
        if strict:
            raise FileError(f"{printable(name)}: {made}")
        skipped += 1
        LOG.info(f"skipped: {name}: {made}")
    if not found:
        raise FileError(f"{printable(folder)}: none of {skipped} objects could be read")
    write(out, found, _grasp_files(grasps, [o.name for o in found], gripper), hands)
    held = sum(bool(o.held) for o in found)
    print(
        f"{counted(len(found), 'objects')} of {source} ({held} with a receiver's region) in {out}; {skipped} skipped"
    )
    return 0


def trials(
    path: Annotated[Path, tyro.conf.Positional],
    *,
    source: Annotated[Literal["r2handoversim"], tyro.conf.arg(name="from", metavar="SOURCE")],
    out: Path,
) -> int:
    """Write trials of the authors' release as a benchmark with predictions and motions.

    Args:
        path: A file of handover.trial.v1, or of handover.experiment.v1, or a folder of trials, or
            of selections with their scenes.
        source: Format: r2handoversim.
        out: A new or empty folder for benchmark.yaml, predictions.npz, motions.npz and trials.csv.
    """
    from r2h_batch.data import release
    from r2h_batch.runs.header import motions_left_out

    check_output_folder(out, overwrite=None)
    found, none = release.read_trials(path)
    counts = release.write(out, found)
    kind = "motions" if counts["motions"] else "predictions"
    line = ["--benchmark", out / "benchmark.yaml", f"--{kind}", out / f"{kind}.npz", "--out", "RUN"]
    print(
        f"{counted(counts['trials'], 'trials')} of {counted(counts['objects'], 'objects')} in {out},"
        f" {counts['motions']} with a motion of our gripper, hands as {counts['hands']}; judge them with:"
        f" r2h-batch sweep {shlex.join(map(str, line))}"
        + (f"; {counted(none, 'selections')} without a feasible grasp left out" if none else "")
    )
    for words in motions_left_out(counts["left_out"]):
        print(words)
    return 0


def results(
    path: Annotated[Path, tyro.conf.Positional],
    *,
    source: Annotated[Literal["r2handoversim"], tyro.conf.arg(name="from", metavar="SOURCE")],
    out: Path,
) -> int:
    """Write verdicts of the authors' release as a run folder for report and compare.

    Args:
        path: A results.json, or a folder that has one.
        source: Format: r2handoversim.
        out: A new or empty folder.
    """
    from r2h_batch.data.release_results import write_results

    check_output_folder(out, overwrite=None)
    counts = write_results(path, out)
    print(
        f"{counted(counts['trials'], 'verdicts')} of {counted(counts['variants'], 'variants')} in {out},"
        f" as the release says them; show them with: r2h-batch report {shlex.quote(str(out))}"
    )
    return 0


def _grasp_files(
    folder: Path | None, names: Sequence[str], gripper: str | None
) -> "dict[str, GraspSet]":
    """The grasps of each of these objects."""
    from r2h_batch.data.grasp_files import FRAMELESS, GRASP_FILES, grasps_from

    if folder is None:
        return {}
    known = {p.stem: p for p in sorted(folder.glob("*")) if p.suffix in (*GRASP_FILES, *FRAMELESS)}
    if missing := [n for n in names if n not in known]:
        raise FileError(
            f"{printable(folder)}: no grasps of {printable(missing[0])}; files are called after objects"
        )
    return {n: grasps_from(f"{known[n]}:{gripper}" if gripper else known[n]) for n in names}


COMMANDS: dict[str, Command] = {
    f.__name__: f for f in (hand, hands, people, grasps, objects, trials, results)
}


def _npz(out: Path, overwrite: bool) -> Path:
    if out.suffix != ".npz":
        raise UsageError(f"--out {out}: give a name that ends in .npz")
    check_output_file(out, overwrite=overwrite)
    return out
