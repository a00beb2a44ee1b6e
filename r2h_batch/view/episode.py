"""A trial played in closed loop as something to draw: the hand and its arm move too."""

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from r2h_batch.closed_loop.env import End, HandoverEnv, LoopConfig
from r2h_batch.closed_loop.episodes import check_in_gripper, play, policy_of
from r2h_batch.closed_loop.moving import ReceiverMotion
from r2h_batch.closed_loop.policies import kind_of_action
from r2h_batch.verdicts import SEXES
from r2h_batch.view.drawing import Drawing, Witness
from r2h_batch.view.mjcf import cuff_of, receiver_meshes
from r2h_batch.view.stored import Reader

Array = NDArray[np.float64]


class EpisodeDrawing(Drawing):
    """A trial with a motion of its own and a hand that moves.

    Postures have the number of the step behind the joints' angles: where the hand is then.
    """

    def __init__(
        self, stored: Any, q: Array, T_world_hand: Array, receivers: Array | None, step_s: float,
        touches: bool = False,
    ) -> None:  # fmt: skip
        """Motions of S steps.

        Args:
            stored: the trial.
            q: (S, joints) rad.
            T_world_hand: (S, 4, 4), m.
            receivers: (S, 5, 4) as in `Trials.receiver`; None: no body.
            step_s: between them.
            touches: whether robot and receiver touch at the end, too early.
        """
        self.steps = np.concatenate([q, np.arange(len(q), dtype=np.float64)[:, None]], 1)
        self.step_s, self._hands, self._receivers = step_s, T_world_hand, receivers
        self._bent = -1
        """the step at which the receiver's skin is now; -1: as the trial began"""
        self.touches = touches
        super().__init__(stored)

    @property
    def legs(self) -> tuple[Drawing, ...]:
        """None: an episode begins with the object in the gripper."""
        return ()

    def show(self, T_world_hand: Array, receivers: Array | None) -> None:
        """Other places of hand (S, 4, 4) and body (S, 5, 4), for the steps from now on."""
        self._hands, self._receivers, self._bent = T_world_hand, receivers, -1

    @cached_property
    def _skins(self) -> dict[str, tuple[int, int, NDArray[np.int64]]]:
        """Surface of the receiver -> its geom, its mesh, and which vertex of `receiver_meshes` each of the mesh's is."""
        model, found, stored = self.model, {}, self.stored
        assert stored.receiver is not None  # `show` has got one of this trial
        for name, made in self._receiver(stored.receiver, stored.T_world_hand).items():
            geom = int(model.geom(f"receiver/{name}_visual").id)
            mesh, R = int(model.geom_dataid[geom]), np.zeros(9)
            mujoco.mju_quat2Mat(R, model.geom_quat[geom])
            v = int(model.mesh_vertadr[mesh])
            there = model.mesh_vert[v : v + model.mesh_vertnum[mesh]] @ R.reshape(3, 3).T
            order = cKDTree(made.vertices).query(there + model.geom_pos[geom])[1]
            found[name] = (geom, mesh, np.asarray(order, np.int64))
        return found

    def _receiver(self, receiver: Array, T_world_hand: Array) -> dict[str, trimesh.Trimesh]:
        """The surfaces of a receiver (5, 4) with the hand there."""
        row, R = self.stored.row, np.zeros(9)
        mujoco.mju_quat2Mat(R, self.model.site("palm").quat)
        palm = T_world_hand[:3, :3] @ R.reshape(3, 3)[:, 2]
        sex = SEXES.index(row["sex"]) if row.get("sex") in SEXES else None
        cuff = self._cuff @ T_world_hand[:3, :3].T + T_world_hand[:3, 3]
        return receiver_meshes(receiver, left=row["side"] == "left", palm=palm, sex=sex, cuff=cuff)

    @cached_property
    def _cuff(self) -> Array:
        return cuff_of(self.stored)

    def _bend(self, k: int) -> None:
        """The receiver's skin at a step, vertex by vertex: arm, shoulder and trunk stay one surface."""
        model, receivers, skins = self.model, self._receivers, self._skins
        assert receivers is not None
        for name, made in self._receiver(receivers[k], self._hands[k]).items():
            geom, mesh, order = skins[name]
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            R = turn.reshape(3, 3)
            v, n = int(model.mesh_vertadr[mesh]), int(model.mesh_normaladr[mesh])
            model.mesh_vert[v : v + len(order)] = (made.vertices[order] - model.geom_pos[geom]) @ R
            if model.mesh_normalnum[mesh] == len(order):
                model.mesh_normal[n : n + len(order)] = made.vertex_normals[order] @ R
            self.reshaped.add(mesh)

    def motion(self, executed: bool = True) -> tuple[Array, Array]:
        """Times (S,) s and postures with their steps (S, 7)."""
        return np.arange(len(self.steps), dtype=np.float64) * np.float64(self.step_s), self.steps

    def groups(self, *, fails: bool) -> tuple[str, ...]:
        """As `Drawing.groups`, of the episode's own end."""
        return ("region", "witness") if fails and self.witness is not None else ("region", "ball")

    @cached_property
    def fails_at_s(self) -> float | None:
        """The end of an episode that failed."""
        return None if self.ended is None or self.ended[1] else float(self.motion()[0][-1])

    @cached_property
    def witness(self) -> Witness | None:
        """The two bodies that touch at the end, too early; None where nothing touches."""
        if not self.touches:
            return None
        return self._nearest(
            self.last, [p for p in self._checked() if p[2] in ("hand", "object_hand")]
        )

    @cached_property
    def event(self) -> tuple[Array, Array, frozenset[str]]:
        """The end of the episode: posture, point, and the bodies that take part."""
        witness = self.witness
        if witness is None:
            return (
                self.last,
                self.at(self.last).site("ee").xpos.copy(),
                frozenset({"gripper", "object"}),
            )
        bodies = (self.body_of(int(self.model.geom(name).id)) for name in witness.geoms)
        return self.last, witness.line.mean(0), frozenset(bodies)

    def moments(self, n: int) -> list[tuple[float, Array, bool]]:
        """As `Drawing.moments`: even times from the start to the end, which fails where the episode does."""
        times, steps = self.motion()
        at = np.linspace(0, len(times) - 1, n).round().astype(int)
        fails = self.fails_at_s is not None
        return [(float(times[k]), steps[k], fails and k == at[-1]) for k in at]

    def at(self, q: Array) -> mujoco.MjData:
        """The bodies at a posture and its step (7,); without a step as the trial began."""
        joints = len(self.stored.robot.joints)
        k = int(q[joints]) if len(q) > joints else 0
        T, model = self._hands[k], self.model
        hand = model.body("hand").id
        model.body_pos[hand], model.body_quat[hand] = T[:3, 3], _quat(T[:3, :3])
        if self._receivers is not None and k != self._bent:
            self._bend(k)
            self._bent = k
        return super().at(q[:joints])


def _quat(R: Array) -> Array:
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(R).ravel())
    return out


def episode_of(
    reader: Reader, trial_id: int, method: str | None, motion: str, policy: str
) -> EpisodeDrawing:
    """A stored trial, played as `sweep --receiver-motion --policy` plays it.

    Raises:
        ValueError, ImportError: no such motion or policy.
    """
    check_in_gripper(reader.benchmark)
    act, _ = policy_of(policy)
    seed, stored = int(reader.run.header["seed"]), reader.trial(trial_id, method)
    ids = torch.tensor([trial_id], dtype=torch.int64, device="cpu")
    T_obj_ee, T_world_ee = (
        torch.from_numpy(T[None]).float() for T in (stored.T_obj_ee, stored.T_world_ee)
    )
    trials = reader.benchmark.trials_with_ids(ids)
    scores = reader.evaluator.kinematic.score(T_obj_ee, T_world_ee, trials)
    moving, config = ReceiverMotion.parse(motion, seed), LoopConfig(seed=seed)
    kind: Any = kind_of_action(act)
    env = HandoverEnv(scores, moving, config=config, action=kind)
    found = play(env, act)
    q, hands = (x[0].double().numpy() for x in env.trace())
    bodies = None
    if env.trials.receiver is not None:
        assert env.hands is not None  # `play` has reset it
        made = (env.hands.people(torch.from_numpy(T[None]).float()) for T in hands)
        bodies = np.stack([x[0].double().numpy() for x in made if x is not None])
    end = End(int(found.end[0]))
    who = ", by the robot" if bool(found.robot_touched[0]) else ", by the hand"
    how = f"{end.name.lower().replace('_', ' ')}{who if end == End.CONTACT else ''}"
    words = f"{policy}, {motion}: {how} after {float(found.time_s[0]):.1f} s"
    touches = end == End.CONTACT
    drawing = EpisodeDrawing(stored, q, hands, bodies, env.step_s, touches)
    drawing.ended = words, end == End.SUCCESS
    return drawing
