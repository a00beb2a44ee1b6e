"""Surveys that Anny's adults follow: arms as long as in ANSUR II, and the height that people lose with age.

Bones are lengthened and the trunk is shortened with the skin on them; hands, legs and heads keep their shape. Anny itself
makes no difference between a person of 25 and one of 85 years, and gives women forearms 14 % shorter than ANSUR II's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r2h_batch.assets.people.bodies import ILIAC, Bodies, Model

F64 = NDArray[np.float64]

AGES = (25.0, 35.0, 45.0, 55.0, 65.0, 75.0, 85.0)
STATURE_CM = (
    (176.40, 176.62, 176.56, 176.10, 175.08, 172.72, 171.23),
    (162.90, 163.66, 162.87, 161.95, 161.11, 159.44, 155.68),
)
"""Mean statures of men and of women of 20 to 29, 30 to 39, ..., 70 to 79, and of 80 years and older.

NHANES 2009 to 2012 (NCHS), 11,250 people measured, weighted by WTMEC2YR; standard errors .27 to .44 cm. Computed from
`NHANESraw` of the R package NHANES 2.1.0 (CRAN). The survey gives no ages above 80, so 85 is a [choice].

All of the loss is the trunk's [choice]. Sorkin, Muller and Andres 1999 (Am J Epidemiol 150:969-77, abstract): the same
people lose about 5 cm (men) and 8 cm (women) from 30 to 80 years, which is the survey's whole difference."""

ARM = {"upper": (1.118, 1.125), "fore": (1.058, 1.141), "shoulders": (1.0, 1.032)}
"""Factors of men's and women's lengths. Upper arm and forearm of the median adult then have ANSUR II's share of the stature
(men .1909 and .1521, women .1913 and .1476). Shoulders: ANSUR II measures between the acromia, Anny between the joints,
which lie inwards; women's are brought to the share of ANSUR II's breadth that men's have (.915)."""
ADULT = 18.0
"""Years. Children keep Anny's arms: no table of theirs could be looked up."""

PARTS = {
    "girdle": ("clavicle", "shoulder01"),
    "upper": ("upperarm",),
    "fore": ("lowerarm",),
    "hand": ("wrist", "finger", "metacarpal"),
}
"""Part of an arm -> beginnings of its bones. All other bones follow the trunk."""


def height_kept(sex: NDArray[np.int8], age: F64) -> F64:
    """(n,) stature over that at 20 to 29 years, at most 1."""
    share = [np.interp(age, AGES, np.array(own) / own[0]) for own in STATURE_CM]
    return np.minimum(np.where(sex == 0, *share), 1.0)


def proportioned(model: Model, bodies: Bodies) -> Bodies:
    """The bodies with arms of ANSUR II's length and a trunk as short as their age makes it."""
    bones = np.arange(len(model.bones))
    return Bodies(
        bodies.sex,
        bodies.age,
        bodies.vertices + _moves(model, bodies, bodies.vertices, model.weights),
        bodies.heads + _moves(model, bodies, bodies.heads, np.eye(len(bones))),
    )


def _moves(model: Model, bodies: Bodies, points: F64, weights: F64) -> F64:
    """(n, m, 3) by which points (n, m, 3) of the bones' weights (m, bones) move."""
    z = bodies.vertices[:, :, 2]
    floor, stature = z.min(1), z.max(1) - z.min(1)
    shoulder = model.head(bodies, "upperarm01.R")
    crest = floor + ILIAC * (model.head(bodies, "upperleg01.R")[:, 2] - floor)
    loss = stature * (1.0 - height_kept(bodies.sex, bodies.age))
    share = np.clip((points[..., 2] - crest[:, None]) / (shoulder[:, 2] - crest)[:, None], 0.0, 1.0)
    moved = np.zeros_like(points)
    moved[..., 2] = -loss[:, None] * share
    down = np.array([0.0, 0.0, -1.0]) * loss[:, None]
    for side in (".R", ".L"):
        for part, move in _arm(model, bodies, points, side).items():
            own = [k for k, b in enumerate(model.bones) if b.endswith(side) and b.startswith(PARTS[part])]
            weight = weights[:, own].sum(1)[None, :, None]
            if part == "girdle":
                moved += weight * move
            else:
                moved += weight * (move + down[:, None] - np.stack([0 * share, 0 * share, -loss[:, None] * share], -1))
    return moved


def _arm(model: Model, bodies: Bodies, points: F64, side: str) -> dict[str, F64]:
    """Part of `PARTS` -> (n, m, 3) by which points would move if they were that part's, without the trunk's loss."""
    factor = {k: np.where(bodies.age < ADULT, 1.0, np.where(bodies.sex == 0, *own)) - 1.0 for k, own in ARM.items()}
    shoulder, elbow, wrist = (model.head(bodies, bone + side) for bone in ("upperarm01", "lowerarm01", "wrist"))
    wider = factor["shoulders"][:, None] * shoulder * np.array([1.0, 0.0, 0.0])
    inwards = np.clip(np.abs(points[..., 0]) / np.abs(shoulder[:, None, 0]), 0.0, 1.0)[..., None]
    longer = factor["upper"][:, None] * (elbow - shoulder), factor["fore"][:, None] * (wrist - elbow)

    def along(a: F64, b: F64) -> F64:
        way = b - a
        return np.clip(np.einsum("nmk,nk->nm", points - a[:, None], way) / (way * way).sum(1)[:, None], 0.0, 1.0)

    at_elbow = wider + longer[0]
    return {
        "girdle": inwards * wider[:, None],
        "upper": wider[:, None] + along(shoulder, elbow)[..., None] * longer[0][:, None],
        "fore": at_elbow[:, None] + along(elbow, wrist)[..., None] * longer[1][:, None],
        "hand": np.broadcast_to((at_elbow + longer[1])[:, None], points.shape),
    }
