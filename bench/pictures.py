"""Pictures of the built-in methods for docs, drawn by `make tables` (bench/tables.py) from the rows of Table I.

A run's report and gallery, pages of single trials (Chromium), strips, the scene, and what each method holds.
"""

import hashlib
import shutil
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path

HOLDING = ("fc", "handover_va", "contact", "intent")
HELD = [1, 3, 5, 9, 13, 17, 19, 4, 8]
"""Trials whose grasps are drawn."""
OF_RELEASE = 63
"""A trial of r2h-release in which all four methods move and their outcomes differ."""
GREY, BLUE, ORANGE, SKIN = (0.3, 0.3, 0.3, 1), (0.25, 0.45, 0.8, 1), (0.95, 0.55, 0.1, 1), (0.9, 0.72, 0.6, 1)
GPU_LESS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def browser() -> str:
    """Chromium by whatever name it has here."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    return found or sys.exit("pictures: no browser; install chromium")


def draw(run: Path, release: Path, out: Path) -> dict[str, str]:
    """Draws all of them into `out`, from rows of the default benchmark and of r2h-release; file -> sha256."""
    from r2h_batch.__main__ import main

    def command(*words: object) -> None:
        if code := main([str(w) for w in words]):
            sys.exit(code)

    with tempfile.TemporaryDirectory() as place:
        folder, alone = Path(place), (out / "pictures").resolve()
        command("report", run, "--format", "html", "--out", folder / "page.html")
        screenshot(folder / "page.html", out / "report.png", 1280, 1262)
        gallery = (
            "--method",
            "fc",
            "handover-va",
            "--format",
            "html",
            "--gallery",
            2,
            "--out",
            folder / "gallery.html",
        )
        command("report", run, *gallery)
        only = "<style>body > :not(section), section:not(:has(.gallery)) { display: none !important }</style></body>"
        page = (folder / "gallery.html").read_text(encoding="utf-8").replace("</body>", only)
        page = page.replace("<details", "<details open")
        (folder / "gallery.html").write_text(page, encoding="utf-8")
        screenshot(folder / "gallery.html", out / "gallery.png", 940, 790)
        strips = ("--strips", out / "release_strips.png", "--overwrite")
        command("view", release, "--method", "handover-va", "fc", "contact", "intent", "--trial", OF_RELEASE, *strips)
        overview(release, "handover-va", out / "release_scene.png")
        moved, stopped = trials_of(run)
        for name, methods, trial in (
            ("success", ["fc"], moved), ("failed_plan", ["fc"], stopped), ("two", ["fc", "contact"], moved),
        ):  # fmt: skip
            command("view", run, "--method", *methods, "--trial", trial, "--html", folder / f"{name}.html")
            screenshot(folder / f"{name}.html", alone / f"view_{name}.png", 1280, 800, *GPU_LESS)
        strips = ("--strips", out / "strips_5.png", "--overwrite")
        command("view", run, "--method", "fc", "handover-va", "contact", "intent", "--trial", 5, *strips)
        scene = ("--out", folder / "scene", "--render", out / "scene.png", "--overwrite")
        command("export", "scene", run, "--method", "fc", "--trial", moved, *scene)
    grasps(out / "baselines_grasps.png")
    drawn = [
        out / f"{name}.png" for name in ("report", "gallery", "strips_5", "scene", "release_scene", "release_strips")
    ]
    drawn += [
        out / "baselines_grasps.png",
        *(out / "pictures" / f"view_{n}.png" for n in ("success", "failed_plan", "two")),
    ]
    return {p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in drawn}


def overview(run: Path, method: str, png: Path) -> None:
    """The paper's Figure 1: arm, hand and the ball where the object must be, at the end of the method's first success."""
    from r2h_batch.view.drawing import Drawing, view_of
    from r2h_batch.view.gallery.pictures import first_of_each_outcome
    from r2h_batch.view.pictures import painter, save_picture
    from r2h_batch.view.stored import Reader

    reader, size = Reader(run), (1200, 800)
    name = reader.run.named(method)
    drawing = Drawing(reader.trial(first_of_each_outcome(reader.run, name, 1)["success"][0], name))
    with painter(drawing, size, view_of([drawing], size[0] / size[1])) as paint:
        save_picture(png, paint(drawing.moments(2)[-1][1], "ball"))


def trials_of(run: Path) -> tuple[int, int]:
    """The first trial that FC- and Contact-Handover both solve, and the first whose target posture of FC-Handover collides."""
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    fc, contact = (stored.trials(stored.named(word)).to_pylist() for word in ("fc", "contact"))
    moved = next(a["trial_id"] for a, b in zip(fc, contact) if a["outcome"] == b["outcome"] == "success")
    return moved, next(row["trial_id"] for row in fc if row["plan_reason"] == "ik_in_collision")


def screenshot(html: Path, png: Path, width: int, height: int, *flags: str) -> None:
    """The page as headless Chromium shows it."""
    how = [
        "--headless=new",
        "--no-sandbox",
        "--hide-scrollbars",
        "--virtual-time-budget=6000",
        *(flags or ["--disable-gpu"]),
    ]
    with tempfile.TemporaryDirectory() as profile:
        line = [browser(), *how, f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        line += [f"--screenshot={png.resolve()}", html.resolve().as_uri()]
        subprocess.run(line, check=True, capture_output=True, timeout=240)


def held(model, T_obj_ee, opening, hand, hand_faces, size):
    """Rendered from one side, in the object's frame."""
    import mujoco
    import torch
    from scipy.spatial.transform import Rotation

    from r2h_batch.judge.grasp import gripper_poses
    from r2h_batch.scene.robot_file import load_robot

    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth = spec.visual.global_.offheight = size
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=8, height=8,
    )  # fmt: skip
    region = model.receiver_face
    surfaces = [
        ("region", model.vertices, model.faces[region], ORANGE),
        ("rest", model.vertices, model.faces[~region], BLUE),
        ("hand", hand, hand_faces, SKIN),
    ]
    for name, vertices, faces, rgba in surfaces:
        if len(faces):
            mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert, mesh.userface = vertices.astype(float).ravel().tolist(), faces.astype(int).ravel().tolist()
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=rgba)
    prims, (R, p) = (
        load_robot().gripper,
        (x[0].double().numpy() for x in gripper_poses(load_robot(), torch.tensor([opening]))),
    )
    shapes = ("SPHERE", "CAPSULE", "CYLINDER", "BOX")
    for g, kind in enumerate(prims.kind):
        q = Rotation.from_matrix(T_obj_ee[:3, :3] @ R[g]).as_quat(scalar_first=True)
        at = T_obj_ee[:3, :3] @ p[g] + T_obj_ee[:3, 3]
        shape = getattr(mujoco.mjtGeom, f"mjGEOM_{shapes[int(kind)]}")
        spec.worldbody.add_geom(type=shape, size=prims.size[g], pos=at, quat=q, rgba=GREY)
    spec.worldbody.add_light(pos=[0.3, -0.3, 1], dir=[-0.3, 0.3, -1])
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = 0, 0.72, 120, -30
    with mujoco.Renderer(compiled, size, size) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render().copy()


def grasps(png: Path) -> None:
    """Grasp of each method: gripper, object (receiver's region orange) and the receiving hand that it was shown.

    Without the error model; the word after the object is the verdict.
    """
    import torch
    from matplotlib.figure import Figure

    from r2h_batch import load_benchmark
    from r2h_batch.evaluate import Evaluator
    from r2h_batch.judge.grasp import close_gripper
    from r2h_batch.methods.predictors import PredictorNoise, predict_receiving, retrieve_receiving
    from r2h_batch.verdicts import Outcome

    evaluator = Evaluator(load_benchmark()).kinematic
    scene, trials = evaluator.scene, load_benchmark().trials_with_ids(torch.tensor(HELD))
    exact = PredictorNoise().scaled(0)
    figure = Figure(figsize=(1.7 * len(trials), 1.95 * len(HOLDING)), layout="constrained")
    axes = figure.subplots(len(HOLDING), len(trials), squeeze=False)
    for i, name in enumerate(HOLDING):
        method = import_module(f"r2h_batch.methods.{name}")
        hand = (retrieve_receiving if name == "intent" else predict_receiving)(trials, scene, noise=exact)
        answer = method.predict(trials, scene, noise=exact)
        outcome = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials).outcome.tolist()
        opening = close_gripper(scene.grasp_tables, answer.T_obj_ee, trials.object_index).opening_m
        for j in range(len(trials)):
            model = scene.objects[int(trials.object_index[j])]
            faces = scene.hands.model.faces_by_side[int(hand.side[j])].numpy()
            T_obj_ee, skin = answer.T_obj_ee[j].double().numpy(), hand.vertices[j].numpy()
            axes[i, j].imshow(held(model, T_obj_ee, float(opening[j]), skin, faces, 260))
            axes[i, j].set_axis_off()
            said = f"{model.name.replace('_', ' ')}: {Outcome(outcome[j]).name.lower()}"
            axes[i, j].set_title(
                f"{method.TITLE} ({method.STAND_IN})\n{said}" if j == 0 else said, fontsize=7, loc="left"
            )
    figure.savefig(png, dpi=110)
