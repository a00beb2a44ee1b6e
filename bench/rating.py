"""Pictures of handovers that people rate: would you take it?

`python bench/rating.py` prints what came of the ratings in bench/ratings.csv: how far raters agree, and how far their majority
agrees with a limit t of Presented, or with a clearance that robot and object keep from the head. A line of the file is a picture
with its distances in metres and three ratings (take, not, unclear). `picture` draws a handover at rest from two sides and from
the person's eyes, the wanted part in green, without a word of method, margin or limit.
"""

import argparse
import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import torch
from _report import Report, markdown_table
from numpy.typing import NDArray
from run import Bench

from r2h_batch.scene.model_parts import VISUAL
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.person import eyes_of
from r2h_batch.view.drawing import FOV_DEG, REGION, Drawing, View
from r2h_batch.view.pictures import Image, painter

Array = NDArray[np.float64]

GREEN, PANEL, HEAD = (0.10, 0.72, 0.20, 1.0), (400, 380), 44
ABOVE_DEG = -65.0
FACE_M = 0.24  # nothing nearer to the eyes is drawn in what they see: it is the face itself
AZIMUTHS_DEG, ELEVATIONS_DEG, APART_DEG = np.arange(0.0, 360.0, 20.0), (-12.0, -35.0), 75.0
AROUND_M, RAYS = 0.07, 24
"""What a picture shows beside object and hand, and how many points of each decide from where."""


def points_of(drawing: Drawing, geom: int) -> Array:
    """Some vertices of a mesh geom (RAYS, 3) in the world, at the posture that `Drawing.at` had last."""
    model, data = drawing.model, drawing.at(drawing.stored.target_q)
    mesh = int(model.geom_dataid[geom])
    first, n = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    local = model.mesh_vert[first : first + n][np.linspace(0, n - 1, min(n, RAYS)).astype(int)]
    return local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def geoms(drawing: Drawing, *bodies: str) -> list[int]:
    """The visual meshes of bodies, or (with a slash) of one geom."""
    names = {g: str(drawing.model.geom(g).name) for g in range(drawing.model.ngeom)}
    mesh = int(mujoco.mjtGeom.mjGEOM_MESH)
    return [
        g
        for g, name in names.items()
        if drawing.model.geom_group[g] == VISUAL
        and drawing.model.geom_type[g] == mesh
        and any(name.startswith(b) for b in bodies)
    ]


def seen_share(drawing: Drawing, eye: Array, own: Sequence[int], points: Array) -> float:
    """Which share of points is hit first from an eye, or by another point of the same things."""
    model, data, group = drawing.model, drawing.at(drawing.stored.target_q), np.array([1, 1, 1, 0, 0, 0], np.uint8)
    hits, hit = 0, np.zeros(1, np.int32)
    for p in points:
        far = np.linalg.norm(p - eye)
        got = mujoco.mj_ray(model, data, eye, (p - eye) / far, group, 1, -1, hit)
        hits += got < 0 or got > far - 2e-3 or int(hit[0]) in own
    return hits / len(points)


def view_pair(drawing: Drawing, *, near: Array | None = None) -> list[View]:
    """The two cameras, APART_DEG or more from each other, that see most of object and hand.

    Args:
        drawing: the handover.
        near: other points (N, 3) that have to be in the picture.
    """
    thing, hand = geoms(drawing, "object/"), geoms(drawing, "hand/")
    parts = [np.concatenate([points_of(drawing, g) for g in own]) for own in (thing, hand)]
    every = np.concatenate(parts if near is None else [*parts, near])
    middle = (every.min(0) + every.max(0)) / 2
    distance = (np.linalg.norm(every - middle, axis=1).max() + AROUND_M) / np.tan(np.radians(FOV_DEG / 2))
    found = []
    for elevation in ELEVATIONS_DEG:
        for azimuth in AZIMUTHS_DEG:
            view = View(middle, float(azimuth), elevation, float(distance))
            eye = middle - distance * view.axes[2]
            shares = [seen_share(drawing, eye, own, p) for own, p in zip((thing, hand), parts, strict=True)]
            found.append((shares[0] + 0.7 * shares[1] - (0.05 if elevation < -20 else 0.0), view))
    found.sort(key=lambda f: -f[0])
    first = found[0][1]
    apart = [abs((v.azimuth_deg - first.azimuth_deg + 180) % 360 - 180) for _, v in found]
    return [first, next(v for (_, v), a in zip(found, apart, strict=True) if a >= APART_DEG)]


def from_eyes(drawing: Drawing) -> tuple[View, float]:
    """What the person sees: from between the eyes towards object and hand, and how wide (degrees)."""
    receiver = drawing.stored.receiver
    assert receiver is not None
    eye = eyes_of(torch.from_numpy(receiver)[None])[0].mean(0).numpy()
    things = np.concatenate([points_of(drawing, g) for g in geoms(drawing, "object/", "hand/")])
    middle = (things.min(0) + things.max(0)) / 2
    far = float(np.linalg.norm(middle - eye))
    x, y, z = (middle - eye) / far
    view = View(middle, float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(z))), far)
    wide = np.linalg.norm(things - middle, axis=1).max() + 1.5 * AROUND_M
    return view, float(2 * np.degrees(np.arctan(wide / far)))


def paint_green(drawing: Drawing) -> None:
    """The wanted part in green; where any part will do, all of it."""
    free = drawing.stored.object_model.split == "S0"
    for g in geoms(drawing, "object/") if free else [int(drawing.model.geom(REGION).id)]:
        drawing.model.geom_rgba[g], drawing.model.geom_matid[g] = GREEN, -1


def picture(drawing: Drawing, *, near: Array | None = None) -> Image:
    """Two sides and a third view beside each other, below the task in words.

    Args:
        drawing: the handover.
        near: other points (N, 3) that have to be in the picture. Then the third view is from above, else from the eyes.
    """
    pair = view_pair(drawing, near=near)
    third, wide = from_eyes(drawing) if near is None else (replace(pair[0], elevation_deg=ABOVE_DEG), FOV_DEG)
    paint_green(drawing)
    with painter(drawing, PANEL, pair[0]) as paint:
        panels = [paint(drawing.stored.target_q, "region", view=v) for v in pair]
        drawing.model.vis.global_.fovy = wide
        if near is None:
            drawing.model.vis.map.znear = FACE_M / drawing.model.stat.extent
        panels.append(paint(drawing.stored.target_q, "region", view=third))
    names = ("one side", "another side", "what the person sees" if near is None else "from above")
    return headed(np.concatenate(panels, axis=1), task_of(drawing.stored.object_model), names)


def task_of(model: ObjectModel) -> str:
    """What the person wants, in words."""
    words = model.instruction.removeprefix("hand over the ").removesuffix(" to human").upper()
    return f"The person wants the {words}" + (" (any part of it)" if model.split == "S0" else " (green)")


def headed(image: Image, words: str, names: Sequence[str]) -> Image:
    """The image below a line of words, with the names of its panels."""
    canvas = PIL.Image.new("RGB", (image.shape[1], image.shape[0] + HEAD), "white")
    canvas.paste(PIL.Image.fromarray(image), (0, HEAD))
    draw = PIL.ImageDraw.Draw(canvas)
    draw.text((10, 3), words, "black", font=PIL.ImageFont.load_default(20))
    for k, name in enumerate(names):
        draw.text((PANEL[0] * k + 10, 24), name, (90, 90, 90), font=PIL.ImageFont.load_default(14))
        draw.line((PANEL[0] * k, HEAD, PANEL[0] * k, canvas.height), "white", 2)
    return np.array(canvas)


RATINGS = Path(__file__).with_name("ratings.csv")
LIMITS_CM = {"S0": (0, 1, 2, 3, 5, 7, 7.5, 8, 9), "S1": (0, 1, 2, 3, 3.5, 4, 5, 7), "head": (0, 5, 7.5, 10, 12.5, 15)}
"""Limits that are compared with the majority: t of each split; the clearance from the head."""
SHOWN_CM = {"S0": (1, 7, 7.5, 8), "S1": (1, 3, 3.5, 4), "head": (5, 7.5, 10, 12.5)}
"""Those of the page: the one that was chosen, its neighbours, and a smaller one. The JSON has all."""


def ratings() -> dict[str, list[dict[str, str]]]:
    """The lines of the file: those of S0 and S1, and of the head."""
    found: dict[str, list[dict[str, str]]] = {kind: [] for kind in LIMITS_CM}
    with RATINGS.open() as file:
        for row in csv.DictReader(file):
            found[row["kind"]].append(row)
    return found


def takes(row: Mapping[str, str]) -> list[bool]:
    """Whether each rater would take it; who cannot say does not."""
    return [row[f"rater_{k}"] == "take" for k in (1, 2, 3)]


def fleiss_kappa(votes: NDArray[np.int64], raters: int) -> float:
    """Agreement of raters beyond chance (Fleiss 1971), two categories.

    Args:
        votes: (n,) how many of the raters said yes to each picture.
        raters: how many rated each.
    """
    yes = votes / raters
    each = (votes * (votes - 1) + (raters - votes) * (raters - votes - 1)) / (raters * (raters - 1))
    by_chance = yes.mean() ** 2 + (1 - yes.mean()) ** 2
    return float((each.mean() - by_chance) / (1 - by_chance))


def margin_m(row: Mapping[str, str]) -> float:
    """What a limit is compared with: by how much the wanted part is nearer to the palm than the rest; or the head's gap."""
    if row["kind"] == "head":
        return float(row["head_m"])
    others = [float(row[k]) for k in ("gripper_m", "sharp_m") if row[k]]
    return min(others) - float(row["wanted_m"])


def passes(kind: str, row: Mapping[str, str], limit_cm: float) -> bool:
    """Whether a picture passes at a limit: at most t behind, or at least the clearance away."""
    return margin_m(row) >= (limit_cm if kind == "head" else -limit_cm) / 100


def measured(_: argparse.Namespace, report: Report) -> None:
    """Agreement of raters, and of their majority with each limit."""
    for kind, rows in ratings().items():
        votes = np.array([sum(takes(r)) for r in rows])
        report.add(f"rating.{kind}.pictures", len(rows))
        report.add(f"rating.{kind}.taken", int((votes >= 2).sum()))
        report.add(f"rating.{kind}.fleiss_kappa", fleiss_kappa(votes, 3))
        for a, b in combinations(range(3), 2):
            same = np.mean([takes(r)[a] == takes(r)[b] for r in rows])
            report.add(f"rating.{kind}.raters_{a + 1}_{b + 1}_agree", float(same))
        for limit in LIMITS_CM[kind]:
            ok = np.array([passes(kind, r, limit) for r in rows])
            figure = f"rating.{kind}.limit_{str(limit).replace('.', '_')}"
            for name, cell in (
                ("right", ok == (votes >= 2)),
                ("refused_but_taken", ~ok & (votes >= 2)),
                ("passed_but_not_taken", ok & (votes < 2)),
            ):
                report.add(f"{figure}.{name}", int(cell.sum()))


BENCH = Bench(__doc__, measured, ("bench/rating.py", "bench/ratings.csv"))


def shown(data: Mapping[str, Any]) -> dict[str, str]:
    """How far raters agree, and for each kind of picture a line for some limits."""
    values, lines, agreed = data["values"], [], []
    for kind, limits in SHOWN_CM.items():
        own = f"rating.{kind}"
        n = values[f"{own}.pictures"]
        pairs = [100 * values[f"{own}.raters_{a}_{b}_agree"] for a, b in combinations((1, 2, 3), 2)]
        agreed.append(
            [
                kind,
                n,
                values[f"{own}.taken"],
                f"{min(pairs):.0f} to {max(pairs):.0f} %",
                f"{values[f'{own}.fleiss_kappa']:.2f}",
            ]
        )
        for limit in limits:
            figure = f"{own}.limit_{str(limit).replace('.', '_')}"
            right, refused, passed = (
                values[f"{figure}.{k}"] for k in ("right", "refused_but_taken", "passed_but_not_taken")
            )
            lines.append([kind, f"{limit:g} cm", f"{right} of {n}", refused, passed])
    return {
        "agreement": markdown_table(
            ["pictures", "number", "taken by most", "two raters agree", "Fleiss' kappa"], agreed
        ),
        "limits": markdown_table(
            ["pictures", "limit", "agrees with most", "refused, but taken", "passed, but not taken"], lines
        ),
    }


if __name__ == "__main__":
    BENCH.main()
