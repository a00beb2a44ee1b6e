"""Renders contact sheets: ``MUJOCO_GL=osmesa python -m r2h_batch.assets.receiving.render_receiving docs/receiving.png``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.assets.objects.render_objects import COOL, WARM
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.model_parts import look_on_white
from r2h_batch.scene.objects import ObjectModel, load_objects
from r2h_batch.trials.holding.receiving import load_receiving

VIEW_RADIUS_M = 0.125
"""Half the height of what a tile shows, around the hand: long objects are cut off."""
SKIN = (0.87, 0.66, 0.54, 1.0)


def render(
    model: ObjectModel, hand: NDArray[np.float32], side: int, size: int, views: Sequence[tuple[float, float]]
) -> NDArray[np.uint8]:
    """(size, size, 3) picture of an object and a hand on it (skin in the object's frame), on white.

    Of the views (azimuth and elevation in degrees) the one that shows most of the hand.
    """
    spec = mujoco.MjSpec()
    look_on_white(spec, size, highlights=0.1, lamp=0.4, lamp_highlights=0.1)
    pieces: list[tuple[str, np.ndarray, np.ndarray, tuple[float, ...]]] = [
        ("hand", hand, load_hand().faces_by_side[side].numpy(), SKIN)
    ]
    for k in range(len(model.part_names)):
        for taken in (False, True):
            chosen = (model.face_part == k) & (model.receiver_face == taken)
            if chosen.any():
                red, green, blue = (WARM if taken else COOL)[k % 6]
                pieces.append((f"part{k}{taken}", model.vertices, model.faces[chosen], (red, green, blue, 1.0)))
    for name, vertices, faces, color in pieces:
        corners = vertices[faces].reshape(-1, 3)
        normal = _normals(vertices, faces if name == "hand" else model.faces)
        flat = np.cross(corners[1::3] - corners[::3], corners[2::3] - corners[::3])
        smooth = normal[faces].reshape(-1, 3) if name == "hand" else np.repeat(flat, 3, 0)
        mesh = spec.add_mesh(name=name)
        mesh.uservert, mesh.usernormal = corners.ravel(), smooth.ravel()
        mesh.userface = np.arange(len(corners))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=color, contype=0, conaffinity=0)
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    camera = mujoco.MjvCamera()
    camera.lookat = (hand.min(0) + hand.max(0)) / 2
    camera.distance = VIEW_RADIUS_M / np.tan(np.radians(compiled.vis.global_.fovy / 2))
    shown = []
    with mujoco.Renderer(compiled, 64, 64) as small:
        small.enable_segmentation_rendering()
        for camera.azimuth, camera.elevation in views:
            small.update_scene(data, camera)
            shown.append(int((small.render()[:, :, 0] == 0).sum()))  # the hand is geom 0
    camera.azimuth, camera.elevation = views[int(np.argmax(shown))]
    with mujoco.Renderer(compiled, 2 * size, 2 * size) as renderer:
        renderer.update_scene(data, camera)
        picture = renderer.render().astype(np.float32)
    return picture.reshape(size, 2, size, 2, 3).mean(axis=(1, 3)).astype(np.uint8)


def _normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    corner = vertices[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], cross)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)


def contact_sheet(
    models: Sequence[ObjectModel], path: Path, *, tile: int, columns: int, sides: Sequence[int] = (0, 1)
) -> None:
    """Write a PNG with `columns` grasps of each object in a row, right hands and left hands in turn."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(size=max(11, tile // 12))
    grasps = load_receiving(models)
    skin, joints = grasps.vertices.numpy(), grasps.joints.numpy()
    sheet = Image.new("RGB", (columns * tile, len(models) * (tile + 18)), "white")
    draw = ImageDraw.Draw(sheet)
    for row, model in enumerate(models):
        for column in range(columns):
            side = sides[column % len(sides)]
            mine = grasps.rows_of(row, side).numpy()
            i = mine[(column // len(sides)) * len(mine) // -(-columns // len(sides))]
            picture = render(model, skin[i], side, tile, _views(joints[i], side))
            x, y = column * tile, row * (tile + 18)
            sheet.paste(Image.fromarray(picture), (x, y))
            text = f"{('right', 'left')[side]}: {model.part_names[int(grasps.part[i])].replace('_', ' ')}"
            text = text if column else model.name.replace("_", " ")
            draw.text((x + tile / 2, y + tile), text, fill=(40, 40, 40), font=font, anchor="ma")
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(160, dither=Image.Dither.NONE).save(path, optimize=True)


def _views(joints: NDArray[np.float32], side: int) -> list[tuple[float, float]]:
    """Azimuth and elevation (degrees) of cameras on a hand's palm, thumb, fingertip and little finger sides."""
    fingers = joints[4] - joints[0]
    across = joints[1] - joints[7]
    palm = np.cross(joints[1] - joints[0], joints[7] - joints[0]) * (-1 if side else 1)
    thumb, ahead, front = (v / np.linalg.norm(v) for v in (across, fingers, palm))
    views = []
    for x, y, z in ((0.6, 0.2, 0.75), (0.95, 0.0, 0.3), (0.7, 0.6, 0.4), (0.2, 0.9, 0.4), (-0.7, 0.3, 0.65)):
        look = -(x * thumb + y * ahead + z * front)
        look /= np.linalg.norm(look)
        views.append((float(np.degrees(np.arctan2(look[1], look[0]))), float(np.degrees(np.arcsin(look[2])))))
    return views


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--tile", type=int, default=150)
    parser.add_argument("--columns", type=int, default=8)
    args = parser.parse_args()
    contact_sheet(load_objects(args.names or None), args.out, tile=args.tile, columns=args.columns)


if __name__ == "__main__":
    main()
