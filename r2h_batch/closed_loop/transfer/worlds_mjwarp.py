"""Transfers in batched MuJoCo-Warp worlds: the engine for CUDA.

Each world has its own object, hand, friction and person. A tick is one captured graph. State, person, sensor and
policy stay on the device: the host waits for nothing but the end of a batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch import init_warp
from r2h_batch.closed_loop.transfer.handed import Handed
from r2h_batch.closed_loop.transfer.model import (
    ARM_KG,
    BASE,
    DAMPING,
    FREE_DAMPING,
    Places,
    transfer_spec,
)
from r2h_batch.closed_loop.transfer.worlds import Seen, Told
from r2h_batch.closed_loop.transfer.worlds_mujoco import (
    CLOSE_TICKS,
    SETTLE_TICKS,
    TOO_FAST,
    TOUCH_M,
    Models,
)
from r2h_batch.judge.grasp_physics import full_effort
from r2h_batch.scene.model import MESH_FIELDS
from r2h_batch.scene.model_parts import add_mesh
from r2h_batch.trials.holding.held_out import G

BATCHED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass", "body_invweight0",
    "dof_invweight0", "dof_damping", "dof_frictionloss", "actuator_gainprm", "actuator_biasprm",
)  # fmt: skip
"""Fields of the model that each world has of its own, beside those of its object's pieces."""
STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "xfrc_applied")
"""Fields of the data that a world goes on from."""
AWAY_M = 100.0
"""Spare geoms of an object with fewer pieces than another in the batch are so far away: they touch nothing."""
NJMAX, NACON_PER_WORLD = 256, 64
"""Buffers: rows of constraints a world, and contacts (a pool of all worlds)."""


@dataclass(frozen=True, eq=False)
class Standing:
    """N rows with closed grippers, their weight acting.

    Attributes:
        handed: the rows.
        state: `STATE` of each world.
        seen: what the worlds show in it.
        before: (N, nq) qpos that `seen.touching` belongs to.
        com_closed: (N, 3) centre of mass when the gripper had closed, m.
        models: MuJoCo C's model of each.
        overflowed: (N,) whether a world has lost constraints or contacts.
    """

    handed: Handed
    state: dict[str, Tensor]
    seen: Seen
    before: Float32[Tensor, "n nq"]
    com_closed: Float64[Tensor, "n 3"]
    models: list[mujoco.MjModel]
    overflowed: Bool[Tensor, " n"]


class Batch:
    """N standing worlds of some objects: the model with all their pieces, and the graph of a tick.

    Args:
        models: compiled models of the objects.
        objects: which of them, ascending.
        n: worlds.
        device: cpu, cuda or cuda:N.
    """

    def __init__(self, models: Models, objects: Sequence[int], n: int, device: str) -> None:
        init_warp()
        self.models, self.device, self.n = models, device, n
        self.steps, self.effort = models.setting.steps, full_effort(models.robot)
        host, self.mesh = _model_of(models, objects)
        self.places = p = Places.of(host)
        self.geoms = np.flatnonzero(host.geom_bodyid == p.object_body)
        with wp.ScopedDevice(device):
            batched = dict.fromkeys((*BATCHED, *MESH_FIELDS), n)
            self.model = mjw.put_model(host, batch_sizes=batched)
            gravity: Any = wp.zeros(n, dtype=wp.vec3)
            self.model.opt.gravity = gravity
            self.model.opt.warn_overflow = 0  # it prints to stdout; the bits are read below
            self.data = mjw.make_data(host, nworld=n, njmax=NJMAX, naconmax=NACON_PER_WORLD * n)
            self.before_warp: Any = wp.zeros_like(self.data.qpos)
            mjw.step(self.model, self.data)  # compiles what the graph needs
            with wp.ScopedCapture() as capture:
                for step in range(self.steps):
                    if step == self.steps - 1:
                        # contacts of a step are those of the state that it begins with
                        wp.copy(self.before_warp, self.data.qpos)
                    mjw.step(self.model, self.data)
            self.graph = capture.graph
        names = ("qacc", "actuator_force", "xipos", "xpos", "xmat", "nefc", "nacon", "overflow")
        self.data_of = {k: wp.to_torch(getattr(self.data, k)) for k in (*STATE, *names)}
        self.contact_m = wp.to_torch(self.data.contact.dist)
        self.contact_world = wp.to_torch(self.data.contact.worldid)
        self.gravity = wp.to_torch(gravity)
        self.model_of = {k: wp.to_torch(getattr(self.model, k)) for k in BATCHED}
        self.before = wp.to_torch(self.before_warp)
        self.at = {
            f.name: torch.from_numpy(x).to(self.gravity.device)
            for f in fields(Places)
            if isinstance(x := getattr(p, f.name), np.ndarray)
        }

    def close(self, handed: Handed) -> Standing:
        """Closes the grippers of N rows on their objects, and lets the weights act, as `Models.close` does."""
        started = [self.models.ajar(handed[i : i + 1]) for i in range(len(handed))]
        self._load(handed, started)
        self.data_of["ctrl"].index_fill_(1, self.at["fingers"], self.effort)
        self._ticks(CLOSE_TICKS)
        body = self.places.object_body
        closed = self.data_of["xipos"][:, body].double()
        self.model_of["dof_damping"].index_fill_(1, self.at["slip_v"], FREE_DAMPING)
        self.gravity.copy_(torch.from_numpy((G * handed.down).astype(np.float32)))
        self._ticks(SETTLE_TICKS)
        state = {k: self.data_of[k].clone() for k in STATE}
        models = [m for m, _ in started]
        seen, before = self.seen(), self.before.clone()
        return Standing(handed, state, seen, before, closed, models, self.overflowed())

    def go_on_from(self, standing: Standing, arm_n_m: Float64[Tensor, " n"]) -> None:
        """Puts every world into the state of its row, with the stiffness of its person's arm."""
        for name, values in standing.state.items():
            self.data_of[name].copy_(values)
        self.data_of["overflow"].zero_()
        k = arm_n_m.float()[:, None]
        hand = self.places.hand[:3]
        for field, column, values in (
            ("actuator_gainprm", 0, k),
            ("actuator_biasprm", 1, -k),
            ("actuator_biasprm", 2, -2 * DAMPING * (k * ARM_KG).sqrt()),
        ):
            self.model_of[field][:, hand[0] : hand[-1] + 1, column] = values

    def step(self, told: Told) -> None:
        """Goes on by a tick."""
        ctrl, at = self.data_of["ctrl"], self.at
        ctrl.index_copy_(
            1, at["fingers"], (told.effort * self.effort).float()[:, None].expand(-1, 2)
        )
        ctrl.index_copy_(1, at["wrist"], told.shift.float())
        ctrl.index_copy_(1, at["hand"][:3], told.hand.float())
        self.model_of["dof_frictionloss"].index_copy_(1, at["slip_v"], told.friction.float())
        if told.push is not None:
            body = self.places.object_body
            force, point = told.push[:, :3], told.push[:, 3:]
            moment = torch.linalg.cross(point - self.data_of["xipos"][:, body].double(), force)
            self.data_of["xfrc_applied"][:, body] = torch.cat([force, moment], 1).float()
        self._ticks(1)

    def seen(self) -> Seen:
        """The state now."""
        d, p, at = self.data_of, self.places, self.at
        actuator = d["actuator_force"]
        load = BASE[0] * d["qacc"].index_select(1, at["wrist_v"])
        body = p.object_body
        speed = d["qvel"].abs().amax(1)
        return Seen(
            load=(load - actuator.index_select(1, at["wrist"])).double(),
            shifted=d["qpos"].index_select(1, at["wrist_q"]).double(),
            com=d["xipos"][:, body].double(),
            p_obj=d["xpos"][:, body].double(),
            R_obj=d["xmat"][:, body].double(),
            slip=d["qpos"].index_select(1, at["slip_q"]).double(),
            arm=actuator.index_select(1, at["hand"][:3]).double(),
            touching=self._touching(),
            fine=speed < TOO_FAST,
        )

    def overflowed(self) -> Bool[Tensor, " n"]:
        """Which worlds have lost constraints or contacts; all, if the pool of contacts was too small."""
        d = self.data_of
        own = (d["overflow"] != 0) | (d["nefc"] > NJMAX)
        return own | (d["nacon"] > NACON_PER_WORLD * self.n)

    def _touching(self) -> Bool[Tensor, " n"]:
        """Whether the contact list has a contact of each world."""
        there = torch.arange(len(self.contact_m), dtype=torch.int32, device=self.gravity.device)
        near = (there < self.data_of["nacon"]) & (self.contact_m < TOUCH_M)
        world = torch.where(near, self.contact_world.long(), self.n)
        found = torch.zeros(self.n + 1, dtype=torch.bool, device=self.gravity.device)
        return found.index_fill(0, world, True)[: self.n]

    def _ticks(self, count: int) -> None:
        stream = None
        if self.gravity.device.type == "cuda":
            # torch's stream: the graph finds what torch wrote, and the host does not wait
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.gravity.device))
        for _ in range(count):
            wp.capture_launch(self.graph, stream=stream)

    def _load(
        self, handed: Handed, started: Sequence[tuple[mujoco.MjModel, mujoco.MjData]]
    ) -> None:
        """Writes objects, grasps and states of N rows into the worlds."""
        with wp.ScopedDevice(self.device):
            for name in BATCHED:
                values = np.stack([getattr(m, name) for m, _ in started])
                getattr(self.model, name).assign(values.astype(np.float32))
            for name, values in self._pieces(handed.object_index).items():
                getattr(self.model, name).assign(values)
            for name in STATE:
                state = np.stack([getattr(d, name) for _, d in started])
                getattr(self.data, name).assign(state.astype(np.float32))
            self.model.opt.gravity.zero_()
            self.data.overflow.zero_()  # the simulator only ever adds to it
            wp.synchronize_device(self.device)  # the worlds go on on torch's stream

    def _pieces(self, object_index: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """`MESH_FIELDS` of all geoms of each world: spare ones repeat the last piece, far away."""
        of = {}
        for index in set(object_index.tolist()):
            own = self.models.of(index)
            geoms = np.flatnonzero(own.geom_bodyid == self.places.object_body)
            spare = len(self.geoms) - len(geoms)
            rows = np.r_[: geoms[0], geoms, np.full(spare, geoms[-1])]
            values = {name: np.array(getattr(own, name)[rows]) for name in MESH_FIELDS}
            meshes = self.mesh[index]
            values["geom_dataid"][self.geoms] = meshes + meshes[-1:] * spare
            values["geom_pos"][len(rows) - spare :] = AWAY_M
            values["geom_aabb"] = values["geom_aabb"].reshape(-1, 2, 3)
            of[index] = values
        return {
            name: np.stack([of[i][name] for i in object_index.tolist()]).astype(
                np.int32 if name == "geom_dataid" else np.float32
            )
            for name in MESH_FIELDS
        }


class WarpWorlds:
    """N transfers in standing MuJoCo-Warp worlds (`worlds.Worlds`).

    Attributes:
        touched: `Seen.touching` at each tick.
        postures: (N, nq) at each tick: those that the contacts belong to.
        overflowed: (N,) whether a world has lost constraints or contacts.
    """

    def __init__(self, batch: Batch, standing: Standing, arm_n_m: Float64[Tensor, " n"]) -> None:
        self.batch, self._seen = batch, standing.seen
        batch.go_on_from(standing, arm_n_m.to(batch.gravity.device))
        self.touched, self.postures = [standing.seen.touching], [standing.before]
        self.overflowed = standing.overflowed

    def seen(self) -> Seen:
        """The state now."""
        return self._seen

    def step(self, told: Told, running: Bool[Tensor, " n"]) -> None:
        """Goes on by a tick. Transfers that are over go on too: nobody looks at them."""
        self.batch.step(told)
        self._seen = self.batch.seen()
        self.touched.append(self._seen.touching)
        self.postures.append(self.batch.before.clone())
        self.overflowed = self.overflowed | self.batch.overflowed()


def _model_of(
    models: Models, objects: Sequence[int]
) -> tuple[mujoco.MjModel, dict[int, list[int]]]:
    """The model of the object with most pieces, with the meshes of all objects; the meshes of each."""
    known = models.objects
    widest = max(objects, key=lambda k: len(known[k].pieces))
    spec = transfer_spec(models.robot, known[widest], models.setting)
    # it never resets, and refuses the flag
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    names = {widest: [f"piece_{k}" for k in range(len(known[widest].pieces))]}
    for index in objects:
        if index == widest:
            continue
        names[index] = [f"object_{index}_{k}" for k in range(len(known[index].pieces))]
        for name, (vertices, faces) in zip(names[index], known[index].pieces, strict=True):
            add_mesh(spec, name, vertices.astype(np.float64), faces, convex=True)
    made = spec.compile()
    return made, {index: [made.mesh(n).id for n in own] for index, own in names.items()}
