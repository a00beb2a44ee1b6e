"""Built-in methods in the world that cameras show (r2h_batch.methods.believed, r2h_batch.observe.solid)."""

import gc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from rays_twin import RIG, cell
from rounds import each
from scipy.spatial import ConvexHull, cKDTree

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig
from r2h_batch.methods import believed, contact, fc, handover_va, intent, random, robust
from r2h_batch.methods.believed import AskedHere
from r2h_batch.methods.predictors import predict_contacts, predict_parts
from r2h_batch.observe import believed_object
from r2h_batch.observe.believed_world import ROOM_M
from r2h_batch.observe.seeing import look
from r2h_batch.observe.seen import LABELS
from r2h_batch.observe.sees import Sees
from r2h_batch.observe.solid import _in_hull, completed, levelled
from r2h_batch.scene.objects import build_object
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep.seeing import Looks, SeeingMethod
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import CRITERIA


@cache
def view(noise=1.0, model=None, region="hidden"):
    scene, trials, T = cell()
    return look(scene, trials, RIG, T, noise=noise, model=model, region=region)


@cache
def solid(row, noise=0.0):
    return completed(view(noise), row)


def forget():
    """No answer comes from memory."""
    believed_object.SOLIDS.clear()
    believed.CONTACTS.clear()
    believed.holds_on.cache_clear()
    believed.with_grasps.cache_clear()


def asked(method, benchmark=None, *, shown=("receiving", "target"), **options):
    scene = cell()[0]
    return AskedHere(
        method.predict, shown, {"seed": 0, **options}, benchmark or scene.benchmark, scene.config, noise=1.0, threads=1
    )


def true_surface(row):
    scene, trials, T = cell()
    mesh = scene.objects[int(trials.object_index[row])].mesh
    mesh.apply_transform(T[row].double().numpy())
    return mesh


def test_a_completed_solid_is_closed_and_holds_what_exact_images_show():
    for row in each((0, 3, 4, 5)):
        found = solid(row)
        mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
        assert mesh.is_watertight and mesh.volume > 0 and mesh.body_count == 1
        cloud, mask = view(0.0)[row : row + 1].cloud(1000)
        points = cloud[0][mask[0]].double().numpy()
        surface, _ = trimesh.sample.sample_surface(mesh, 40000, seed=0)
        away, _ = cKDTree(surface).query(points)
        # what was seen is its surface, but for half of the least thickness
        assert np.quantile(away, 0.95) < 0.005
        # and it is no larger than what was seen with its shadow on the table
        true = true_surface(row)
        assert (np.abs(mesh.bounds - true.bounds) < 0.012).all()


def test_nothing_of_a_solid_stands_where_a_camera_looks_through():
    seen = view(0.0)
    for row in each((0, 4)):
        for camera in each(range(2)):
            K, T = (x[row, camera].double() for x in (seen.object.K, seen.T_world_camera))
            local = se3.apply(se3.inverse(T), torch.from_numpy(solid(row).vertices))
            u, v = (local[:, k] / local[:, 2] * K[k, k] + K[k, 2] for k in (0, 1))
            u, v = (x.floor().long().clamp(0, 191) for x in (u, v))
            own = seen.object.label[row, camera] == LABELS.index("object")
            depth = torch.where(own, seen.object.depth_m[row, camera], torch.inf)
            # within 6 pixels: a mask that is too small by one, a shell and a cell are 8 mm
            near = -torch.nn.functional.max_pool2d(-depth[None, None], 13, stride=1, padding=6)[0, 0]
            assert float(near.isfinite()[v, u].float().mean()) > 0.995
            assert float((local[:, 2] > near[v, u] - 0.008).float().mean()) > 0.995


def test_errors_of_calibration_are_taken_out_as_far_as_table_and_object_show_them():
    def apart(views):
        """Median distance of the second camera's points of the object to those of the first."""
        clouds = [v.points() for v in views]
        away, _ = cKDTree(clouds[0]).query(clouds[1], distance_upper_bound=0.02)
        return np.median(away[np.isfinite(away)])

    def tables(views, row):
        """Heights of the table as the cameras see it."""
        shown = [
            replace(
                v, mask=(seen.object.label[row, c] == 1).numpy(), depth_m=seen.object.depth_m[row, c].double().numpy()
            )
            for c, v in enumerate(views)
        ]
        return [np.median(v.points()[:, 2]) for v in shown]

    seen, better, raw_tables = view(), 0, []
    assert LABELS[1] == "table"
    for row in each(range(8)):
        views, table_m = levelled(seen, row)
        raw = [replace(v, T_world_camera=seen.T_world_camera[row, c].double().numpy()) for c, v in enumerate(views)]
        better += apart(views) <= apart(raw) + 1e-4
        assert np.ptp(tables(views, row)) < 3e-4 and np.mean(tables(views, row)) == pytest.approx(table_m, abs=3e-4)
        raw_tables.append(np.ptp(tables(raw, row)))
    assert better >= 6 and np.median(raw_tables) > 1e-3


def test_a_believed_hand_has_the_palm_the_normal_and_the_direction_that_were_seen():
    scene, _, _ = cell()
    known, hands = believed.known_before(scene.benchmark)
    assert len(hands) == 2 and known.listed is None and known.receiver == "hand"
    seen = view()
    world = believed.believed(seen[4:6], known, hands, scene.config, believed.PredictorNoise(), holds=False, seed=0)
    own, trials = world.scene, world.trials
    palm, normal, _ = own.palm(trials.hand_index, trials.T_world_hand)
    assert torch.allclose(palm, seen.receiver.palm[4:6], atol=1e-5)
    assert torch.allclose(normal, seen.receiver.normal[4:6], atol=1e-5)
    along = se3.rotate(trials.T_world_hand[:, :3, :3].double(), own.hands.directions[trials.hand_index.long()][:, :, 0])
    assert torch.allclose(along.float(), seen.receiver.along[4:6], atol=1e-4)
    assert (own.hands.set.side[trials.hand_index.long()] == seen.receiver.left[4:6]).all()
    # frames of its own, no part, no region, and names that say nothing
    for model in each(own.objects):
        assert model.part_names == ("body",) and not model.receiver_face.any() and model.split == "S0"
        assert model.name.startswith("seen_")


@cache
def with_boxes():
    """The benchmark with a box of another size behind each name."""
    benchmark, draw = cell()[0].benchmark, np.random.default_rng(0)
    objects = [
        build_object(trimesh.creation.box(0.03 + 0.05 * draw.random(3)), name=o.name, pieces=False)
        for o in benchmark.objects
    ]
    return replace(benchmark, objects=tuple(objects))


@pytest.mark.parametrize("region", [pytest.param("hidden", marks=pytest.mark.slow), "told"])
def test_other_meshes_behind_the_same_images_move_no_bit_of_the_answers(region, monkeypatch):
    scene, trials, T = cell()
    seen, rows = view(region=region), torch.tensor([4])
    T_world_obj, (of, hand) = T[rows], (x[rows] for x in (trials.object_index, trials.hand_index))
    some = Trials(trials.trial_id[rows], of, hand, trials.T_world_hand[rows], trials.receiver[rows])
    monkeypatch.setattr(Sees, "look", lambda self, scene, trials: (seen[rows], T_world_obj))
    answers = []
    for benchmark in each((scene.benchmark, with_boxes())):
        forget()
        judge = Evaluator(benchmark)
        options = {"seed": 0}
        looks = Looks(Sees.parse("cell-v1"), judge)
        method = SeeingMethod.built_in("fc", fc.predict, ("receiving", "target"), options, looks)
        answers.append(method.predict(some))
    for name in each(("T_obj_ee", "T_world_ee")):
        assert torch.equal(getattr(answers[0], name), getattr(answers[1], name))
    assert (seen.region is None) == (region == "hidden")
    # the test can fail: other images give other answers
    looks = Looks(Sees.parse("cell-v1"), Evaluator(benchmark))
    other = SeeingMethod.built_in("fc", fc.predict, ("receiving", "target"), {"seed": 0}, looks)
    monkeypatch.setattr(Sees, "look", lambda self, scene, trials: (view(0.0)[rows], T_world_obj))
    assert not torch.equal(other.predict(some).T_obj_ee, answers[0].T_obj_ee)


@pytest.mark.parametrize(
    ("method", "shown"),
    [pytest.param(random, (), marks=pytest.mark.whole(part="methods")), (handover_va, ("parts", "target"))],
)
def test_exact_images_of_known_objects_give_the_answers_and_verdicts_of_the_same_objects_and_hands_told(method, shown):
    scene, trials, _ = cell()
    judge, known = Evaluator(scene.benchmark), believed.known_before(scene.benchmark)
    sees = Sees.parse("cell-v1,noise=0,model=known,object=none")
    told = SeeingMethod.built_in(method.__name__, method.predict, shown, {"seed": 0}, Looks(sees, judge)).predict(
        trials
    )
    # told: the same meshes and hands in frames of their own, without a moment and without images
    seen = sees.look(scene, trials)[0]
    own = scene_of_truth(scene, trials, *known)
    receiver = scene.palm(trials.hand_index, trials.T_world_hand)
    side = scene.hands.set.side[trials.hand_index.long()]
    index = torch.tensor(
        [list(dict.fromkeys(trials.object_index.tolist())).index(k) for k in trials.object_index.tolist()]
    )
    hand = torch.tensor([own.hands.set.side.tolist().index(k) for k in side.tolist()])
    T_world_hand = torch.stack([onto(own, h, scene, trials, i) for i, h in enumerate(hand.tolist())])
    truth = Trials(seen.key, index.int(), hand.int(), T_world_hand).named(own.objects)
    more = {"noise": believed.noise_left(0.0)} if method is handover_va else {}
    expected = method.predict(truth, own, seed=0, **more)
    assert torch.allclose(own.palm(truth.hand_index, T_world_hand)[0], receiver[0], atol=1e-6)
    assert (told.T_obj_ee - expected.T_obj_ee).abs().max() < 1e-6
    assert (told.T_world_ee - expected.T_world_ee).abs().max() < 1e-6
    a, b = (judge.score(x.T_obj_ee, x.T_world_ee, trials, stages="pose") for x in (told, expected))
    assert torch.equal(a.passed, b.passed) and torch.equal(a.evaluated, b.evaluated)
    assert 0 < int(a.passed.sum()) < a.passed.numel()


def scene_of_truth(scene, trials, benchmark, hands):
    """The scene's own meshes with candidates sampled anew, one part each, and two hands."""
    objects = []
    for k in dict.fromkeys(trials.object_index.tolist()):
        mesh = scene.objects[k]
        # frames and names decide draws, so names are those of what is known
        v, f = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
        objects.append(believed.with_grasps(believed_object.known_mesh(v.tobytes(), f.tobytes(), b""), benchmark.robot))
    return Scene(
        replace(benchmark, objects=tuple(objects), hand_set=hands), config=replace(scene.config, receiver="hand")
    )


def onto(own, h, scene, trials, i):
    """T_world_hand (4, 4) of a hand whose wrist-to-finger axis, normal and palm are those of the trial's hand."""
    frames = []
    for of, index in ((own, h), (scene, int(trials.hand_index[i]))):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = of.hands.directions[index].double().numpy(), of.hands.palm_point[index].double().numpy()
        frames.append(T)
    T_world = trials.T_world_hand[i].double().numpy()
    return torch.from_numpy(T_world @ frames[1] @ np.linalg.inv(frames[0])).float()


def true_region(row, middles):
    """Whether points (world) are nearest to the receiver's region of the true object."""
    scene, trials, T = cell()
    model = scene.objects[int(trials.object_index[row])]
    own = (np.linalg.inv(T[row].double().numpy()) @ np.vstack([middles.T, np.ones(len(middles))]))[:3].T
    _, nearest = cKDTree(model.points).query(own)
    return model.receiver_face[model.point_face[nearest]]


def test_a_believed_object_has_the_told_region_and_no_other_part():
    scene, _, _ = cell()
    known, hands = believed.known_before(scene.benchmark)
    rows = [0, 4, 5, 7]  # of S0, and three of S1
    for model, least in each(((None, 0.85), ("lab", 0.85), ("none", 0.85))):
        seen = view(1.0, model, "told")[torch.tensor(rows)]
        world = believed.believed(seen, known, hands, scene.config, believed.noise_left(1.0), holds=False, seed=0)
        assert world.row.tolist() == list(range(len(rows)))
        objects = [world.scene.objects[i] for i in world.trials.object_index.tolist()]
        for k, (row, own) in each(enumerate(zip(rows, objects, strict=True))):
            if row < 4:
                assert own.split == "S0" and own.part_names == ("body",) and not own.receiver_face.any()
                continue
            assert own.split == "S1" and own.part_names == ("body", "region")
            assert np.array_equal(own.face_part == 1, own.receiver_face) and own.roles is None and own.words is None
            T = world.T_world_obj[k].numpy()
            middles = own.vertices[own.faces].mean(1) @ T[:3, :3].T + T[:3, 3]
            right = own.receiver_face == true_region(row, middles)
            assert right.mean() > least, (model, row)
            # the methods are shown this region, and no border is misplaced again
            trial = world.trials[torch.tensor([k])]
            shown = predict_parts(trial, world.scene, noise=believed.noise_left(1.0)).usage[0].numpy()
            assert np.array_equal(shown, own.receiver_face[own.point_face])
            # the gripper finds places off the region
            assert len(own.grasps) > 20


@pytest.mark.whole(part="methods")
def test_a_told_region_moves_answers_of_its_own_trials_alone():
    method = asked(robust, shown=(), draws=0)
    hidden, told = (method.ask(view(region=r)[torch.tensor([1, 3, 4, 5])]) for r in ("hidden", "told"))
    for a, b in each(zip(hidden[:2], told[:2], strict=True)):
        assert torch.equal(a[:2], b[:2])
        assert not torch.equal(a[2], b[2]) and not torch.equal(a[3], b[3])


@pytest.mark.whole(part="methods")
def test_with_a_told_region_the_search_leaves_it_to_the_receiver():
    scene, trials, T = cell()
    rows = torch.arange(4, 8)
    judge, failed = Evaluator(scene.benchmark), {}
    for region in each(("hidden", "told")):
        grasp, handover, _ = asked(robust, shown=(), draws=0).ask(view(0.0, None, region)[rows])
        T_obj_ee = se3.matmul(se3.inverse(T[rows].double()), grasp).float()
        scores = judge.score(T_obj_ee, handover.float(), trials[rows], stages="pose")
        passed = scores.passed[:, CRITERIA.index("affordance")]
        failed[region] = int((scores.evaluated[:, CRITERIA.index("affordance")] & ~passed).sum())
    assert failed["told"] == 0 < failed["hidden"]


def test_a_region_that_is_nowhere_or_everywhere_is_none():
    rows = torch.tensor([4, 5])
    told = view(region="told")[rows]
    hidden = asked(random, shown=()).ask(view()[rows])
    everywhere = (told.object.label == LABELS.index("object")) & (told.object.depth_m > 0)
    for region in each((torch.zeros_like(everywhere), everywhere)):
        forget()
        for a, b in each(zip(hidden[:2], asked(random, shown=()).ask(replace(told, region=region))[:2], strict=True)):
            assert torch.equal(a, b)


@pytest.mark.parametrize(
    "region",
    [pytest.param("hidden", marks=pytest.mark.slow), pytest.param("told", marks=pytest.mark.whole(part="methods"))],
)
def test_answers_have_the_same_bits_alone_and_in_any_order(region):
    method = asked(fc)
    seen = view(region=region)
    together = method.ask(seen[torch.tensor([3, 4, 5])])
    for k, row in each([(2, 5)] if region == "told" else enumerate((3, 4, 5))):
        forget()
        alone = method.ask(seen[torch.tensor([row])])
        for a, b in each(zip(together[:2], alone[:2], strict=True)):
            assert torch.equal(a[k], b[0])


def test_where_nothing_was_seen_the_gripper_comes_straight_down_and_others_are_answered_all_the_same():
    seen = view()[torch.tensor([3, 4])]
    label = seen.object.label.clone()
    label[0] = LABELS.index("table")
    blind = replace(seen, object=replace(seen.object, label=label))
    grasp, handover, _ = asked(handover_va, shown=("parts", "target")).ask(blind)
    assert torch.equal(grasp[0, :3, :3], torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))
    assert bool(torch.isfinite(grasp).all()) and bool(torch.isfinite(handover).all())
    clear = asked(handover_va, shown=("parts", "target")).ask(seen)
    assert torch.equal(clear[0][1], grasp[1]) and not torch.equal(clear[0][0], grasp[0])


def test_known_objects_lie_where_they_are_believed_to_and_are_their_own_mesh():
    scene, trials, _ = cell()
    known, hands = believed.known_before(scene.benchmark)
    seen = view(model="lab")[3:5]
    world = believed.believed(seen, known, hands, scene.config, believed.PredictorNoise(), holds=False, seed=0)
    assert torch.equal(world.T_world_obj.float(), seen.known.T_world_obj)
    for k, model in each(enumerate(world.scene.objects[i] for i in world.trials.object_index.tolist())):
        true = scene.objects[int(trials.object_index[3 + k])]
        assert model.vertices.min(0) == pytest.approx(true.vertices.min(0), abs=1e-6)
        assert len(model.grasps) > 20 and model.name.startswith("known_")


def test_a_benchmark_without_names_is_believed_of_every_protocol():
    for name in each(("r2h-v0", "r2h-v1", "r2h-release")):
        known, hands = believed.known_before(load_benchmark(name))
        assert known.listed is None and sorted(set(hands.side.tolist())) == sorted(hands.side.tolist())


def test_a_kept_solid_is_that_of_the_trials_own_images():
    seen, robot = view()[:1], cell()[0].robot
    other = replace(seen, key=seen.key + 1)  # another image of the hand, say: the object's are the same
    forget()
    alone, _ = believed._object(other, 0, robot)
    forget()
    first, _ = believed._object(seen, 0, robot)
    after, _ = believed._object(other, 0, robot)
    assert after.name == alone.name != first.name and len(believed_object.SOLIDS) == 2


def test_a_told_region_makes_another_solid_only_where_it_is():
    forget()
    hidden, told = view(), view(region="told")
    for row in each((0, 4)):  # of S0 and of S1
        assert bool(told.region[row].any()) == (row == 4)
        alike = believed._object(hidden, row, cell()[0].robot)[0] is believed._object(told, row, cell()[0].robot)[0]
        assert alike == (row == 0)


@pytest.mark.whole(part="methods")
def test_contacts_are_those_of_the_network_and_each_surface_is_asked_once(monkeypatch):
    scene, known = cell()[0], believed.known_before(cell()[0].benchmark)
    forget()
    found, calls = [], []
    network = believed.contacts_of_any
    monkeypatch.setattr(believed, "contacts_of_any", lambda grid: calls.append(1) or network(grid))
    for region in each(("hidden", "told")):
        seen = view(region=region)[4:6]
        world = believed.believed(seen, *known, scene.config, believed.noise_left(1.0), holds=False, seed=0)
        shown = asked(contact, shown=("receiving", "target", "contacts"))._arguments(world)["seen"]
        found.append(shown.contacts.of(world.trials)["probability"])
    assert len(calls) == 2  # the regions differ, the surfaces do not
    expected = predict_contacts(world.trials, world.scene, predictor=network)
    assert torch.equal(found[0], expected) and torch.equal(found[1], expected)
    assert expected.std() > 0.05 and not torch.equal(expected[0], expected[1])


def test_nodes_are_in_the_hull_of_a_cloud_and_its_shadow_as_every_plane_says():
    rng = np.random.default_rng(3)
    for n in each((4, 40, 3000)):
        points = rng.normal(0, 0.05, (n, 3)) + [0.3, 0.2, 0.2]
        axes = [np.linspace(low, high, 24) for low, high in zip(points.min(0), points.max(0), strict=True)]
        axes[2] = np.append(axes[2], 0.05)  # on the table, where the shadow is
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        hull = ConvexHull(np.concatenate([points, points * [1, 1, 0] + [0, 0, 0.05]]))
        # on a plane, as far as float64 tells: there the order of a sum decides
        slanted = np.abs(hull.equations[:, 2]) > 0.1
        a, b, c, d = np.round(hull.equations[slanted], 9).T
        corners = hull.points[hull.simplices[slanted]]
        on = [np.tensordot(w, corners, (0, 1)) for w in rng.dirichlet((1, 1, 1), 20)]
        for middle in on:
            middle[:, 2] = -(a * middle[:, 0] + b * middle[:, 1] + d) / c
        nodes = np.concatenate([grid, points, points * [1, 1, 0] + [0, 0, 0.05], *on])
        x, y, z = nodes.T
        expected = np.ones(len(nodes), bool)
        for a, b, c, d in np.round(hull.equations, 9):
            expected &= a * x + b * y + c * z + d <= 0
        assert np.array_equal(_in_hull(points, 0.05, nodes), expected)
        assert 0 < expected.sum() < len(nodes)


@pytest.mark.whole(part="methods")
def test_meshes_that_a_solid_was_built_of_do_not_pile_up(monkeypatch):
    def alive():
        return sum(type(x) is trimesh.Trimesh for x in gc.get_objects())

    monkeypatch.setattr(believed_object, "GARBAGE_AFTER", 1)
    forget()
    gc.collect()
    before = alive()
    gc.disable()
    try:
        asked(random, shown=()).ask(view()[:3])
        after = alive()
    finally:
        gc.enable()
    assert len(believed_object.SOLIDS) == 3
    # the last one was in hand when it was looked for
    assert after <= before + 1, (before, after)


@pytest.mark.whole(part="methods")
def test_scenes_that_batches_were_answered_in_are_let_go():
    """Each has tables and meshes of all objects of its batch, 1 MB an object."""
    methods = [asked(m) for m in (fc, contact, handover_va, intent)] + [asked(random, shown=())]

    def alive(batches):
        for _ in range(batches):
            for method in methods:
                method.ask(view(region="told")[:1])
        gc.collect()
        return sum(type(x) is Scene for x in gc.get_objects())

    settled = alive(1)
    assert alive(3) <= settled


@pytest.mark.parametrize(("threads", "torch_has"), [(1, 1), (None, 2)])
def test_networks_of_methods_that_see_work_on_the_threads_of_the_sweep(threads, torch_has):
    def asks(trials, scene):
        counted.append(torch.get_num_threads())
        return Predictions(trials.trial_id, *(torch.eye(4).repeat(len(trials), 1, 1) for _ in range(2)))

    counted, before = [], torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        asked_here = AskedHere(asks, (), {}, cell()[0].benchmark, EvalConfig(), noise=1.0, threads=threads)
        asked_here.ask(view()[:1])
    finally:
        torch.set_num_threads(before)
    assert counted == [torch_has]


def test_methods_keep_the_room_that_planning_keeps_where_a_trial_begins_on_the_table():
    for name, room in each((("r2h-v2", 0.0), ("r2h-v3", ROOM_M))):
        benchmark = load_benchmark(name)
        given = []

        def asks(trials, scene, *, evaluator, given=given):
            given.append((scene.hand_room_m, evaluator.scene.hand_room_m, evaluator.scene is scene))
            return Predictions(trials.trial_id, *(torch.eye(4).repeat(len(trials), 1, 1) for _ in range(2)))

        AskedHere(asks, (), {}, benchmark, EvalConfig(), noise=1.0).ask(view()[:1])
        assert given == [(room, room, True)]
