"""A trial played in closed loop as something to draw: the hand and its arm move too."""

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.closed_loop.env import End, HandoverEnv, LoopConfig
from r2h_batch.closed_loop.episodes import play, policy_of
from r2h_batch.closed_loop.moving import ReceiverMotion
from r2h_batch.closed_loop.policies import kind_of_action
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.skin import least_turn
from r2h_batch.view.stored import Reader

Array = NDArray[np.float64]


class EpisodeDrawing(Drawing):
    """A trial with a motion of its own and a hand that moves.

    Postures have the number of the step behind the joints' angles: where the hand is then.
    """

    def __init__(
        self, stored: Any, q: Array, T_world_hand: Array, receivers: Array | None, step_s: float
    ) -> None:
        """Motions of S steps.

        Args:
            stored: the trial.
            q: (S, joints) rad.
            T_world_hand: (S, 4, 4), m.
            receivers: (S, 5, 4) as in `Trials.receiver`; None: no body.
            step_s: between them.
        """
        self.steps = np.concatenate([q, np.arange(len(q), dtype=np.float64)[:, None]], 1)
        self.step_s, self._hands, self._receivers = step_s, T_world_hand, receivers
        super().__init__(stored)

    def show(self, T_world_hand: Array, receivers: Array | None) -> None:
        """Other places of hand (S, 4, 4) and body (S, 5, 4), for the steps from now on."""
        self._hands, self._receivers = T_world_hand, receivers

    @cached_property
    def _limbs(self) -> list[tuple[int, Array, Array, Array, Array]]:
        """Upper arm and forearm as the trial begins: geom, its position and rotation, the joint that it turns about,
        and the bone."""
        model, found, receiver = self.model, [], self.stored.receiver
        assert receiver is not None  # `show` has got one of this trial
        for limb, (a, b) in zip(("upper_arm", "forearm"), _limbs_of(receiver), strict=True):
            geom, R = model.geom(f"receiver/{limb}_visual").id, np.zeros(9)
            mujoco.mju_quat2Mat(R, model.geom_quat[geom])
            found.append((geom, model.geom_pos[geom].copy(), R.reshape(3, 3), a, b - a))
        return found

    def motion(self, executed: bool = True) -> tuple[Array, Array]:
        """Times (S,) s and postures with their steps (S, 7)."""
        return np.arange(len(self.steps), dtype=np.float64) * np.float64(self.step_s), self.steps

    def moments(self, n: int) -> list[tuple[float, Array, bool]]:
        """As `Drawing.moments`: even times from the start to the end, no failure marked."""
        times, steps = self.motion()
        at = np.linspace(0, len(times) - 1, n).round().astype(int)
        return [(float(times[k]), steps[k], False) for k in at]

    def at(self, q: Array) -> mujoco.MjData:
        """The bodies at a posture and its step (7,); without a step as the trial began."""
        joints = len(self.stored.robot.joints)
        k = int(q[joints]) if len(q) > joints else 0
        T, model = self._hands[k], self.model
        hand = model.body("hand").id
        model.body_pos[hand], model.body_quat[hand] = T[:3, 3], _quat(T[:3, :3])
        if self._receivers is not None:
            for (geom, position, R, joint, along), (a, b) in zip(
                self._limbs, _limbs_of(self._receivers[k]), strict=True
            ):
                turn = least_turn(along, b - a)
                model.geom_pos[geom] = a + turn @ (position - joint)
                model.geom_quat[geom] = _quat(turn @ R)
        return super().at(q[:joints])


def _limbs_of(receiver: Array) -> list[tuple[Array, Array]]:
    """Ends of upper arm and forearm of a row of `Trials.receiver`, m."""
    return [(receiver[k, :3], receiver[k + 1, :3]) for k in range(2)]


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
    drawing = EpisodeDrawing(stored, q, hands, bodies, env.step_s)
    drawing.ended = words, end == End.SUCCESS
    return drawing
