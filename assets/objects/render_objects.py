"""Renders the contact sheet: ``MUJOCO_GL=osmesa python -m r2h_batch.assets.objects.render_objects docs/objects.png``.

Parts are tinted; the receiver's region is drawn in warm colours, everything else in cool ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.scene.model_parts import look_on_white
from r2h_batch.scene.objects import ObjectModel, load_objects

COOL = (
    (0.36, 0.60, 0.78),
    (0.22, 0.36, 0.52),
    (0.55, 0.72, 0.70),
    (0.30, 0.33, 0.40),
    (0.62, 0.66, 0.74),
    (0.25, 0.52, 0.55),
)
WARM = (
    (0.93, 0.42, 0.18),
    (0.95, 0.60, 0.16),
    (0.80, 0.24, 0.20),
    (0.98, 0.72, 0.30),
    (0.70, 0.32, 0.12),
    (0.90, 0.35, 0.40),
)
# Camera azimuth and elevation (degrees) from which an object looks familiar.
VIEWS: dict[str, tuple[float, float]] = {
    "game_controller": (75, -52), "bowl": (40, -35), "headphones": (150, -15), "eyeglasses": (215, -22),
    "cup": (40, -25), "wineglass": (40, -18), "hammer": (105, -50), "pliers": (100, -60), "knife": (100, -60),
    "toothbrush": (115, -25), "screwdriver": (115, -35), "scissors": (100, -65), "power_drill": (115, -15),
    "binoculars": (205, -38), "bottle": (40, -14), "trigger_sprayer": (115, -12),
}  # fmt: skip


def render(model: ObjectModel, size: int) -> NDArray[np.uint8]:
    """(size, size, 3) picture of one object on white."""
    spec = mujoco.MjSpec()
    look_on_white(spec, size, highlights=0.15, lamp=0.45, lamp_highlights=0.2)
    normals = _smooth_normals(model.mesh)
    for k in range(len(model.part_names)):
        for taken in (False, True):
            chosen = (model.face_part == k) & (model.receiver_face == taken)
            if not chosen.any():
                continue
            name = f"part{k}{taken}"
            corners = model.vertices[model.faces[chosen]].reshape(-1, 3)
            mesh = spec.add_mesh(name=name)
            mesh.uservert = corners.ravel()
            mesh.usernormal = normals[chosen].reshape(-1)
            mesh.userface = np.arange(len(corners))
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            color = (WARM if taken else COOL)[k % 6]
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=[*color, 1], contype=0, conaffinity=0
            )
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = VIEWS.get(model.name, (120, -30))
    camera.lookat = (model.vertices.min(axis=0) + model.vertices.max(axis=0)) / 2
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rel = model.vertices - camera.lookat
    wide = np.maximum(np.abs(rel @ right), np.abs(rel @ np.cross(right, forward)))
    camera.distance = float((1.08 * wide / np.tan(np.radians(compiled.vis.global_.fovy / 2)) - rel @ forward).max())
    with mujoco.Renderer(compiled, 2 * size, 2 * size) as renderer:
        renderer.update_scene(data, camera)
        picture = renderer.render().astype(np.float32)
    return picture.reshape(size, 2, size, 2, 3).mean(axis=(1, 3)).astype(np.uint8)


def contact_sheet(models: tuple[ObjectModel, ...], path: Path, tile: int = 300, columns: int = 4) -> None:
    """Write a PNG with all objects and their names."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(size=18)
    rows = -(-len(models) // columns)
    sheet = Image.new("RGB", (columns * tile, rows * (tile + 28)), "white")
    draw = ImageDraw.Draw(sheet)
    for k, model in enumerate(models):
        x, y = k % columns * tile, k // columns * (tile + 28)
        sheet.paste(Image.fromarray(render(model, tile)), (x, y))
        text = f"{model.name.replace('_', ' ')} ({model.split})"
        draw.text((x + tile / 2, y + tile + 4), text, fill=(40, 40, 40), font=font, anchor="ma")
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _smooth_normals(mesh: trimesh.Trimesh) -> NDArray[np.float32]:
    """(F, 3, 3) normals per corner: averaged over the faces around it that meet it at less than 35 degrees."""
    result = np.empty((len(mesh.faces), 3, 3), np.float32)
    weighted = mesh.face_normals * mesh.area_faces[:, None]
    for f, face in enumerate(mesh.faces):
        for c, v in enumerate(face):
            around = mesh.vertex_faces[v]
            around = around[around >= 0]
            near = around[mesh.face_normals[around] @ mesh.face_normals[f] > np.cos(np.radians(35))]
            n = weighted[near].sum(axis=0)
            result[f, c] = n / np.linalg.norm(n)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--tile", type=int, default=300)
    parser.add_argument("--columns", type=int, default=4)
    args = parser.parse_args()
    contact_sheet(load_objects(args.names or None), args.out, args.tile, args.columns)


if __name__ == "__main__":
    main()
