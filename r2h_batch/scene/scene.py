"""Robot, gripper, hands, objects and table as tables on a device: what every stage's kernels
read."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Protocol, SupportsIndex, TypeVar

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import init_warp, over_trials
from r2h_batch.base.launch.arguments import struct_of
from r2h_batch.base.launch.instances import Compiled, of_joints
from r2h_batch.base.summary import counted
from r2h_batch.base.table import of_lines
from r2h_batch.base.validate import describe_value, instance_of, integer, optional, sequence_of
from r2h_batch.base.validate_tensors import check_indices, check_tensor, checked_device
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.robot.place import place_bodies
from r2h_batch.kernels.robot.tool import Tool
from r2h_batch.kernels.robot.world import TrialBodies, World
from r2h_batch.scene.grasp_tables import (
    GraspTables,
    Regions,
    grasp_tables,
    gripper_tables,
    surfaces_on,
)
from r2h_batch.scene.hand import HandSet
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.tables import Hands, WorldTables

if TYPE_CHECKING:  # it brings MuJoCo (0.2 s), which only simulations and pictures need
    from r2h_batch.scene.model import SceneModel

PLACED = (
    "R_hand_world",
    "p_hand_world",
    "R_wrist_grip",
    "p_wrist_grip",
    "R_wrist_obj",
    "p_wrist_obj",
    "motion_radius",
)
"""Rows that `body_poses` writes for each trial, in the order of `BodyPoses.owners` behind object
and hand."""


class Setup(Protocol):
    """What this room reads of a benchmark (`trials.benchmark.Benchmark`), which stands above it."""

    @property
    def objects(self) -> tuple[ObjectModel, ...]: ...
    @property
    def hand_set(self) -> HandSet: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def head_clearance_m(self) -> float: ...
    def config(self, base: EvalConfig | None = None) -> EvalConfig: ...


B = TypeVar("B", bound=Setup)


class Scene(Generic[B]):
    """Everything that stays the same over trials. `objects` and `hands` are indexed by
    `Trials.object_index, hand_index`.

    Args:
        benchmark: its objects, hands, robot, limits and workplace.
        device: `cpu`, `cuda` or `cuda:N`.
        config: planning and motion; None: the default preset.
        hand_room_m: planning keeps this far from hands and persons, m: where it does not know how they stand.

    Attributes:
        benchmark: whose objects, hands, robot and limits these are.
        objects: the objects (`ObjectModel`), by `Trials.object_index`.
        hands: the posed hands (`Hands`), by `Trials.hand_index`.
        robot: the arm and its gripper (`Robot`).
        config: all settings (`EvalConfig`); `config.workplace` holds home and table, `config.thresholds` the limits.
        device: where its tensors are.
    """

    def __init__(
        self,
        benchmark: B,
        device: str | torch.device = "cpu",
        *,
        config: EvalConfig | None = None,
        hand_room_m: float = 0.0,
    ) -> None:
        self.hand_room_m = hand_room_m
        self.device = checked_device(device)
        optional(instance_of(EvalConfig, "EvalConfig() or EvalConfig.preset(NAME)"))(
            "config", config
        )
        if not isinstance(getattr(benchmark, "hand_set", None), HandSet):  # its class stands above
            how = "it must be a Benchmark: load_benchmark(NAME or FILE)"
            raise TypeError(f"benchmark is {describe_value(benchmark)}; {how}")
        self.config = benchmark.config(config)
        init_warp()
        self.benchmark, self.robot, self.objects = benchmark, benchmark.robot, benchmark.objects
        home, joints = self.config.workplace.home_q, len(self.robot.joints)
        if len(home) != joints:
            raise ValueError(
                f"workplace.home_q is {home}; {self.robot.name} needs {joints} joint angles in rad"
            )
        for i, (q, low, high) in enumerate(
            zip(home, self.robot.lower, self.robot.upper, strict=True)
        ):
            if not low <= q <= high:
                raise ValueError(
                    f"workplace.home_q[{i}] is {q}; the joint goes from {low:.4f} to {high:.4f} rad"
                )
        self.hands = Hands.posed(benchmark.hand_set)
        if self.device != "cpu":
            self._build_tables()

    def _build_tables(self) -> None:
        """Every table now, and there before this returns.

        They are written on Warp's stream. Built at first use, a kernel on another stream (a
        graph's, while it is captured) could read them before they are there, and memory would be
        asked for while a graph is captured.
        """
        for name, value in vars(type(self)).items():
            if isinstance(value, cached_property):
                getattr(self, name)
        gripper_tables(self.robot, self.device)
        wp.synchronize_device(self.device)

    @property
    def about(self) -> str:
        """Device, objects and hands in a few words."""
        splits = Counter(o.split for o in self.objects)
        kinds = ", ".join(f"{n} of {s}" for s, n in sorted(splits.items()))
        return f"{self.device}, {counted(len(self.objects), 'object')} ({kinds}), {counted(len(self.hands.set), 'hand')}"

    def __repr__(self) -> str:
        return f"Scene({self.about})"

    def _repr_html_(self) -> str:
        rows = [(str(i), o.name, o.split, o.instruction) for i, o in enumerate(self.objects)]
        head = ("index", "object", "split", "instruction")
        return of_lines(head, rows, title=repr(self)).html()

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuilt from benchmark and configuration: tables on a device do not travel."""
        return _scene_of, (self.benchmark, self.device, self.config, self.hand_room_m)

    def __copy__(self) -> "Scene[B]":
        """Itself: a scene does not change."""
        return self

    def __deepcopy__(self, memo: Any) -> "Scene[B]":
        """Itself: a scene does not change."""
        return self

    def sized(self, thing: Compiled) -> Compiled:
        """A kernel or struct of the kernels, as it is for the robot's number of joints.

        Args:
            thing: imported from `r2h_batch.kernels`, which has six joints.
        """
        return of_joints(thing, len(self.robot.joints))

    @property
    def part_names(self) -> tuple[str, ...]:
        """Names of the robot's bodies as numbered in `Scores.witness_part`; the last is the
        attached object."""
        arm = [self.robot.arm.names[i] for i in self.tables.arm_order]
        return (*arm, *self.robot.gripper.names, "object")

    @cached_property
    def T_wrist_ee(self) -> NDArray[np.float64]:
        """ee in the wrist_3 frame, float64."""
        return np.asarray(self.robot.T_wrist3_flange @ self.robot.T_flange_ee)

    @cached_property
    def tool(self) -> Any:
        """The `Tool` of r2h_batch.kernels.robot.tool."""
        tool = self.sized(Tool)()
        tool.joint_R, tool.joint_p = self.world.joint_R, self.world.joint_p
        tool.R_wrist_ee, tool.p_wrist_ee = self._wrist_ee
        return tool

    @cached_property
    def _wrist_ee(self) -> tuple[Any, Any]:
        """`T_wrist_ee` as kernels take it: R (mat33) and p (vec3)."""
        T = self.T_wrist_ee.astype(np.float32)
        return wp.mat33(*T[:3, :3].ravel()), wp.vec3(*T[:3, 3])

    def model(self, hand_indices: Iterable[int], execute: ExecConfig | None = None) -> "SceneModel":
        """The scene as one MuJoCo model, which takes any trial with one of these hands: what is simulated
        and rendered.

        Args:
            hand_indices: rows of the hand set.
            execute: engine's settings; None: those of the configuration.
        """
        from r2h_batch.scene.model import scene_model

        hands = sequence_of(SupportsIndex, "numbers of hands", least=0)(
            "hand_indices", tuple(_listed(hand_indices))
        )
        hand_indices = [
            integer(0, len(self.hands.set) - 1)(f"hand_indices[{i}]", h)
            for i, h in enumerate(hands)
        ]
        optional(instance_of(ExecConfig))("execute", execute)
        execute = execute or self.config.execute
        return scene_model(
            self.robot, self.objects, self.hands, hand_indices, step_s=execute.step_s, full=execute.model != "arm",
            payload_known=execute.payload == "known", object_collision=self.config.plan.object_collision,
            workplace=self.config.workplace,
        )  # fmt: skip

    @cached_property
    def tables(self) -> WorldTables:
        """Shapes and bounds of everything that planning checks, on the host."""
        return WorldTables(
            self.robot,
            self.hands,
            self.objects,
            self.config.plan.object_collision,
            self.config.workplace,
            self.hand_room_m,
        )

    @cached_property
    def motion_radii(self) -> Tensor:
        """(n_robot, 6) bounds in m on the distance of each robot body's points from each joint's
        axis."""
        return torch.from_numpy(self.tables.motion_radii)

    @cached_property
    def world(self) -> Any:
        """The `World` of r2h_batch.kernels.robot.world, on the scene's device."""
        return self.tables.world(self.device)

    @cached_property
    def world_without_hand(self) -> Any:
        """The same with a hand of no pieces, too far away to matter: whom only robot, object and
        table concern."""
        world: Any = self.sized(World)()
        world.assign(self.world)  # its arrays are shared
        n = len(self.hands.set)
        world.n_pieces = 0
        world.hand_center = wp.full(n, wp.vec3(1e3, 0.0, 0.0), dtype=wp.vec3, device=self.device)
        world.hand_radius = wp.zeros(n, dtype=wp.float32, device=self.device)
        return world

    @cached_property
    def world_of_robot(self) -> Any:
        """The same with the bare robot: no table, no object, no pairs of the robot with itself."""
        world: Any = self.sized(World)()
        world.assign(self.world)
        world.table_from = world.n_robot
        for name in ("self_links", "hull_first"):
            n = getattr(world, name).shape[0]
            setattr(world, name, wp.zeros(n, dtype=wp.int32, device=self.device))
        return world

    @cached_property
    def world_of_gripper(self) -> Any:
        """The same with the empty gripper alone: no links before it, no object, no pairs of the robot with itself."""
        world: Any = self.sized(World)()
        world.assign(self.world)
        first = world.link_first.numpy().copy()
        first[:-1] = first[-2]
        world.link_first = wp.array(first, dtype=wp.int32, device=self.device)
        for name in ("self_links", "hull_first"):
            n = getattr(world, name).shape[0]
            setattr(world, name, wp.zeros(n, dtype=wp.int32, device=self.device))
        return world

    @cached_property
    def hull_balls(self) -> wp.array:
        """For each object hull the centre (object frame) and the radius of the largest ball inside
        it."""
        return wp.array(self.tables.hull_balls, dtype=wp.vec4, device=self.device)

    @cached_property
    def grasp_tables(self) -> GraspTables:
        """Object surfaces, receiver regions and the gripper, for grasp.py."""
        return grasp_tables(self.objects, self.robot, self.device)

    def _mesh(self, vertices: Any, faces: Any) -> wp.Mesh:
        """A mesh for Warp's queries."""
        return wp.Mesh(
            points=wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=self.device),
            indices=wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device=self.device),
        )

    @cached_property
    def _object_meshes(self) -> list[wp.Mesh]:
        return [self._mesh(o.vertices, o.faces) for o in self.objects]

    @cached_property
    def _hull_meshes(self) -> list[wp.Mesh]:
        return [self._mesh(o.hull_vertices, o.hull_faces) for o in self.objects]

    @cached_property
    def _region_meshes(self) -> list[wp.Mesh | None]:
        return self._meshes_of([o.receiver_face for o in self.objects])

    @cached_property
    def _sharp_meshes(self) -> list[wp.Mesh | None]:
        return self._meshes_of([o.sharp_face for o in self.objects])

    def _meshes_of(self, chosen: list[NDArray[np.bool_]]) -> list[wp.Mesh | None]:
        """The chosen faces of each object; None where there are none."""
        return [
            self._mesh(o.vertices, o.faces[faces]) if faces.any() else None
            for o, faces in zip(self.objects, chosen, strict=True)
        ]

    def _mesh_ids(self, meshes: list[wp.Mesh | None]) -> wp.array:
        ids = [0 if m is None else m.id for m in meshes]
        return wp.array(ids, dtype=wp.uint64, device=self.device)

    @cached_property
    def reach_surfaces(self) -> Surfaces:
        """The surfaces that Reach measures: the objects', or their hulls'."""
        if self.config.reach == "solid":
            return self.grasp_tables.surfaces
        hulls = [o.hull_vertices[o.hull_faces] for o in self.objects]
        return surfaces_on(self.device, hulls, [True] * len(hulls))

    @cached_property
    def reach_mesh_ids(self) -> wp.array:
        """Handles of the same triangles as meshes, for Warp's mesh queries."""
        if self.config.reach == "solid":
            return self.object_mesh_ids
        return wp.array([m.id for m in self._hull_meshes], dtype=wp.uint64, device=self.device)

    @cached_property
    def object_mesh_ids(self) -> wp.array:
        """Handles of the objects' meshes for Warp's mesh queries."""
        return wp.array([m.id for m in self._object_meshes], dtype=wp.uint64, device=self.device)

    @cached_property
    def regions(self) -> Regions:
        """The receivers' regions, as faces of their objects."""
        offset = len(self.objects)
        surfaces = self.grasp_tables.surfaces
        corners = [o.vertices[o.faces[o.receiver_face]] for o in self.objects]
        if self.grasp_tables.volumes:  # its regions are boxes
            surfaces, offset = surfaces_on(self.device, corners, [False] * len(corners)), 0
        return Regions(surfaces, offset, self._mesh_ids(self._region_meshes))

    @cached_property
    def sharp(self) -> Regions:
        """The objects' sharp parts."""
        corners = [o.vertices[o.faces[o.sharp_face]] for o in self.objects]
        surfaces = surfaces_on(self.device, corners, [False] * len(corners))
        return Regions(surfaces, 0, self._mesh_ids(self._sharp_meshes))

    @cached_property
    def openings(self) -> wp.array:
        """Unit vectors towards the openings of vessels, each in its object's frame; zero for other objects."""
        up = [np.zeros(3) if o.up is None else o.up for o in self.objects]
        return wp.array(np.array(up, np.float32), dtype=wp.vec3, device=self.device)

    @cached_property
    def surface_points(self) -> tuple[Float32[Tensor, "o p 3"], dict[str, Bool[Tensor, "o p"]]]:
        """Points on the objects' surfaces, each in its object's frame, m; and part -> which of them are of it: `object`: all,
        `wanted`: the receiver's region in S1 and all in S0, `sharp`."""
        of_part: dict[str, list[NDArray[np.bool_]]] = {"object": [], "wanted": [], "sharp": []}
        for o in self.objects:
            every = np.ones(len(o.faces), bool)
            wanted = o.receiver_face if o.split == "S1" else every
            for part, faces in (("object", every), ("wanted", wanted), ("sharp", o.sharp_face)):
                of_part[part].append(np.asarray(faces)[o.point_face])
        local = torch.from_numpy(np.stack([o.points for o in self.objects]))
        masks = {
            part: torch.from_numpy(np.stack(of)).to(self.device) for part, of in of_part.items()
        }
        return local.to(self.device), masks

    @cached_property
    def hand_mesh(self) -> Any:
        """The exact hand surfaces (r2h_batch.kernels.geometry.hand_mesh), faces grouped by the
        piece that encloses them."""
        faces, first, ball = self.hands.faces
        vertices = self.hands.vertices.numpy()
        mesh = HandMesh()
        mesh.n_vertices, mesh.n_faces = vertices.shape[1], len(faces)
        mesh.vertices = wp.array(vertices.reshape(-1, 3), dtype=wp.vec3, device=self.device)
        mesh.faces = wp.array(faces, dtype=wp.int32, device=self.device)
        mesh.piece_face = wp.array(first, dtype=wp.int32, device=self.device)
        mesh.face_ball = wp.array(ball.reshape(-1, 4), dtype=wp.vec4, device=self.device)
        return mesh

    @cached_property
    def palms(self) -> tuple[Tensor, Tensor]:
        """Palm points and normals (H, 3) of the hands, each in its hand's frame."""
        return self.hands.palm_point.to(self.device), self.hands.palm_normal.to(self.device)

    def palm(
        self, hand_index: Tensor, T_world_hand: Float32[Tensor, "n 4 4"]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Palm point p_h, palm normal n_h and ball centre c_h in the world (paper: c_h = p_h + d_h
        n_h).

        Args:
            hand_index: (n,) rows of the hand set.
            T_world_hand: (n, 4, 4) float32, hand to world, m.

        Returns:
            Three tensors (n, 3); points in m.

        Raises:
            TypeError, ValueError: shape or dtype do not fit, or (on a CPU) an index is no hand of
                the scene.
        """
        words = "a torch tensor (n, 4, 4) of torch.float32"
        T_world_hand = check_tensor("T_world_hand", T_world_hand, words)
        if (
            T_world_hand.ndim != 3
            or T_world_hand.shape[1:] != (4, 4)
            or T_world_hand.dtype != torch.float32
        ):
            raise ValueError(
                f"T_world_hand is {T_world_hand.dtype} {tuple(T_world_hand.shape)}; it must be torch.float32 (n, 4, 4)"
            )
        check_indices("hand_index", hand_index, len(T_world_hand), len(self.hands.set), "the scene")
        point, normal = self.palms
        i = hand_index.long()
        p = se3.apply(T_world_hand, point[i])
        turn = T_world_hand.clone()
        turn[..., :3, 3] = 0.0
        n = se3.apply(turn, normal[i])
        return p, n, p + self.config.thresholds.reach_offset_m * n

    def body_poses(
        self,
        object_index: Tensor,
        hand_index: Tensor,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        T_world_hand: Float32[Tensor, "b 4 4"],
        opening_m: Float32[Tensor, " b"],
    ) -> "BodyPoses":
        """Bodies of B trials: hand in the world, fingers at their opening, object attached.

        Args:
            object_index: (B,) int32.
            hand_index: (B,) int32.
            T_obj_ee: (B, 4, 4) float32, the grasp after closing moved the object, m.
            T_world_hand: (B, 4, 4) float32, m.
            opening_m: (B,) float32, gap between the pads.
        """
        b, gripper = len(object_index), gripper_tables(self.robot, self.device)
        grip = gripper.kind.shape[0]
        sizes = {
            "R_wrist_grip": grip,
            "p_wrist_grip": grip,
            "motion_radius": len(self.robot.joints),
        }
        objects = object_index.to(torch.int32).contiguous()
        hands = hand_index.to(torch.int32).contiguous()
        out = over_trials(self.sized(place_bodies), b, self.device, sizes=sizes, chunk=256)(
            world=self.world,
            gripper=gripper,
            R_wrist_ee=self._wrist_ee[0],
            p_wrist_ee=self._wrist_ee[1],
            object=objects,
            T_obj_ee=T_obj_ee.contiguous(),
            T_world_hand=T_world_hand.contiguous(),
            opening=opening_m.contiguous(),
        )
        placed = (out[name] for name in PLACED)
        return self._of_owners(objects, hands, *placed, T_world_hand, opening_m)

    def reopened(
        self,
        body_poses: "BodyPoses",
        rows: Tensor,
        opening_m: Float32[Tensor, " r"],
    ) -> "BodyPoses":
        """Some rows of bodies, with the fingers at another opening; the object stays in the wrist's frame.

        Args:
            body_poses: bodies that index the scene's tables.
            rows: (R,) int64, rows of them.
            opening_m: (R,) float32, gap between the pads.
        """
        tensors = tuple(x[rows] for x in body_poses.owners)
        T = torch.eye(4, dtype=torch.float32, device=opening_m.device).repeat(len(opening_m), 1, 1)
        moved = self.body_poses(tensors[0], tensors[1], T, tensors[9], opening_m).owners
        return self._of_owners(*tensors[:4], *moved[4:6], *tensors[6:10], moved[10])

    def _of_owners(self, *owners: Tensor) -> "BodyPoses":
        """Objects, hands, `PLACED`, T_world_hand and opening as `BodyPoses`."""
        names = ("object", "hand", *PLACED[:-1], "object_motion_radius")
        bodies = struct_of(self.sized(TrialBodies), dict(zip(names, owners, strict=False)))
        return BodyPoses(bodies, *owners)


def _scene_of(benchmark: B, device: str, config: EvalConfig, hand_room_m: float) -> Scene[B]:
    """The scene that was pickled."""
    return Scene(benchmark, device, config=config, hand_room_m=hand_room_m)


def _listed(indices: object) -> Iterable[Any]:
    if (
        isinstance(indices, (str, bytes))
        or not isinstance(indices, Iterable)
        or getattr(indices, "ndim", 1) != 1
    ):
        raise TypeError(
            f"hand_indices is {describe_value(indices)}; it must be whole numbers, of the scene's hands"
        )
    return indices


@dataclass(frozen=True)
class BodyPoses:
    """Where the bodies of B trials sit: the kernels' struct, and the tensors that own its
    memory."""

    bodies: Any
    object_index: Int32[Tensor, " b"]
    hand_index: Int32[Tensor, " b"]
    R_hand_world: Float32[Tensor, "b 3 3"]
    p_hand_world: Float32[Tensor, "b 3"]
    R_wrist_grip: Float32[Tensor, "b g 3 3"]  # the gripper's primitives in the wrist_3 frame
    p_wrist_grip: Float32[Tensor, "b g 3"]
    R_wrist_obj: Float32[Tensor, "b 3 3"]  # the object there
    p_wrist_obj: Float32[Tensor, "b 3"]
    object_motion_radius: Float32[Tensor, "b 6"]  # bounds, m: its points from each joint's axis
    T_world_hand: Float32[Tensor, "b 4 4"]
    opening_m: Float32[Tensor, " b"]
    world: Any = field(default=None, kw_only=True)
    """the tables that `bodies` index where they are not the scene's (person.py)"""

    @property
    def owners(self) -> tuple[Tensor, ...]:
        """The tensors, in order."""
        return tuple(getattr(self, f.name) for f in fields(self)[1:-1])

    def tables(self, scene: Scene) -> Any:
        """The `World` that `bodies` index."""
        return scene.world if self.world is None else self.world
