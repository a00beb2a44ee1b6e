"""Receivers that move: where each hand is at each moment, and the arm that carries it.

A hand moves in strokes. A stroke shifts the wrist and turns the hand about it by minimum jerk (Flash
and Hogan 1985). A stroke that begins before another has ended adds to it (Henis and Flash 1995). So the
way of a point between two moments is known exactly from above, which is what certifies distances.
Times and lengths are [choice] (docs/closed_loop.md). Everything is drawn by trial: a row does not depend
on its batch.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import read_npz
from r2h_batch.closed_loop.arm_ranges import lower_arm_angles, within_ranges
from r2h_batch.scene.hand import palm_frame, rotation_from_axis_angle
from r2h_batch.scene.scene import Scene
from r2h_batch.scene.tables import MIDDLE_ROOT
from r2h_batch.trials.noise import normals
from r2h_batch.types import Trials

KINDS = ("still", "moves", "reaches", "hesitates", "withdraws", "takes", "replay")
"""still: stands at the trial's pose. moves: leaves it for another. reaches: moves to that other
pose from before the chest. hesitates: reaches, and pauses at `PAUSE_AT` of the way. withdraws:
moves, draws back from a near robot and returns. takes: moves, and goes to its easiest grasp
(`judge.reception`) once the object is held out. replay: an imported motion that ends at the trial's
pose."""

STROKES = {"still": 0, "moves": 1, "reaches": 1, "hesitates": 2, "withdraws": 3, "takes": 3}
"""How many a hand may make."""
WAITS_S, REACTS_S = (2.0, 6.0), (0.5, 2.0)
"""Before a hand leaves a pose where it was shown to the robot, and before one reaches at all."""
STROKE_S, PAUSE_S, PAUSE_AT = (0.8, 1.4), (0.2, 1.0), 0.6
BACK_M, BACK_S, AFRAID_M, AWAY_S = 0.20, 0.5, (0.03, 0.08), (0.5, 1.5)
TAKE_AFTER_S, TAKE_S, LAST_SHARE = (0.1, 0.4), (0.6, 1.0), 0.5
"""Before a hand sets out to take the object, to 10 cm before the grasp, and the share of this for the last 10 cm."""
REPLAYED_S = 4.0
"""Length of a replayed motion: the last seconds before the frame in which the hand receives."""
SHARES = (0.8, 0.6, 0.4, 0.2, 0.0)
"""Shares of the drawn shift and turn that are tried in turn while forearm or wrist is out of its range. 0: the trial's
pose, which is within them."""
STRETCHED = 0.98
"""Largest distance of a wrist from its shoulder, as a share of the arm's length."""
OVER_TABLE_M = 0.05
_PURPOSE_TIMES, _PURPOSE_PLACE = 1, 2
_KEY = rng.key_of("receivers that move")


@dataclass(frozen=True)
class ReceiverMotion:
    """How receivers move.

    Attributes:
        kind: one of `KINDS`.
        shift_m: standard deviation per axis of where the hand goes, m.
        turn_deg: root mean square of how far it turns.
        file: the imported motions, NAME_motion.npz beside NAME.npz; of `replay`.
        seed: of the draws.
    """

    kind: str = "moves"
    shift_m: float = 0.10
    turn_deg: float = 20.0
    file: str = ""
    seed: int = 0

    @property
    def path(self) -> Path:
        """Path of the file."""
        return Path(self.file)

    @staticmethod
    def parse(text: str, seed: int = 0) -> "ReceiverMotion":
        """`moves`, `moves:100mm,20deg` or `replay:NAME_motion.npz`; ValueError says what is allowed."""
        kind, _, rest = text.partition(":")
        size = re.fullmatch(r"(\d+\.?\d*)mm,(\d+\.?\d*)deg", rest, re.ASCII)
        fits = bool(rest) if kind == "replay" else not rest or size is not None
        if kind not in KINDS or not fits:
            raise ValueError(
                f"receiver motion is {text!r}; it must be {', '.join(KINDS[:-1])}, one of these with"
                " a size such as moves:100mm,20deg, or replay:NAME_motion.npz"
            )
        if kind == "replay":
            return ReceiverMotion(kind, file=rest, seed=seed)
        if size is None:
            return ReceiverMotion(kind, seed=seed)
        return ReceiverMotion(kind, float(size[1]) / 1000, float(size[2]), seed=seed)


def minimum_jerk(x: Float64[Tensor, "*n"]) -> Float64[Tensor, "*n"]:
    """Share of a stroke that is done after the share x of its time: 10 x^3 - 15 x^4 + 6 x^5."""
    x = x.clamp(0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


@dataclass
class Strokes:
    """Hands of B trials: where they begin, and M strokes each.

    Attributes:
        T_world_hand: at the beginning, m.
        wrist: in the hand's frame, m.
        radius: largest distance of a point of the hand from its wrist, m.
        begin: s; inf: never.
        duration: s.
        shift: of the wrist, world, m.
        turn: about the wrist, world, axis-angle, rad.
    """

    T_world_hand: Float64[Tensor, "b 4 4"]
    wrist: Float64[Tensor, "b 3"]
    radius: Float64[Tensor, " b"]
    begin: Float64[Tensor, "m b"]
    duration: Float64[Tensor, "m b"]
    shift: Float64[Tensor, "m b 3"]
    turn: Float64[Tensor, "m b 3"]

    @staticmethod
    def none(T_world_hand: Tensor, wrist: Tensor, radius: Tensor, most: int) -> "Strokes":
        """Hands that stand, with room for `most` strokes."""
        shape, kind, device = (most, len(radius)), torch.float64, radius.device
        begin = torch.full(shape, torch.inf, dtype=kind, device=device)
        duration = torch.ones(shape, dtype=kind, device=device)
        shift = torch.zeros((*shape, 3), dtype=kind, device=device)
        return Strokes(T_world_hand, wrist, radius, begin, duration, shift, shift.clone())

    def __getitem__(self, rows: Tensor) -> "Strokes":
        of_hand = (self.T_world_hand[rows], self.wrist[rows], self.radius[rows])
        each = (self.begin, self.duration, self.shift, self.turn)
        return Strokes(*of_hand, *(x[:, rows] for x in each))

    def done(self, time_s: Float64[Tensor, " b"]) -> Float64[Tensor, "m b"]:
        """Share of each stroke."""
        return minimum_jerk((time_s - self.begin) / self.duration)

    def pose(self, time_s: Float64[Tensor, " b"]) -> Float64[Tensor, "b 4 4"]:
        """T_world_hand at a time of each hand's own."""
        share = self.done(time_s)[..., None]
        T = self.T_world_hand
        R, wrist = T[:, :3, :3], se3.apply(T, self.wrist)
        for s, shift, turn in zip(share, self.shift, self.turn, strict=True):
            R = se3.matmul(rotation_from_axis_angle(s * turn), R)
            wrist = wrist + s * shift
        return se3.from_rotation(R, wrist - se3.rotate(R, self.wrist))

    def travel(
        self, first_s: Float64[Tensor, " b"], last_s: Float64[Tensor, " b"]
    ) -> Float64[Tensor, " b"]:
        """No point of a hand goes farther between two moments: every stroke goes one way."""
        length, angle = (se3.dot(x, x).sqrt() for x in (self.shift, self.turn))
        return ((self.done(last_s) - self.done(first_s)) * (length + self.radius * angle)).sum(0)

    def add(
        self,
        k: int,
        rows: Tensor,
        begin_s: Tensor,
        duration_s: Tensor,
        goal: Tensor,
        share: float = 1.0,
    ) -> None:
        """Stroke k of some rows: `share` of the way to where the hand would be at `goal` (r, 4, 4), on
        top of all strokes so far."""
        at = self[rows].pose(torch.full_like(begin_s, torch.finfo(torch.float64).max))
        wrist = self.wrist[rows]
        self.shift[k, rows] = share * (se3.apply(goal, wrist) - se3.apply(at, wrist))
        between = se3.matmul(goal[:, :3, :3], at[:, :3, :3].transpose(1, 2)).cpu().numpy()
        turn = torch.from_numpy(Rotation.from_matrix(between).as_rotvec())
        self.turn[k, rows] = share * turn.to(goal.device)
        self.begin[k, rows], self.duration[k, rows] = begin_s, duration_s


@dataclass(frozen=True)
class Replayed:
    """Motions of B hands as frames, straight between them. Fields of F frames repeat the last one.

    Attributes:
        begin: s, of the first frame.
        step: s between frames.
        frames: T_world_hand.
        turn: from each frame to the next, in the hand's frame, axis-angle, rad.
        way: bound of what a point has gone since the first frame, m.
    """

    begin: Float64[Tensor, " b"]
    step: Float64[Tensor, " b"]
    frames: Float64[Tensor, "b f 4 4"]
    turn: Float64[Tensor, "b f 3"]
    way: Float64[Tensor, "b f"]

    def __getitem__(self, rows: Tensor) -> "Replayed":
        return Replayed(*(getattr(self, k)[rows] for k in self.__dataclass_fields__))

    def _at(self, time_s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        place = ((time_s - self.begin) / self.step).clamp(0.0, self.frames.shape[1] - 1.0)
        k = place.floor().long().clamp(max=self.frames.shape[1] - 2)
        return torch.arange(len(k), dtype=torch.int64, device=k.device), k, place - k

    def pose(self, time_s: Float64[Tensor, " b"]) -> Float64[Tensor, "b 4 4"]:
        """T_world_hand at a time of each hand's own."""
        row, k, s = self._at(time_s)
        a, b = self.frames[row, k], self.frames[row, k + 1]
        R = se3.matmul(a[:, :3, :3], rotation_from_axis_angle(s[:, None] * self.turn[row, k]))
        return se3.from_rotation(R, a[:, :3, 3] + s[:, None] * (b[:, :3, 3] - a[:, :3, 3]))

    def travel(
        self, first_s: Float64[Tensor, " b"], last_s: Float64[Tensor, " b"]
    ) -> Float64[Tensor, " b"]:
        """No point of a hand goes farther between two moments."""
        gone = []
        for t in (last_s, first_s):
            row, k, s = self._at(t)
            gone.append(self.way[row, k] + s * (self.way[row, k + 1] - self.way[row, k]))
        return gone[0] - gone[1]


@dataclass(frozen=True)
class Taken:
    """Grasps with which R hands take their objects (`Reception`).

    Attributes:
        T_world_before: 10 cm before them, turned as there.
        T_world_hand: there.
        vertices: in the hand's frame, m.
        joints: in the hand's frame, m.
    """

    T_world_before: Float32[Tensor, "r 4 4"]
    T_world_hand: Float32[Tensor, "r 4 4"]
    vertices: Float32[Tensor, "r v 3"]
    joints: Float32[Tensor, "r 16 3"]

    @property
    def wrist(self) -> Float64[Tensor, "r 3"]:
        """In the hand's frame, m."""
        return self.joints[:, 0].double()

    @property
    def radius(self) -> Float64[Tensor, " r"]:
        """No point of a hand is farther from its wrist, m."""
        return farthest(self.vertices, self.joints)


def farthest(
    vertices: Float32[Tensor, "n v 3"], joints: Float32[Tensor, "n 16 3"]
) -> Float64[Tensor, " n"]:
    """Largest distance of a point of each hand from its wrist, m."""
    return (vertices - joints[:, :1]).double().square().sum(2).amax(1).sqrt() + 1e-6


@dataclass
class MovingHands:
    """The receivers of B trials while they move. `react` is the only thing that changes them.

    Attributes:
        motion: how they move.
        way: where each hand is at any time.
        taking: hands that have been told a grasp to go to.
        taken_s: when they are there.
    """

    motion: ReceiverMotion
    way: Strokes | Replayed
    receiver: Float32[Tensor, "b 5 4"] | None
    taking: Bool[Tensor, " b"]
    taken_s: Float64[Tensor, " b"]
    _wrist: Float64[Tensor, "b 3"] = field(repr=False)
    _out: Float64[Tensor, " b"] = field(repr=False)
    _joints: Float64[Tensor, "b 16 3"] = field(repr=False)
    _side: Int64[Tensor, " b"] = field(repr=False)
    _drawn: dict[str, Tensor] = field(repr=False)

    @staticmethod
    def of(
        scene: Scene,
        trials: Trials,
        motion: ReceiverMotion,
        seeds: NDArray[np.object_] | None = None,
    ) -> "MovingHands":
        """The hands of these trials.

        Args:
            scene: whose hands.
            trials: B trials.
            motion: of all of them.
            seeds: (B,) of the draws; None: the motion's for all.

        Raises:
            ValueError: hands that reach need a receiver's arm (as in r2h-v2); an imported motion must be that
                of the scene's hands.
        """
        if trials.receiver is None and motion.kind in ("reaches", "hesitates", "takes"):
            raise ValueError(
                f"receiver motion {motion.kind} needs receivers with a body; take a benchmark of people, or"
                " still, moves, withdraws, replay"
            )
        device, n = trials.T_world_hand.device, len(trials)
        hand = trials.hand_index.long().cpu()
        joints, skin = scene.hands.joints[hand].double(), scene.hands.vertices
        wrist = joints[:, 0]
        every, place = torch.unique(hand, return_inverse=True)
        radius = farthest(skin[every], scene.hands.joints[every])[place]
        T = trials.T_world_hand.double()
        drawn = {k: v.to(device) for k, v in _draws(trials, motion, seeds).items()}
        way: Strokes | Replayed
        if motion.kind == "replay":
            way = _replayed(scene, trials, motion, drawn["waits"], radius)
        else:
            way = Strokes.none(T, wrist.to(device), radius.to(device), STROKES[motion.kind])
        side = scene.hands.set.side[hand].long().to(device)
        outwards = torch.where(side == 0, -1.0, 1.0).double()
        none = torch.zeros(n, dtype=torch.bool, device=device)
        never = torch.full((n,), torch.inf, dtype=torch.float64, device=device)
        hands = MovingHands(
            motion, way, trials.receiver, none, never, wrist.to(device), outwards, joints.to(device),
            side, drawn,
        )  # fmt: skip
        if isinstance(way, Strokes) and motion.kind != "still":
            hands._first_strokes(way, scene)
        return hands

    def _first_strokes(self, way: Strokes, scene: Scene) -> None:
        n, d, kind = len(self.taking), self._drawn, self.motion.kind
        rows = torch.arange(n, dtype=torch.int64, device=self.taking.device)
        goal = self._gone(way, scene, 1.0)
        for share in SHARES if self.receiver is not None else ():
            beyond = ~self._comfortable(goal, scene)
            goal = torch.where(beyond[:, None, None], self._gone(way, scene, share), goal)
        if kind in ("reaches", "hesitates"):
            way.T_world_hand = self._before_person(way.T_world_hand)
        begin = d["reacts"] if kind in ("reaches", "hesitates") else d["waits"]
        if kind == "hesitates":
            way.add(0, rows, begin, d["stroke"], goal, PAUSE_AT)
            begin = begin + d["stroke"] + d["pause"]
            way.add(1, rows, begin, d["stroke"], goal)
        else:
            way.add(0, rows, begin, d["stroke"], goal)

    def _gone(self, way: Strokes, scene: Scene, share: float) -> Float64[Tensor, "b 4 4"]:
        """The hands after this share of the drawn shift and turn, over the table and within the arm's length."""
        goal = way.T_world_hand.clone()
        turn = rotation_from_axis_angle(share * self._drawn["turn"])
        goal[:, :3, :3] = se3.matmul(turn, goal[:, :3, :3])
        table = scene.config.workplace
        top = table.table_center[2] + table.table_half[2] + OVER_TABLE_M
        wrist = se3.apply(way.T_world_hand, way.wrist) + share * self._drawn["shift"]
        wrist = torch.stack([wrist[:, 0], wrist[:, 1], wrist[:, 2].clamp(min=top)], 1)
        return self._within_reach(goal, wrist)

    def _comfortable(self, T_world_hand: Float64[Tensor, "b 4 4"], scene: Scene) -> Tensor:
        """Whether forearms and wrists are within their ranges there."""
        person = self.people(T_world_hand)
        assert person is not None
        joints, side = self._joints, self._side
        _, normal = palm_frame(joints, side)
        along = joints[:, MIDDLE_ROOT] - joints[:, 0]
        along = along - se3.dot(along, normal)[:, None] * normal
        along = along / se3.dot(along, along).sqrt()[:, None]
        R = T_world_hand[:, :3, :3]
        shoulder, elbow, wrist = person.double()[:, :3, :3].unbind(1)
        angles = lower_arm_angles(
            shoulder, elbow, wrist, se3.rotate(R, along), se3.rotate(R, normal), self._out
        )
        return within_ranges(angles)

    def pose(self, time_s: float | Tensor) -> Float32[Tensor, "b 4 4"]:
        """T_world_hand at a time, m."""
        return self.way.pose(self._times(time_s)).float()

    def travel(self, first_s: float | Tensor, last_s: float | Tensor) -> Float32[Tensor, " b"]:
        """A bound of what any point of each hand goes between two moments, m."""
        return self.way.travel(self._times(first_s), self._times(last_s)).float()

    def moving(self, time_s: float, step_s: float) -> Bool[Tensor, " b"]:
        """Which hands move within a step that begins now."""
        return self.travel(time_s, time_s + step_s) > 1e-6

    def _times(self, time_s: float | Tensor) -> Float64[Tensor, " b"]:
        if isinstance(time_s, Tensor):
            return time_s.double()
        return torch.full_like(self.taken_s, time_s)

    def keeping(self, old: "MovingHands", mask: Bool[Tensor, " b"]) -> "MovingHands":
        """These hands, with `old` ones' motion so far in the rows of the mask."""
        if isinstance(self.way, Strokes):
            assert isinstance(old.way, Strokes)
            ways = zip(*(vars(way).items() for way in (self.way, old.way)), strict=True)
            for (name, new), (_, before) in ways:
                each = name in ("begin", "duration", "shift", "turn")
                rows = (slice(None), mask) if each else mask
                new = new.clone()
                new[rows] = before[rows]
                setattr(self.way, name, new)
        self.taking = torch.where(mask, old.taking, self.taking)
        self.taken_s = torch.where(mask, old.taken_s, self.taken_s)
        return self

    def react(self, time_s: float | Tensor, gap_m: Float32[Tensor, " b"]) -> None:
        """Hands that withdraw do so where the robot is nearer than they like, once."""
        if self.motion.kind != "withdraws":
            return
        assert isinstance(self.way, Strokes)
        afraid = (gap_m < self._drawn["afraid"]) & self.way.begin[1].isinf()
        rows = torch.nonzero(afraid).flatten()
        if not len(rows):
            return
        now = self._times(time_s)[rows]
        there = self.way[rows].pose(torch.full_like(now, torch.finfo(torch.float64).max))
        wrist = se3.apply(there, self._wrist[rows])
        if self.receiver is None:
            back = -there[:, :3, 0]
        else:
            back = self.receiver[rows, 0, :3].double() - wrist
        back = back * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, device=back.device)
        back = BACK_M * back / se3.dot(back, back).sqrt().clamp(min=1e-6)[:, None]
        away = there.clone()
        away[:, :3, 3] += back
        self.way.add(1, rows, now, torch.full_like(now, BACK_S), away)
        self.way.add(
            2, rows, now + BACK_S + self._drawn["away"][rows], self._drawn["stroke"][rows], there
        )

    def take(self, time_s: Float64[Tensor, " b"], rows: Int64[Tensor, " r"], grasp: Taken) -> None:
        """Hands take the grasps' shapes and go to them, on the way that reception says. What they meant to do is
        forgotten; `time_s`: now, of all trials."""
        way = self.way
        assert isinstance(way, Strokes)
        way.T_world_hand[rows] = way.pose(time_s)[rows]
        way.begin[:, rows] = torch.inf
        way.wrist[rows] = grasp.wrist
        way.radius[rows] = torch.maximum(way.radius[rows], grasp.radius)
        begin, lasts = self._drawn["take_after"][rows] + time_s[rows], self._drawn["take"][rows]
        way.add(1, rows, begin, lasts, grasp.T_world_before.double())
        begin, lasts = begin + lasts, LAST_SHARE * lasts
        way.add(2, rows, begin, lasts, grasp.T_world_hand.double())
        self.taking[rows], self.taken_s[rows] = True, begin + lasts

    def people(
        self, T_world_hand: Float32[Tensor, "r 4 4"], rows: Tensor | None = None
    ) -> Float32[Tensor, "r 5 4"] | None:
        """Receivers (`Trials.receiver`) of some trials (None: of all) whose arms follow their hands; torso and
        shoulder stay."""
        if self.receiver is None:
            return None
        which: Tensor | slice = slice(None) if rows is None else rows
        out = self.receiver[which].clone()
        wrist = se3.apply(T_world_hand.double(), self._wrist[which])
        out[:, 1, :3] = elbow_of(out.double(), wrist, self._out[which]).float()
        out[:, 2, :3] = wrist.float()
        return out

    def _within_reach(self, T: Float64[Tensor, "b 4 4"], wrist: Float64[Tensor, "b 3"]) -> Tensor:
        """The hand turned as in T with its wrist there, or as near to there as the arm is long."""
        if self.receiver is not None:
            shoulder, most, least = _lengths(self.receiver.double())
            to = wrist - shoulder
            r = se3.dot(to, to).sqrt()
            wrist = (
                shoulder
                + to * (torch.minimum(torch.maximum(r, least), STRETCHED * most) / r)[:, None]
            )
        R = T[:, :3, :3]
        return se3.from_rotation(R, wrist - se3.rotate(R, self._wrist))

    def _before_person(self, T: Float64[Tensor, "b 4 4"]) -> Tensor:
        """The hand turned as in T, where a hanging upper arm and a level forearm bring it: clear of the table."""
        assert self.receiver is not None
        person = self.receiver.double()
        shoulder, elbow, wrist = person[:, 0, :3], person[:, 1, :3], person[:, 2, :3]
        upper, lower = (se3.dot(a, a).sqrt() for a in (elbow - shoulder, wrist - elbow))
        zero = torch.zeros_like(upper)
        ahead = torch.stack([person[:, 3, 3], person[:, 4, 3], zero], 1)
        down = torch.stack([zero, zero, -upper], 1)
        R = T[:, :3, :3]
        at = shoulder + down + lower[:, None] * ahead
        return se3.from_rotation(R, at - se3.rotate(R, self._wrist))


def elbow_of(
    receiver: Float64[Tensor, "b 5 4"],
    wrist: Float64[Tensor, "b 3"],
    outwards: Float64[Tensor, " b"],
) -> Float64[Tensor, "b 3"]:
    """The elbow when the wrist is elsewhere: at the swivel about the line from shoulder to wrist that
    it has in `receiver` (`Trials.receiver`), in closed form.

    Args:
        receiver: the arm in another posture, world, m.
        wrist: world, m; at most as far from the shoulder as the arm is long.
        outwards: -1 of right arms, 1 of left ones.
    """
    shoulder, elbow, old = receiver[:, 0, :3], receiver[:, 1, :3], receiver[:, 2, :3]
    upper, lower = (se3.dot(a, a).sqrt() for a in (elbow - shoulder, old - elbow))

    def frame(at: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        to = at - shoulder
        r = se3.dot(to, to).sqrt()
        to = to / r[:, None]
        down = torch.zeros_like(to)
        down[:, 2] = -1.0
        hanging = down - se3.dot(down, to)[:, None] * to
        hanging = hanging / se3.dot(hanging, hanging).sqrt().clamp(min=1e-9)[:, None]
        return r, to, hanging, outwards[:, None] * se3.cross(to, hanging)

    _, _, hanging, aside = frame(old)
    c, s = se3.dot(elbow - shoulder, hanging), se3.dot(elbow - shoulder, aside)
    size = (c * c + s * s).sqrt().clamp(min=1e-12)
    c, s = c / size, s / size
    r, to, hanging, aside = frame(wrist)
    along = (upper * upper - lower * lower + r * r) / (2.0 * r)
    offset = (upper * upper - along * along).clamp(min=0.0).sqrt()
    direction = c[:, None] * hanging + s[:, None] * aside
    return shoulder + along[:, None] * to + offset[:, None] * direction


def _lengths(person: Float64[Tensor, "b 5 4"]) -> tuple[Tensor, Tensor, Tensor]:
    """Shoulders; the longest and the shortest distance of a wrist from them."""
    shoulder, elbow, wrist = person[:, 0, :3], person[:, 1, :3], person[:, 2, :3]
    upper, lower = (se3.dot(a, a).sqrt() for a in (elbow - shoulder, wrist - elbow))
    return shoulder, upper + lower, (upper - lower).abs() + 0.05


def rows_of_seeds(seeds: NDArray[np.object_]) -> list[tuple[int, NDArray[np.int64]]]:
    """Each seed with the rows that have it.

    Args:
        seeds: (B,) whole numbers of any size.
    """
    own: dict[int, list[int]] = {}
    for row, seed in enumerate(seeds.tolist()):
        own.setdefault(seed, []).append(row)
    return [(seed, np.array(rows, np.int64)) for seed, rows in own.items()]


def _draws(
    trials: Trials, motion: ReceiverMotion, seeds: NDArray[np.object_] | None
) -> dict[str, Tensor]:
    """Random times and targets of each trial's receiver."""
    ids = trials.trial_id.cpu().numpy().astype(np.int64)
    seeds = np.full(len(ids), motion.seed, object) if seeds is None else seeds
    spans = {
        "waits": WAITS_S, "reacts": REACTS_S, "stroke": STROKE_S, "pause": PAUSE_S,
        "afraid": AFRAID_M, "away": AWAY_S, "take_after": TAKE_AFTER_S, "take": TAKE_S,
    }  # fmt: skip
    u, z = np.empty((len(spans), len(ids))), np.empty((6, len(ids)))
    for seed, rows in rows_of_seeds(seeds):
        key = (_KEY[0] ^ (seed & 0xFFFFFFFF), _KEY[1] ^ (seed >> 32 & 0xFFFFFFFF))
        u[:, rows] = rng.uniforms(key, ids[rows], len(spans), purpose=_PURPOSE_TIMES)
        z[:, rows] = normals(key, ids[rows], 6, purpose=_PURPOSE_PLACE)
    drawn = {
        k: torch.from_numpy(a + (b - a) * x)
        for (k, (a, b)), x in zip(spans.items(), u, strict=True)
    }
    where = torch.from_numpy(z.T.copy())
    drawn["shift"] = motion.shift_m * where[:, :3]
    drawn["turn"] = float(np.radians(motion.turn_deg)) / 3.0**0.5 * where[:, 3:]
    return drawn


def _replayed(
    scene: Scene, trials: Trials, motion: ReceiverMotion, begin: Tensor, radius: Tensor
) -> Replayed:
    """The motions of an imported set (data/hand_sets.py), each moved as a whole so that the frame in
    which the hand receives has the trial's pose. Gravity is that of the trial, not of the recording."""
    path = motion.path
    if not path.stem.endswith("_motion"):
        raise FileError(f"{path}: motions of an imported hand set are called NAME_motion.npz")
    about = path.with_name(f"{path.stem.removesuffix('_motion')}.npz")
    moved: dict[str, Any] = read_npz(path, only=("first", "hand"))
    known: dict[str, Any] = read_npz(about, only=("pose", "side", "frame", "rate_hz"))
    hand = trials.hand_index.long().cpu()
    pose, side = scene.hands.set.pose.numpy(), scene.hands.set.side.numpy()
    rows = {(int(s), p.tobytes()): i for i, (s, p) in enumerate(zip(known["side"], known["pose"]))}
    step, parts = [], []
    for h in hand.tolist():
        row = rows.get((int(side[h]), pose[h].tobytes()))
        if row is None:
            raise ValueError(
                f"{about}: has no hand {h} of these trials; give the same file as --hands"
            )
        rate = float(known["rate_hz"][row]) or 30.0
        last = int(moved["first"][row]) + int(known["frame"][row])
        first = max(int(moved["first"][row]), last - round(REPLAYED_S * rate))
        parts.append(moved["hand"][first : last + 1].astype(np.float64))
        step.append(1.0 / rate)
    most = max(2, *(len(p) for p in parts))
    filled = np.stack([np.concatenate([p, np.repeat(p[-1:], most - len(p), 0)]) for p in parts])
    if not np.isfinite(filled).all():
        raise ValueError(f"{path}: the wrists' motion of these hands is not known")
    source = np.tile(np.eye(4), (*filled.shape[:2], 1, 1))
    source[..., :3, :3] = (
        Rotation.from_rotvec(filled[..., :3].reshape(-1, 3))
        .as_matrix()
        .reshape(*filled.shape[:2], 3, 3)
    )
    source[..., :3, 3] = filled[..., 3:]
    received = np.stack([source[i, len(p) - 1] for i, p in enumerate(parts)])
    placed = trials.T_world_hand.double().cpu().numpy() @ np.linalg.inv(received)
    frames = placed[:, None] @ source
    between = np.swapaxes(frames[:, :-1, :3, :3], 2, 3) @ frames[:, 1:, :3, :3]
    turn = np.zeros(filled[..., :3].shape)
    turn[:, :-1] = (
        Rotation.from_matrix(between.reshape(-1, 3, 3)).as_rotvec().reshape(turn[:, :-1].shape)
    )
    gone = np.linalg.norm(np.diff(frames[..., :3, 3], axis=1), axis=2)
    # about the hand's origin, which the wrist need not be
    reach = radius + scene.hands.joints[hand, 0].double().square().sum(1).sqrt()
    gone = gone + np.linalg.norm(turn[:, :-1], axis=2) * reach.numpy()[:, None]
    way = np.concatenate([np.zeros((len(gone), 1)), np.cumsum(gone, 1)], 1)
    device = trials.T_world_hand.device
    return Replayed(
        begin, *(torch.from_numpy(np.asarray(x)).to(device) for x in (step, frames, turn, way))
    )
