"""`r2h-batch import region FILE`: where people would take an object, proposed by the contact network and drawn."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

LEAST, MOST = 0.1, 0.6
"""Share of the surface that a proposal may have: the robot needs a place too."""


def propose(file: Path, out: Path, *, scale: float = 1.0) -> tuple[NDArray[np.bool_], float]:
    """Write a region for an object of S1, FILE.region.npy and a picture FILE.region.png.

    Args:
        file: the mesh.
        out: the folder for both files.
        scale: multiplies the coordinates (0.001 for millimetres).

    Returns:
        A bool for each face of the file, and the region's share of the surface.

    Raises:
        ObjectMeshError: the mesh cannot be read.
        RenderError: nothing draws on this machine; the region is written.
    """
    import torch

    from r2h_batch.methods.predictors.contacts import CONTACT_THRESHOLD
    from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
    from r2h_batch.methods.predictors.principal_axes import load_axes_network
    from r2h_batch.scene.mesh_import.file import load_mesh_file
    from r2h_batch.scene.objects import build_object

    model = build_object(file, scale=scale)
    given = load_mesh_file(file, file.stem)
    x, y, z = voxel_of_points(model).T
    with torch.no_grad():
        chance = load_axes_network()(contact_grids([model]))[0, x, y, z].numpy()
    # points cover the surface evenly, so quantiles of them are shares of it
    limit = np.clip(
        CONTACT_THRESHOLD, np.quantile(chance, 1 - MOST), np.quantile(chance, 1 - LEAST)
    )
    _, nearest = cKDTree(model.points).query(scale * given.triangles_center, k=8)
    region = chance[nearest].mean(1) >= limit
    share = float(given.area_faces[region].sum() / given.area)
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / f"{file.stem}.region.npy", region)
    draw(given.triangles, region, out / f"{file.stem}.region.png")
    return region, share


def draw(
    triangles: NDArray[np.float64], region: NDArray[np.bool_], file: Path, pixels: int = 640
) -> None:
    """A picture of the object from two sides, the region in orange.

    Args:
        triangles: (F, 3, 3), in any unit.
        region: (F,) faces of the region.
        file: a .png.
        pixels: width and height of each view.

    Raises:
        RenderError: nothing draws on this machine.
    """
    import mujoco

    from r2h_batch.scene.model_parts import look_on_white
    from r2h_batch.scene.offscreen import renderer
    from r2h_batch.view.pictures import save_picture

    spec = mujoco.MjSpec()
    look_on_white(spec, pixels, highlights=0.15, lamp=0.45, lamp_highlights=0.2)
    for name, chosen, color in (
        ("rest", ~region, (0.36, 0.60, 0.78)),
        ("region", region, (0.93, 0.42, 0.18)),
    ):
        if not chosen.any():
            continue
        corners = triangles[chosen]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        corners, normal = corners[(size := np.linalg.norm(normal, axis=1)) > 0], normal[size > 0]
        mesh = spec.add_mesh(name=name)
        mesh.uservert = corners.ravel()
        mesh.usernormal = np.repeat(
            normal / np.linalg.norm(normal, axis=1, keepdims=True), 3, 0
        ).ravel()
        mesh.userface = np.arange(3 * len(corners))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            rgba=[*color, 1],
            contype=0,
            conaffinity=0,
        )
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    low, high = triangles.reshape(-1, 3).min(0), triangles.reshape(-1, 3).max(0)
    camera.lookat[:], camera.distance = (low + high) / 2, 1.3 * float(np.linalg.norm(high - low))
    images = []
    with renderer(model, pixels, pixels) as drawer:
        for azimuth, elevation in ((60.0, -30.0), (240.0, -30.0)):
            camera.azimuth, camera.elevation = azimuth, elevation
            drawer.update_scene(data, camera)
            images.append(np.array(drawer.render()))
    save_picture(file, np.concatenate(images, 1))
