"""Content of every picture of one trial: bodies, their motion, marks and a camera.

`Drawing` is the one description of a trial. `view/pictures.py` draws it with MuJoCo into images
and films; `view/page.py` draws it with viser into a browser.
"""

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.runs.explain import LEAST, body_name, presented_words
from r2h_batch.scene.model_parts import VISUAL
from r2h_batch.view.mjcf import MARK, checked_pairs, spec_of, trajectory
from r2h_batch.view.postures import Nearest
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]
Color = tuple[float, float, float, float]

HEAD = "receiver/head"
"""The head's geom, as large as robot and object keep off it."""
AWAY = ("start_in_collision", "no_path_in_budget")
"""Reasons of Plan with which nothing is met at the target; it is also drawn where it is out of reach."""
HULL, HULL_CLEAR = "object/hull", 0.35
"""What planning takes for the object, and its opacity where it decides: the object is seen in it."""
MARKS = ("target", "region", "ball", "palm", "width", "witness")
"""Groups of marks that a viewer can show or hide."""
RED: Color = (0.86, 0.10, 0.10, 0.85)
LINE_M = 0.004  # radius of a line
WIDE_M = 0.009  # radius of the line to a target that is not reached: it begins within the gripper
SPOT_M = 0.03  # radius of the red ball where the table is met
TIP_M = 0.006  # where the gripper meets it: a larger one would hide the finger
YELLOW: Color = (0.95, 0.80, 0.10, 0.6)
REGION = "object/region_visual"
FIXED = ("world", "table", "hand", "target", "target_gripper", "receiver")
"""Bodies that stand still while the arm moves."""
UNSEEN = ("world", "table", "receiver", "target", "target_gripper")
"""Bodies that the camera need not have in view; the target counts where nothing moves."""

ROBOT, TORSO_ROOM = np.array([0.0, 0.0, 0.5]), 0.3
"""A point of the robot that a picture shows, and by how much the torso's box counts as larger."""
FOV_DEG = 45.0  # vertical, of every camera
ELEVATION_DEG = -14.0
BOUNDS_POSTURES = 60  # of a motion that the camera's bounds are made of
AZIMUTHS_DEG = np.arange(0, 360, 5)  # directions in which the first camera may look
ELEVATIONS_DEG = (ELEVATION_DEG, -35.0)  # the second where it shows more
STEEP = 1.0  # what the second is worse by
DIRECTIONS_DEG = np.array([(a, e) for e in ELEVATIONS_DEG for a in AZIMUTHS_DEG])
CLEAR_COUNTS = (
    10.0  # what it counts that gripper and object are seen, beside the other reasons for a camera
)
LAST_S = (1.0, 0.0)  # before the end, when they must be seen
POINTS, FAR_M = 5, 2.0  # of each of their surfaces; where rays to them begin
BACK = 0.5  # cosine: from within 60 degrees of the receiver's back nothing is looked at
MET_POSTURES = 200  # of a motion that collides, in which the deepest is looked for
CLOSE_M = 0.15  # around what a failure is seen by, in near views
AROUND_M, MOST_BEFORE = (
    0.012,
    24,
)  # rays past the event, and bodies that may be made clear before it
SEEN_M = 0.04  # an event is seen where nothing but what takes part stands this far before it
LIFT_M = 8e-4  # the region is drawn this far outside of the object's surface: neither shows through the other
NEAR_M = 0.5  # farther pairs of bodies are not called near
COARSE_M = 0.002  # grid on which vertices of large robot meshes are joined
COARSE_FACES = 4000  # larger meshes of the robot are coarsened


@dataclass(frozen=True)
class Surface:
    """Triangles of a geom in the frame of its body: vertices (V, 3) m, faces (F, 3), colour."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    rgba: Color


@dataclass(frozen=True)
class Mark:
    """Something drawn to explain the verdict: a surface, a ball (one point), a line or an arrow
    (two points), with or without words beside it."""

    group: str  # one of MARKS
    rgba: Color
    body: str = "world"  # the body in whose frame the mark stands, and with which it moves
    geom: int = -1  # the model's geom that is a surface of this mark; -1: none
    points: Array | None = None  # (1, 3) or (2, 3) m in the body's frame
    radius_m: float = LINE_M
    arrow: bool = False
    text: str = ""


@dataclass(frozen=True)
class View:
    """A camera: the point it looks at (world, m), its direction and its distance from there."""

    look_at: Array
    azimuth_deg: float
    elevation_deg: float
    distance_m: float

    @property
    def axes(self) -> Array:
        """Right, up and forward (3, 3) of the picture, in the world."""
        return _axes(self.azimuth_deg, self.elevation_deg)


@dataclass(frozen=True)
class Witness:
    """Marks that explain the failure.

    Two bodies that overlap or are nearest to each other. Of kind `unreachable` it is the line from
    the gripper to a target that it does not reach, of kind `reach` the gap from object to ball, of kind `presented` the gap from
    the wanted part to the ball, or the line from what comes to the palm before it.
    """

    geoms: tuple[str, ...]  # names of the two collision geoms; none of a line alone
    kind: str  # of pair, as `CollidingPair` names it, `unreachable`, `reach`, `presented` or `affordance`
    distance_m: float  # negative: they overlap by that, or the target is that far away
    line: Array  # (2, 3) the nearest points, world, m
    least_m: float | None = None  # the stored margin, where it is about these two bodies
    words: str = ""  # the caption; empty: it follows from the rest
    estimated: bool = (
        False  # the margin is to the hand as the planner sees it, the picture shows the true one
    )
    head_m: float = 0.0  # what robot and object keep from the head

    @property
    def caption(self) -> str:
        """The witness in one line: two bodies that overlap or their distance, or the remaining distance to a target."""
        if self.words:
            return self.words
        if self.kind == "unreachable":
            return f"the gripper stays {-1e3 * self.distance_m:.1f} mm from its target"
        if self.kind == "reach":
            return f"{1e3 * self.distance_m:.1f} mm from the object to the ball"
        if self.kind == "affordance":
            return f"{_geom_name(self.geoms[0])} on the receiver's part"
        a, b = map(_geom_name, self.geoms)
        if HEAD in self.geoms and self.head_m and self.distance_m < 0:
            known = self.least_m is not None and self.least_m < 0
            by = f"{-1e3 * (self.least_m if known else self.distance_m):.1f} mm{' or more' if known else ''}"  # type: ignore[operator]
            return f"{b if self.geoms[0] == HEAD else a} is within {100 * self.head_m:g} cm of the head, by {by}"
        if (
            self.least_m is not None and self.least_m < 0
        ):  # the margin is a lower bound of an overlap
            deep_mm = -1e3 * self.least_m
            met = f"overlap by {deep_mm:.1f} mm or more" if deep_mm >= LEAST else "touch"
            return f"{a} and {b} {met}{' for the planner, which sees the hand with an error' * self.estimated}"
        if self.distance_m < 0:
            return f"{a} and {b} overlap"
        return f"{a} and {b} are {1e3 * self.distance_m:.1f} mm apart"


class Drawing:
    """One trial as something to draw: its compiled model, its motion and its marks."""

    ended: tuple[str, bool] | None = None
    """what came of a motion of its own, and whether that is a success; None: the stored verdict"""

    def __init__(self, stored: StoredTrial) -> None:
        self.stored = stored
        self.model = spec_of(stored).compile()
        self._data = mujoco.MjData(self.model)
        region = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, REGION)  # -1: S0
        self.reshaped: set[int] = (
            set()
        )  # meshes that `at` has changed: a renderer must load them anew
        if region >= 0:
            self._lift(int(self.model.geom_dataid[region]))
        for mark in self.marks:
            if mark.geom >= 0 and mark.group == "witness":  # MuJoCo draws marks by their group
                self.model.geom_rgba[mark.geom], self.model.geom_group[mark.geom] = mark.rgba, MARK

    @cached_property
    def legs(self) -> "tuple[Drawing, ...]":
        """The legs before the motion, in order."""
        return tuple(Drawing(leg) for leg in self.stored.before)

    def _lift(self, mesh: int) -> None:
        """Grows a mesh by LIFT_M."""
        model = self.model
        v, f = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
        vertices = model.mesh_vert[v : v + model.mesh_vertnum[mesh]]
        faces = model.mesh_face[f : f + model.mesh_facenum[mesh]]
        vertices += LIFT_M * trimesh.Trimesh(vertices, faces, process=False).vertex_normals

    def at(self, q: Array) -> mujoco.MjData:
        """The bodies with the arm at posture q (joints,) rad; the next call overwrites them."""
        self._data.qpos[:] = q
        mujoco.mj_forward(self.model, self._data)
        return self._data

    def motion(self, executed: bool = True) -> tuple[Array, Array]:
        """Times (N,) s and postures (N, joints) rad.

        The executed motion where it was simulated, else (or where `executed` is false) the planned
        one. A trial without a path has one posture: the one that its target asks for.
        """
        stored = self.stored
        if not stored.moves:
            return np.zeros(1), stored.target_q[None]
        if executed and stored.executed_q is not None:
            sample_s = float(stored.header["motion"]["sample_s"])
            return np.arange(len(stored.executed_q)) * np.float64(sample_s), stored.executed_q
        return trajectory(stored)

    def groups(self, *, fails: bool) -> tuple[str, ...]:
        """Marks of one moment of a motion: the receiver's part and the ball; where it fails what speaks against it,
        without a ball that would cover it."""
        if not fails:
            return ("region", "ball")
        row = self.stored.row
        reach = row["outcome"] == "reach" or (
            row["outcome"] == "presented" and row.get("presented_by") == "ball"
        )
        return ("region", "ball", "witness") if reach else ("region", "witness")

    @property
    def away(self) -> bool:
        """Whether a trial without a motion is drawn with the arm elsewhere than at its target."""
        stored = self.stored
        return not stored.moves and (stored.unreachable or stored.row.get("plan_reason") in AWAY)

    @property
    def last(self) -> Array:
        """The posture at rest; without a motion the one at the target."""
        return self.motion()[1][-1]

    def moments(self, n: int) -> list[tuple[float, Array, bool]]:
        """`n` even times (s) from the start to rest, their postures (joints,), and whether the failure
        is seen then.

        Reach and Affordance fail at the end. Where Safe fails, the nearest of the times is moved to
        the touch.
        """
        row, (times, q) = self.stored.row, self.motion()
        at = np.linspace(0.0, min(row.get("t_exec_s") or times[-1], times[-1]), n)
        if (seen := self.fails_at_s) is not None:
            seen = at[np.abs(at - seen).argmin()] = min(seen, float(times[-1]))
        return [(float(t), q[np.abs(times - t).argmin()], bool(t == seen)) for t in at]

    @cached_property
    def fails_at_s(self) -> float | None:
        """When the motion is seen to fail, s: where Safe fails at the touch, where a motion collides at its
        deepest overlap, else at rest; None: a success."""
        row = self.stored.row
        if row["outcome"] == "safe" and row.get("witness_time_s") is not None:
            return float(row["witness_time_s"])
        if self._met is not None:
            return self._met[0]
        if self.witness is None and row["outcome"] not in ("stability", "pick", "plan"):
            return None
        times = self.motion()[0]
        return float(min(row.get("t_exec_s") or times[-1], times[-1]))

    @cached_property
    def _met(self) -> tuple[float, Witness] | None:
        """Where a motion that collides is deepest in what it meets: its time, and the two bodies."""
        stored = self.stored
        named = {"plan": ("nearest_pair", "witness_plan_part"), "pick": ("pick_pair", "pick_part")}
        columns = named.get(stored.row["outcome"])
        if not stored.moves or columns is None:
            return None
        kind, part = (stored.row.get(k) for k in columns)
        if not kind:
            return None
        pairs = self._pairs(kind, part or "")
        times, q = self.motion()
        some = np.linspace(0, len(q) - 1, min(len(q), MET_POSTURES)).round().astype(int)
        found = [
            (float(times[i]), w) for i in some if (w := self._nearest(q[i], pairs)) is not None
        ]
        return min(found, key=lambda f: f[1].distance_m, default=None)

    @cached_property
    def witness(self) -> Witness | None:
        """The two bodies that make the posture at the target fail; None where only the way touches
        something, or where Stability fails first: the pads show that (`marks`)."""
        stored = self.stored
        if stored.row["outcome"] == "stability":
            return None
        reason, failed = stored.row.get("plan_reason"), stored.row["outcome"]
        deciding = "pick" if failed == "pick" else "plan"
        if stored.moves and stored.row["outcome"] == "affordance":
            # the part of the gripper that is nearest to the receiver's part, or deepest in its hull
            region = int(self.model.geom(REGION).id)
            pairs = [(g, region, "affordance") for g in self._collision_geoms()["gripper"]]
            return self._nearest(stored.target_q, pairs)
        if stored.moves:
            if self._met is not None:
                return self._met[1]
            if failed == "presented":
                return self._comes_first()
            if failed == "reach":
                return self._gap("reach", self._triangles("object/mesh_visual"))
            return None
        if stored.unreachable:
            data = self.at(stored.target_q)
            line = np.stack([data.site("ee").xpos, data.site("target").xpos])
            away = self._stored_m(deciding) or -float(np.linalg.norm(line[1] - line[0]))
            return Witness((), "unreachable", away, line)
        home = reason == "start_in_collision"
        q = np.array(stored.workplace.home_q) if home else stored.target_q
        asked = None if stored.asked is None else stored.asked.nearest
        found = None if asked is None else self._nearest(q, self._pairs_of(asked))
        if found is None:
            return None if failed == "pick" else self._nearest(q, self._checked())
        sees = stored.header["configuration"]["plan"]["hand"] == "estimated"
        estimated = sees and asked is not None and asked.kind in ("hand", "object_hand")
        return replace(found, least_m=self._stored_m(deciding), estimated=estimated)

    def _pairs_of(self, asked: Nearest) -> list[tuple[int, int, str]]:
        """The checked pairs of geoms between two bodies that planning names."""
        if not asked.other:
            return self._pairs(asked.kind, asked.part)
        sides = ((asked.part, asked.other), (asked.other, asked.part))
        return [
            (g, h, kind)
            for g, h, kind in self._checked()
            if kind == asked.kind and any(self._is_of(g, a) and self._is_of(h, b) for a, b in sides)
        ]

    def _pairs(self, kind: str, part: str) -> list[tuple[int, int, str]]:
        """The checked pairs of geoms of a kind, one of them a named body; an empty name: any."""
        return [
            (a, b, k)
            for a, b, k in self._checked()
            if k == kind and (not part or self._is_of(a, part) or self._is_of(b, part))
        ]

    def _is_of(self, geom: int, body: str) -> bool:
        """Whether a geom is a body that planning names: a part of the robot, `object`, `table`, a piece of hand or
        person."""
        owner, _, part = str(self.model.geom(geom).name).partition("/")
        return body == owner if owner in ("object", "table") else body == part

    @cached_property
    def event(self) -> tuple[Array, Array, frozenset[str]]:
        """Where the verdict is decided: the posture (joints,) rad, the point (3,) m in the world, and the
        bodies that take part."""
        stored, witness = self.stored, self.witness
        row, q = stored.row, stored.target_q
        if stored.moves and self.fails_at_s is not None:
            times, motion = self.motion()
            q = motion[np.abs(times - self.fails_at_s).argmin()]
        if row["outcome"] == "safe" and row.get("witness_point_m"):
            return q, np.array(row["witness_point_m"], np.float64), frozenset({"hand", "gripper"})
        if row.get("plan_reason") == "start_in_collision":
            q = np.array(stored.workplace.home_q)
        if witness is None:
            return q, self.at(q).site("ee").xpos.copy(), frozenset({"gripper", "object"})
        bodies = (self.body_of(int(self.model.geom(name).id)) for name in witness.geoms)
        return q, witness.line.mean(0), frozenset(bodies)

    def _stored_m(self, name: str) -> float | None:
        """The stored margin of a criterion; None where it is no length."""
        margin = self.stored.row.get(f"margin_{name}_m")
        return float(margin) if margin is not None and np.isfinite(margin) else None

    def _checked(self) -> list[tuple[int, int, str]]:
        """Pairs of geoms that planning checks, and the kind of each; the person's body is checked as the hand is."""
        of_body = self._collision_geoms()
        person = of_body.get("hand", [])
        if self.stored.header["configuration"].get("receiver") == "body":
            person = [*person, *of_body.get("receiver", [])]
        of_body["hand"] = person
        return [
            (a, b, kind)
            for both, kind in checked_pairs(self.stored.robot).items()
            for a, b in product(*(of_body.get(name, []) for name in sorted(both)))
        ]

    def _collision_geoms(self) -> dict[str, list[int]]:
        """Body -> its geoms that can collide."""
        model, found = self.model, dict[str, list[int]]()
        for g in np.flatnonzero((model.geom_contype != 0) & (model.geom_conaffinity != 0)):
            found.setdefault(self.body_of(int(g)), []).append(int(g))
        return found

    def _nearest(self, q: Array, pairs: Iterable[tuple[int, int, str]]) -> Witness | None:
        """The nearest of these pairs of geoms (with its kind) at posture q; None where all are
        farther apart than NEAR_M."""
        model, data = self.model, self.at(q)
        best, least = None, NEAR_M
        for a, b, kind in pairs:
            apart = float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]))
            if apart - model.geom_rbound[a] - model.geom_rbound[b] > least:
                continue
            line = np.zeros(6)
            distance = mujoco.mj_geomDistance(model, data, a, b, NEAR_M, line)
            if distance < least:
                names, least = (model.geom(a).name, model.geom(b).name), float(distance)
                head_m = self.stored.head_clearance_m
                best = Witness(names, kind, least, line.reshape(2, 3), head_m=head_m)
        return best

    def _gap(self, criterion: str, triangles: Array) -> Witness:
        """From the nearest point of some of the object's triangles to the ball that it should meet."""
        data = self.at(self.stored.target_q)
        center, radius = data.site("ball").xpos.copy(), float(self.model.site("ball").size[0])
        point, distance = _nearest_point(triangles, center)
        end = center + radius / distance * (point - center)
        margin = self._stored_m(criterion)
        away = distance - radius if margin is None else -margin
        words = presented_words(self.stored.row) if criterion == "presented" else ""
        return Witness((), criterion, away, np.stack([point, end]), words=words)

    def _comes_first(self) -> Witness:
        """What Presented fails by: the part of the gripper or of the object that is nearest to the palm, or the gap to the
        ball."""
        stored, words, own = self.stored, presented_words(self.stored.row), self.stored.object_model
        T = stored.T_world_ee @ np.linalg.inv(stored.T_obj_ee_attached)
        triangles = own.vertices.astype(np.float64)[own.faces] @ T[:3, :3].T + T[:3, 3]
        if stored.row.get("presented_by") not in ("gripper", "sharp"):
            region = own.receiver_face
            return self._gap("presented", triangles[region] if region.any() else triangles)
        palm = self.at(stored.target_q).site("palm").xpos.copy()
        away = self._stored_m("presented") or 0.0
        if stored.row["presented_by"] == "sharp":
            point, _ = _nearest_point(triangles[own.sharp_face], palm)
            return Witness((), "presented", away, np.stack([point, palm]), words=words)
        names = [self.model.geom(g).name for g in self._collision_geoms()["gripper"]]
        found = {name: _nearest_point(self._triangles(name), palm) for name in names}
        first = min(found, key=lambda name: found[name][1])
        line = np.stack([found[first][0], palm])
        return Witness((first,), "presented", away, line, words=words)

    def _triangles(self, geom: str) -> Array:
        """The triangles (T, 3, 3) of a geom with the arm at the target, in the world."""
        g = int(self.model.geom(geom).id)
        body, made = self.at(self.stored.target_q).body(self.body_of(g)), self.surface(g)
        corners = made.vertices @ body.xmat.reshape(3, 3).T + body.xpos
        triangles: Array = corners[made.faces]
        return triangles

    def surface(self, geom: int) -> Surface:
        """A geom of the model in the frame of its body."""
        model = self.model
        kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            k = int(model.geom_dataid[geom])
            v, f, name = int(model.mesh_vertadr[k]), int(model.mesh_faceadr[k]), model.mesh(k).name
            vertices = model.mesh_vert[v : v + model.mesh_vertnum[k]]
            faces = model.mesh_face[f : f + model.mesh_facenum[k]]
            if name.startswith("robot_") and len(faces) > COARSE_FACES:
                vertices, faces = _coarse_robot(vertices.tobytes(), faces.tobytes())
        else:
            made = _primitive(kind, tuple(map(float, size)))
            vertices, faces = made.vertices, made.faces
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        moved = np.asarray(vertices) @ turn.reshape(3, 3).T + model.geom_pos[geom]
        rgba = _color(model.geom_rgba[geom])
        return Surface(moved.astype(np.float32), np.asarray(faces, np.uint32), rgba)

    def visual_geoms(self, bodies: Collection[str] | None = None) -> list[int]:
        """Geoms that are seen, of these bodies or of all but the world."""
        model, found = self.model, []
        for g in range(model.ngeom):
            body = int(model.geom_bodyid[g])
            seen = model.geom_group[g] == VISUAL and body > 0
            if seen and (bodies is None or model.body(body).name in bodies):
                found.append(g)
        return found

    def seen_of(self, geom: int) -> int:
        """The geom that is seen in the place of a robot's collision body (wrist_3_0: wrist_3_visual); -1: none."""
        name = re.sub(r"_\d+$", "", str(self.model.geom(geom).name)) + "_visual"
        return int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, name))

    def body_of(self, geom: int) -> str:
        """The name of the body that carries a geom."""
        return str(self.model.body(int(self.model.geom_bodyid[geom])).name)

    def up_in(self, body: str) -> Array:
        """The world's z in the frame of a body, with the arm at the target."""
        up: Array = self.at(self.stored.target_q).body(body).xmat.reshape(3, 3)[2].copy()
        return up

    @cached_property
    def marks(self) -> tuple[Mark, ...]:
        """All marks of the trial.

        The ghost at the target, the part that the receiver wants, the ball and the palm's normal,
        the material between the pads, and in red what the first failure is seen by: where Stability
        fails, pads and width. Only one red mark has words: so no two labels overlap.
        """
        model, row, witness = self.model, self.stored.row, self.witness
        found: list[Mark] = []

        def surface(group: str, geom: str, rgba: Color | None = None) -> None:
            g = int(model.geom(geom).id)
            found.append(Mark(group, rgba or _color(model.geom_rgba[g]), self.body_of(g), g))

        for g in range(model.ngeom):
            name = model.geom(g).name
            if name.startswith("target/"):
                surface("target", name)
            elif name == REGION:  # where fingers are on it, they are red and it keeps its colour
                surface("region", name)
        green = _color(model.site("ball").rgba)[:3]
        ball, palm = (
            model.site("ball"),
            model.site("palm"),
        )  # in the hand's frame: they move with it
        found.append(
            Mark(
                "ball",
                (*green, 0.18),
                "hand",
                points=ball.pos[None].copy(),
                radius_m=float(ball.size[0]),
            )
        )
        facing = np.zeros(9)
        mujoco.mju_quat2Mat(facing, palm.quat)
        line = np.stack([palm.pos, palm.pos + 0.08 * facing.reshape(3, 3)[:, 2]])
        found.append(Mark("palm", (*green, 1.0), "hand", points=line, radius_m=0.003, arrow=True))
        pads = [f"gripper/{side}_pad" for side in ("left", "right")]
        fails = row["outcome"] == "stability"
        group, color = ("witness", RED) if fails else ("width", YELLOW)
        for pad in pads:
            surface(group, pad, color)
        if row.get("width_m") is not None:
            width = row["width_m"]
            a, b = (model.geom(pad).pos for pad in pads)
            half = width / 2 * (b - a) / np.linalg.norm(b - a)
            line = np.stack([(a + b) / 2 - half, (a + b) / 2 + half])
            text = f"{1e3 * width:.1f} mm" if fails else ""
            body = self.body_of(int(model.geom(pads[0]).id))
            found.append(Mark(group, color, body, points=line, radius_m=0.0015, text=text))
        if witness is not None:
            for name, point in zip(witness.geoms, witness.line, strict=False):
                if name == REGION:
                    continue
                if name.startswith(("table", "receiver/torso")):  # where it is met, not all of it
                    by_gripper = any(other.startswith("gripper/") for other in witness.geoms)
                    spot_m = TIP_M if by_gripper else SPOT_M
                    found.append(Mark("witness", RED, points=point[None], radius_m=spot_m))
                elif name == HULL:  # the object stays as it is within
                    surface("witness", name, (*RED[:3], HULL_CLEAR))
                else:
                    surface("witness", name, RED)
            if witness.kind == "presented" and row.get("presented_by") == "sharp":
                found.append(Mark("witness", RED, points=witness.line[:1], radius_m=0.015))
            radius_m = WIDE_M if witness.kind == "unreachable" else LINE_M
            found.append(
                Mark("witness", RED, points=witness.line, radius_m=radius_m, text=witness.caption)
            )
        elif row["outcome"] == "safe" and row.get("witness_point_m"):
            point = np.array(row["witness_point_m"], np.float64)[None]
            part = str(row.get("witness_safe_part"))
            text = f"{body_name(part)} meets the hand at {row['witness_time_s']:.1f} s"
            for name in (f"robot/{part}", f"gripper/{part}"):
                if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) >= 0:
                    surface("witness", name, RED)
            found.append(Mark("witness", RED, points=point, radius_m=0.015, text=text))
        elif row["outcome"] in (
            "pick",
            "plan",
        ):  # nothing is met: the arm does not come to rest there
            found.append(Mark("witness", RED, points=self.event[1][None], radius_m=0.015))
        return tuple(found)

    def bounds(self, close: bool = False) -> Array:
        """Corners (N, 3) of boxes around robot, object and hand over the whole motion; `close`:
        around gripper, object and hand where a success ends, around what a failure is seen by."""
        model = self.model
        corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
        if close and self.stored.row["outcome"] != "success":
            line = [] if self.witness is None else list(self.witness.line)
            return np.concatenate([point + CLOSE_M * corners for point in (self.event[1], *line)])
        near = ("object", "hand", "gripper")
        names = [model.body(i).name for i in range(model.nbody)]
        geoms = self.visual_geoms(near if close else [n for n in names if n not in UNSEEN])
        if not self.stored.moves:
            geoms += [m.geom for m in self.marks if m.group == "target"]
        _, q = self.motion()
        some = np.linspace(0, len(q) - 1, min(len(q), BOUNDS_POSTURES)).round().astype(int)
        home = self.stored.start
        local = model.geom_aabb[geoms, None, :3] + corners * model.geom_aabb[geoms, None, 3:]
        points = []
        for posture in [self.event[0]] if close else [home, *q[some]]:
            data = self.at(posture)
            turn = data.geom_xmat[geoms].reshape(-1, 3, 3)
            world = local @ turn.swapaxes(1, 2) + data.geom_xpos[geoms, None]
            points.append(world.reshape(-1, 3))
        legs = () if close else (leg.bounds() for leg in self.legs)
        return np.concatenate([*points, *legs, *([] if close else [self._upper_body()])])

    def _upper_body(self) -> Array:
        """Points (N, 3) of the receiver above the table's top, as the trial begins, world, m; none without a body."""
        if self.stored.receiver is None:
            return np.zeros((0, 3))
        geoms = [int(self.model.geom(f"receiver/{name}_visual").id) for name in ("clothes", "skin")]
        data, model, found = self.at(self.stored.target_q), self.model, []
        for g in geoms:
            v = int(model.mesh_vertadr[model.geom_dataid[g]])
            vertices = model.mesh_vert[v : v + model.mesh_vertnum[model.geom_dataid[g]] : 7]
            found.append(vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
        world = np.concatenate(found)
        return world[world[:, 2] > 0.0]

    @cached_property
    def sides(self) -> Array:
        """How well the trial is seen from each of `DIRECTIONS_DEG` (azimuth, elevation in degrees).

        The camera never stands behind the receiver. Then the event must be seen, then as much as possible of gripper and
        object in the last second; the camera stands on the receiver's side, the torso hides neither hand nor object nor
        robot, and hand and gripper stand beside each other.
        """
        data = self.at(self.last)
        hand, target = (
            data.geom("hand/mesh_visual").xpos.copy(),
            data.site("ee" if self.stored.moves else "target").xpos.copy(),
        )
        apart = (hand - target)[:2]
        flat = apart / max(float(np.linalg.norm(apart)), 1e-6)
        angles = np.radians(AZIMUTHS_DEG)
        side = np.abs(np.cos(angles) * flat[1] - np.sin(angles) * flat[0])
        hidden = [self._hidden(np.stack([hand, target, ROBOT]), float(a)) for a in AZIMUTHS_DEG]
        behind = np.cos(angles) > 1e-9
        best = side - 0.35 * np.cos(angles - np.pi) ** 2 - np.array(hidden)
        facing = -flat if self.stored.receiver is None else self.stored.receiver[3:5, 3]
        towards = np.cos(angles) * facing[0] + np.sin(angles) * facing[1]
        best = np.where(
            towards > BACK, -np.inf, best
        )  # it looks where the receiver looks, from behind
        best = best - 8.0 * behind
        found = []
        for elevation in ELEVATIONS_DEG:
            seen = self._seen(elevation)
            around = sum(np.roll(seen, k) for k in (-2, -1, 0, 1, 2)) / 5
            # what does not move is looked at from one height: what fails there is not in the hand
            steep = (STEEP if self.stored.moves else np.inf) if elevation != ELEVATION_DEG else 0.0
            clear = self._clear(elevation, np.isfinite(best) & ~behind)
            found.append(best + 16.0 * seen + around + CLEAR_COUNTS * clear - steep)
        return np.concatenate(found)

    def _clear(self, elevation_deg: float, asked: NDArray[np.bool_]) -> Array:
        """The share of gripper and object that is seen in the last second from each of `AZIMUTHS_DEG`, 0 where not `asked`: a
        ray from there to a point of them meets nothing else before. 0 without a motion."""
        found = np.zeros(len(AZIMUTHS_DEG))
        if not self.stored.moves:
            return found
        times, q = self.motion()
        postures = [q[np.abs(times - max(times[-1] - ago, 0.0)).argmin()] for ago in LAST_S]
        model, shown = self.model, np.array([0, 0, 0, 0, 0, 0], np.uint8)
        shown[VISUAL] = 1
        geoms = self.visual_geoms(("gripper", "object"))
        every = np.concatenate(
            [np.stack([np.full(POINTS, g), np.arange(POINTS)], 1) for g in geoms]
        )
        geom, some = np.zeros(1, np.int32), self.corners(geoms)
        for posture in postures:
            data = self.at(posture)
            turn = data.geom_xmat[every[:, 0]].reshape(-1, 3, 3)
            points = np.einsum("nij,nj->ni", turn, some) + data.geom_xpos[every[:, 0]]
            for k in np.flatnonzero(asked):
                forward = _axes(float(AZIMUTHS_DEG[k]), elevation_deg)[2]
                for point in points:
                    start = point - FAR_M * forward
                    far = mujoco.mj_ray(model, data, start, forward, shown, 1, -1, geom)
                    free = far < 0 or far > FAR_M - SEEN_M
                    found[k] += free or self.body_of(int(geom[0])) in ("gripper", "object")
        return found / (len(some) * len(postures))

    def corners(self, geoms: Sequence[int]) -> Array:
        """`POINTS` points of each geom's surface (N, 3), in its frame, m."""
        model, found = self.model, []
        for g in geoms:
            if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                k = int(model.geom_dataid[g])
                v, n = int(model.mesh_vertadr[k]), int(model.mesh_vertnum[k])
                found.append(model.mesh_vert[v + np.linspace(0, n - 1, POINTS).astype(int)])
            else:
                middle, half = model.geom_aabb[g, :3], model.geom_aabb[g, 3:]
                ways = np.linspace(-1, 1, POINTS)[:, None] * half
                found.append(middle + ways)
        return np.concatenate(found)

    def before(self, view: View) -> frozenset[int]:
        """Geoms that stand between a camera and the point where the verdict is decided."""
        q, point, _ = self.event
        model, data, shown = self.model, self.at(q), np.array([0, 0, 0, 0, 0, 0], np.uint8)
        shown[VISUAL] = 1
        right, up, forward = view.axes
        camera, geom, found = (
            view.look_at - view.distance_m * forward,
            np.zeros(1, np.int32),
            set[int](),
        )
        for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            way = point + AROUND_M * (x * right + y * up) - camera
            left = float(np.linalg.norm(way))
            way, start = way / left, camera
            while left > 0 and len(found) < MOST_BEFORE:
                far = mujoco.mj_ray(model, data, start, way, shown, 1, -1, geom)
                if far < 0 or far > left:
                    break
                found.add(int(geom[0]))
                start, left = start + (far + 1e-4) * way, left - far - 1e-4
        return frozenset(found)

    def _seen(self, elevation_deg: float) -> Array:
        """1 for each of `AZIMUTHS_DEG` from which the event is seen, else 0: a ray from there meets
        nothing before it but what takes part."""
        q, point, bodies = self.event
        model, data, shown = self.model, self.at(q), np.array([0, 0, 0, 0, 0, 0], np.uint8)
        shown[VISUAL] = 1
        found, geom = np.zeros(len(AZIMUTHS_DEG)), np.zeros(1, np.int32)
        for k, azimuth in enumerate(AZIMUTHS_DEG):
            forward = _axes(float(azimuth), elevation_deg)[2]
            far = mujoco.mj_ray(model, data, point - 2.0 * forward, forward, shown, 1, -1, geom)
            free = far < 0 or far > 2.0 - SEEN_M
            found[k] = free or self.body_of(int(geom[0])) in bodies
        return found

    def _hidden(self, points: Array, azimuth_deg: float) -> int:
        """How many of the points (N, 3) the torso hides from a camera in that direction."""
        if self.stored.receiver is None:
            return 0
        receiver = np.asarray(self.stored.receiver, np.float64)
        middle, half, x, y = receiver[3, :3], receiver[4, :3], receiver[3, 3], receiver[4, 3]
        R_torso_world = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
        towards = -R_torso_world @ _axes(azimuth_deg, ELEVATION_DEG)[2]
        start = (points - middle) @ R_torso_world.T
        # from a point to the camera: the ray start + t towards, t > 0, meets the box where its three slabs share a piece
        ends = (np.stack([-half, half])[:, None] * (1 + TORSO_ROOM) - start) / (towards + 1e-12)
        first, last = ends.min(0).max(1), ends.max(0).min(1)
        return int(((last > first) & (last > 0)).sum())


def view_of(
    drawings: Sequence[Drawing], aspect: float, *, close: bool = False, apart_m: float = 0.0
) -> View:
    """The nearest camera that has all of these trials in the picture.

    Args:
        drawings: trials, as a rule the same one of several methods.
        aspect: width of the picture divided by its height.
        close: see `Drawing.bounds`.
        apart_m: how far the trials stand from each other along y.
    """
    best = np.sum([d.sides for d in drawings], 0)
    if apart_m and len(drawings) > 1:  # none stands before another
        best = np.where(np.abs(DIRECTIONS_DEG[:, 0] - 180) <= 30, best, -np.inf)
    azimuth, elevation = map(float, DIRECTIONS_DEG[best.argmax()])
    return framed(drawings, aspect, azimuth, elevation, close=close, apart_m=apart_m)


def framed(
    drawings: Sequence[Drawing], aspect: float, azimuth_deg: float, elevation_deg: float, *, close: bool = False,
    apart_m: float = 0.0,
) -> View:  # fmt: skip
    """The nearest camera of a direction that has all of these trials in the picture; arguments as of `view_of`."""
    points = np.concatenate([d.bounds(close) + [0, k * apart_m, 0] for k, d in enumerate(drawings)])
    axes, half = _axes(azimuth_deg, elevation_deg), np.tan(np.radians(FOV_DEG / 2))
    at = points @ axes.T
    middle = (at.min(0) + at.max(0)) / 2
    right, up, forward = (at - middle).T
    needed = np.maximum(np.abs(right) / (half * aspect), np.abs(up) / half) - forward
    return View(middle @ axes, azimuth_deg, elevation_deg, float(needed.max()))


def _axes(azimuth_deg: float, elevation_deg: float) -> Array:
    a, e = np.radians([azimuth_deg, elevation_deg])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return np.stack([right, np.cross(right, forward), forward])


def _primitive(kind: mujoco.mjtGeom, size: tuple[float, ...]) -> trimesh.Trimesh:
    """MuJoCo's sizes: half sides of a box, radius and half length along z."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * np.array(size))
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=32)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=[16, 16])
        made.apply_translation(-made.bounds.mean(0))  # versions differ in where its origin is
        return made
    raise ValueError(f"{kind.name} is not a shape of an exported trial")


@lru_cache(maxsize=16)
def _coarse_robot(vertices: bytes, faces: bytes) -> tuple[Array, NDArray[np.int64]]:
    v = np.frombuffer(vertices, np.float32).reshape(-1, 3).astype(np.float64)
    return coarse(v, np.frombuffer(faces, np.int32).reshape(-1, 3).astype(np.int64), COARSE_M)


def coarse(
    vertices: Array, faces: NDArray[np.int64], cell_m: float
) -> tuple[Array, NDArray[np.int64]]:
    """The surface with all vertices of a grid's cell joined to one of them: no point moves farther
    than the cell's diagonal."""
    mesh = trimesh.Trimesh(vertices / cell_m, faces, process=False)
    mesh.merge_vertices(digits_vertex=0)
    f = np.asarray(mesh.faces)
    kept = (f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 0] != f[:, 2])
    mesh.update_faces(kept)
    mesh.remove_unreferenced_vertices()
    return cell_m * np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _color(rgba: Sequence[float]) -> Color:
    r, g, b, a = map(float, rgba)
    return r, g, b, a


def _geom_name(geom: str) -> str:
    """robot/wrist_3_0: wrist 3; hand/index2: hand index 2; object/piece_1: object."""
    owner, _, part = geom.partition("/")
    if geom == HULL:
        return "the object's hull"
    if owner in ("object", "table"):
        return owner
    if owner == "robot":
        return body_name(part)
    if owner == "gripper":
        return f"gripper {body_name(part)}"
    return f"{owner} {re.sub(r'(?<=[a-z])(?=[0-9])', ' ', part).replace('_', ' ')}"


def _nearest_point(triangles: Array, x: Array) -> tuple[Array, float]:
    """The point (3,) of triangles (T, 3, 3) that is nearest to x, and its distance."""
    points = trimesh.triangles.closest_point(triangles, np.broadcast_to(x, (len(triangles), 3)))
    apart = np.linalg.norm(points - x, axis=1)
    return points[apart.argmin()], float(apart.min())
