"""`r2h-batch import ...`: `import robot`, which also solves for the robot and draws it, and those of
import_files.py."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from r2h_batch.base.command_line import Command, check_range
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.write import check_output_folder
from r2h_batch.commands.import_files import COMMANDS as FILES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from r2h_batch.data.robot import Imported
    from r2h_batch.data.robot_pads import Window
    from r2h_batch.scene.robot import Robot

TARGETS = 10_000
"""Random postures within limits whose poses the inverse kinematics is asked for."""
PIXELS = 640
TOO_LARGE_MM = 3.0
PROUD_MM = 0.5
PAD_RGBA, PAD_MARGIN_M = (0.1, 0.7, 0.2, 1.0), 5e-4


def robot(
    *,
    base: str,
    flange: str,
    out: Path,
    urdf: Path | None = None,
    mjcf: Path | None = None,
    source: Annotated[str, tyro.conf.arg(name="from", metavar="PACKAGE:NAME")] = "",
    srdf: Path | None = None,
    gripper: Literal["2f85"] = "2f85",
    fingers: str = "",
    offset: str = "",
    pads: str = "",
    home: str = "",
    name: str = "",
    payload: float | None = None,
    package: tuple[str, ...] = (),
    yes: bool = False,
) -> int:
    """Write an arm with a gripper as a folder for --robot: robot.yaml, robot.npz, report.json, home.png.

    Args:
        base: The link that stands on the table.
        flange: The link that carries the gripper, or a site of an MJCF. Its z points away from the arm.
        out: A new or empty folder.
        urdf: The arm. Its meshes are .obj, .stl, .ply, .glb or .dae, beside it or in a --package.
        mjcf: The arm as MuJoCo's XML, in place of --urdf. Meshes and includes lie in its folder or a --package.
        source: The arm's file in an installed package, in place of --urdf and --mjcf: how its path ends
            (example-robot-data:tiago.urdf), or a module that tells it (robot_descriptions:panda_description).
        srdf: Names postures, and pairs of links that never collide. The report compares these pairs with
            the command's own.
        gripper: The gripper at the flange.
        fingers: LINK,LINK: the two links of the file's own gripper that grasp, in place of --gripper.
        offset: X,Y,Z,ROLL,PITCH,YAW: the flange in the frame of --flange, m and rad.
        pads: LOW,HIGH,WIDTH: where the pads are on the fingers' meshes: heights above the flange and width with
            the gripper closed, m. By default: the file's boxes, or flats of the meshes that face each other.
        home: Posture at the start: rad with commas, as --home=-0.5,1,..., or the name of a state in --srdf.
        name: Name of the robot in tables; by default the folder's and the gripper's.
        payload: Payload of the arm in its data sheet, gripper included, kg.
        package: NAME=FOLDER: the folder that package://NAME/ means; not needed where the file lies in NAME. Names
            with .. may lead to it.
        yes: Take the proposed turn of a flange whose z does not point away from the arm.
    """
    from dataclasses import replace

    from r2h_batch.base.io.write import write_json
    from r2h_batch.data.robot import import_robot
    from r2h_batch.data.robot_packages import file_from
    from r2h_batch.scene.offscreen import RenderError
    from r2h_batch.scene.robot_file import write_robot

    if [urdf is None, mjcf is None, not source].count(False) != 1:
        raise UsageError("give the arm as --urdf FILE, as --mjcf FILE or as --from PACKAGE:NAME")
    found_in = file_from(source) if source else None
    file = urdf or mjcf or Path() if found_in is None else found_in.file
    if payload is not None:
        check_range("--payload", payload, 0.01, 1e4, " kg")
    check_output_folder(out, overwrite=None)
    folders = {k: Path(v) for k, _, v in (p.partition("=") for p in package)}
    if wrong := [p for p in package if not all(p.partition("="))]:
        raise UsageError(f"--package {wrong[0]}: write NAME=FOLDER")
    one, _, other = fingers.partition(",")
    if fingers and not (one and other):
        raise UsageError(f"--fingers {fingers}: write LINK,LINK")
    found = import_robot(
        file, name=name or f"{out.name}_{'jaws' if fingers else gripper}", base=base, flange=flange,
        packages=folders, fingers=(one, other) if fingers else None, srdf=srdf, home=_posture(home),
        offset=_pose("--offset", offset), pads=_window(pads, fingers), turn=yes,
        folders=() if found_in is None else (found_in.folder,),
    )  # fmt: skip
    with progress(f"{found.robot.name}: misses of its inverse kinematics", 1, "count"):
        count = missed(found.robot)
    arm = replace(found.robot, ik_missed=(TARGETS, count), payload_kg=payload)
    report = found.report | {"ik_targets": TARGETS, "ik_missed": count}
    write_robot(out, arm)
    write_json(out / "report.json", report)
    _tell(arm, report)
    try:
        draw(found, out / "home.png")
        print(f"{arm.name}: look at {out / 'home.png'}: what the file shows, and what collides")
    except RenderError as error:
        print(f"{arm.name}: no home.png: {error}")
    print(f"{arm.name}: written to {out}")
    return 0


def _numbers(flag: str, text: str, count: int, form: str) -> list[float]:
    try:
        found = [float(x) for x in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(abs(x) < 10 for x in found):
        raise UsageError(f"{flag} {text}: write {form}, m and rad, each below 10")
    return found


def _pose(flag: str, text: str) -> "NDArray[np.float64] | None":
    """(4, 4), or None where nothing is given."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    if not text:
        return None
    numbers, T = _numbers(flag, text, 6, "X,Y,Z,ROLL,PITCH,YAW"), np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
    T[:3, 3] = numbers[:3]
    return T


def _window(text: str, fingers: str) -> "Window | None":
    from r2h_batch.data.robot_pads import Window

    if not text:
        return None
    if not fingers:
        raise UsageError("--pads needs --fingers: the 2F-85 has pads of its own")
    found = Window(*_numbers("--pads", text, 3, "LOW,HIGH,WIDTH"))
    if not (found.low < found.high and found.width > 0):
        raise UsageError(f"--pads {text}: LOW must be below HIGH, and WIDTH above 0")
    return found


def _posture(home: str) -> "tuple[float, ...] | str":
    """Numbers, or a name."""
    try:
        return tuple(float(x) for x in home.split(",")) if home else ()
    except ValueError:
        return home


def missed(robot: "Robot", targets: int = TARGETS) -> int:
    """How many poses of random postures within limits the inverse kinematics finds no posture for."""
    import numpy as np
    import torch

    from r2h_batch.judge.ik import solve_ik
    from r2h_batch.scene.robot import ee_pose

    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (targets, len(robot.joints)))
    poses = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    return int((~solve_ik(poses, robot=robot).reachable).sum())


def _tell(robot: "Robot", report: dict[str, Any]) -> None:
    """The report in lines."""
    for link, row in report["links"].items():
        large = row["mean_mm"] > TOO_LARGE_MM
        print(
            f"{link:10s} {row['primitives']} bodies, overshoot mean {row['mean_mm']:.2f} mm,"
            f" mesh outside {max(row['worst_protrusion_mm'], 0):.3f} mm"
            + (f"; {row['from']}" if "from" in row else "")
            + (f"; {row['not_used']}: not used" if "not_used" in row else "")
            + (": a body that is too large fails motions that are free" if large else "")
        )
    checked = {
        " - ".join(robot.links[k] for k in sorted(pair)) for pair in robot.self_pairs.tolist()
    }
    for pair, why in report["pairs"].items():
        if pair not in checked:
            print(f"not checked: {pair}: {why}")
    for key, words in (
        ("off_but_checked", "the SRDF does not check, here checked"),
        ("on_but_not_checked", "the SRDF checks, here not"),
    ):
        for pair, why in report.get("srdf", {}).get(key, {}).items():
            print(f"{words}: {pair}: {why}")
    if states := report.get("srdf", {}).get("states"):
        print(f"postures of the SRDF, for --home: {', '.join(states)}")
    for joint, row in report["joints"].items():
        print(
            f"{joint}: {row['lower_rad']:.3f} to {row['upper_rad']:.3f} rad, {row['speed_rad_s']:.3g} rad/s,"
            f" {row['torque_nm']:.3g} N m"
        )
    if robot.payload_kg is not None:
        left = f"{robot.carries_kg:.2f} kg for objects"
        print(f"payload: {robot.payload_kg:g} kg at the flange, {left}")
    if row := report.get("pads"):
        if "from" in row:
            print(
                f"pads: {row['from']}, {1e3 * row['low_m']:.1f} to {1e3 * row['high_m']:.1f} mm above the flange,"
                f" {1e3 * row['width_m']:.1f} mm wide, green in home.png; other ones: --pads=LOW,HIGH,WIDTH"
            )
            if row["proud_mm"] > PROUD_MM:
                print(f"pads: the fingers stand {row['proud_mm']:.1f} mm before them")
        if "turn" in row:
            print(f"pads: the file turns them by {row['turn']}")
    if joints := report.get("assumed_speed"):
        speed = report["joints"][joints[0]]["speed_rad_s"]
        how = f"{speed:g} rad/s each; edit max_velocity_rad_s of robot.yaml"
        print(f"speeds: the file has none of {', '.join(joints)}: {how}")
    if masses := report.get("assumed_mass_kg"):
        print(
            f"masses: of convex hulls, {', '.join(f'{k} {kg:.2g} kg' for k, kg in masses.items())}"
        )
    kind = "closed form" if robot.family == "ur" else "numerical"
    print(
        f"{robot.name}: inverse kinematics {kind}, {report['ik_missed']} of {report['ik_targets']} reachable poses"
        f" missed; reach {1e3 * robot.reach_m:.0f} mm, home {list(robot.home_q)} rad"
    )


def draw(imported: "Imported", file: Path) -> None:
    """Writes a picture of the robot at home: what its file shows on the left, what collides on the right.

    Raises:
        RenderError: nothing draws on this machine.
    """
    import mujoco
    import numpy as np

    from r2h_batch.scene.dynamics import quat_wxyz
    from r2h_batch.scene.model_parts import (
        COLLISION,
        VISUAL,
        add_mesh,
        add_mesh_geom,
        add_primitive,
    )
    from r2h_batch.scene.offscreen import renderer
    from r2h_batch.scene.robot import forward_kinematics, gripper_primitives_at
    from r2h_batch.view.pictures import save_picture

    robot, spec = imported.robot, mujoco.MjSpec()
    T = forward_kinematics(robot, np.array(robot.home_q))
    world, corners = spec.worldbody, []
    for k, triangles in enumerate(imported.seen):
        points = triangles.reshape(-1, 3)
        at = T[k] if k <= len(robot.joints) else T[-2] @ robot.T_wrist3_flange
        corners.append(points @ at[:3, :3].T + at[:3, 3])
        faces = np.arange(len(points)).reshape(-1, 3)
        add_mesh(spec, f"seen_{k}", points, faces, convex=False)
        add_mesh_geom(world, f"seen_{k}", f"seen_{k}", "upper_arm", T=at)
    for i, link in enumerate(robot.arm.link):
        place = T[link] @ robot.arm.T_link_prim[i]
        add_primitive(spec, world, robot.arm, i, place, 0, 0, f"body_{i}")
    T_ee = T[-2] @ robot.T_wrist3_ee
    for i, place in enumerate(gripper_primitives_at(robot, robot.open_gap_m)):
        add_primitive(spec, world, robot.gripper, i, T_ee @ place, 0, 0, f"part_{i}")
        corners.append((T_ee @ place)[None, :3, 3])
        if robot.gripper_part[i] == "pad":  # in both pictures, a little larger than what it lies in
            at, half = T_ee @ place, robot.gripper.size[i] + PAD_MARGIN_M
            for group in (VISUAL, COLLISION):
                world.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=at[:3, 3], quat=quat_wxyz(at[:3, :3]),
                    group=group, rgba=PAD_RGBA, contype=0, conaffinity=0,
                )  # fmt: skip
    for geom in spec.geoms:
        geom.rgba[3] = 1.0
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=16, height=96,
    )  # fmt: skip
    model = spec.compile()
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.35, 0.6
    model.vis.global_.offwidth = model.vis.global_.offheight = PIXELS
    data, camera, option = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvOption()
    mujoco.mj_forward(model, data)
    low, high = np.concatenate(corners).min(0), np.concatenate(corners).max(0)
    camera.lookat[:], camera.distance = (low + high) / 2, 1.2 * float(np.linalg.norm(high - low))
    camera.azimuth, camera.elevation = 125.0, -15.0
    images = []
    with renderer(model, PIXELS, PIXELS) as drawer:
        for group in (VISUAL, COLLISION):
            option.geomgroup[:] = 0
            option.geomgroup[group] = 1
            drawer.update_scene(data, camera, option)
            images.append(np.array(drawer.render()))
    save_picture(file, np.concatenate(images, 1))


COMMANDS: dict[str, Command] = {**FILES, "robot": robot}
