"""Moments, depth and labels (r2h_batch.observe) against float64 NumPy that knows nothing of Warp."""

from functools import cache

import numpy as np
import pytest
import torch
from rays_twin import RIG, cell, depth_of_bodies, expected, robot_of_mujoco, triangles
from rounds import each
from scipy.spatial import cKDTree

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base.errors import UserError
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import Workplace
from r2h_batch.observe import LABELS, load_rig, look, moments, observe, whole_images
from r2h_batch.observe.moment import (
    PLACE_X,
    PLACE_Y,
    TOUCH_M,
    region_scale,
    resting_rotation,
)
from r2h_batch.observe.rays import FAR_M, Bodies, bodies_of
from r2h_batch.observe.rig import CELL_V1
from r2h_batch.observe.robot_mesh import robot_at_home
from r2h_batch.observe.seen import packed
from r2h_batch.observe.windows import middles, window_corners
from r2h_batch.scene import load_robot
from r2h_batch.scene.person import heads_of
from r2h_batch.types import Trials


@cache
def seen():
    return look(*cell()[:2], RIG, cell()[2], noise=0)


@pytest.mark.parametrize("which", ["object", "hand"])
def test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes(which):
    scene, trials, T = cell()
    images = getattr(seen(), which)
    drawn = np.random.default_rng(0)
    side, wrong, labels = images.depth_m.shape[-1], 0, set()
    cameras = RIG.T_world_camera.double().numpy()
    for _ in each(range(60)):
        i, c = drawn.integers(len(trials)), drawn.integers(2)
        u, v = (int(x) for x in drawn.integers(side // 4, 3 * side // 4, 2))
        depth, label = expected(scene, trials, T, i, images.K[i, c].double().numpy(), cameras[c], u, v)
        labels.add(label)
        found = float(images.depth_m[i, c, v, u]), int(images.label[i, c, v, u])
        if found[1] != label:  # a silhouette
            assert label in images.label[i, c, v - 1 : v + 2, u - 1 : u + 2]
            wrong += 1
            continue
        assert found[0] == pytest.approx(depth, abs=5e-6)
    assert wrong <= 1
    assert LABELS.index(which) in labels and len(labels) >= 3


def test_whole_images_show_table_robot_and_person_where_float64_rays_do():
    scene, trials, T = cell()
    depth, label = whole_images(scene, trials, RIG, T)
    K = np.array([[RIG.focal_px, 0, 640], [0, RIG.focal_px, 360], [0, 0, 1]])
    drawn, wrong, labels = np.random.default_rng(1), 0, set()
    cameras = RIG.T_world_camera.double().numpy()
    for _ in each(range(60)):
        i, c, u, v = (int(drawn.integers(n)) for n in (len(trials), 2, 160, 90))
        # the middle of a block of eight pixels
        z, shows = expected(scene, trials, T, i, K, cameras[c], 8 * u + 3.5, 8 * v + 3.5)
        labels.add(shows)
        wrong += shows != int(label[i, c, v, u])
        if shows == int(label[i, c, v, u]):
            assert float(depth[i, c, v, u]) == pytest.approx(z, abs=5e-6)
    assert wrong <= 2
    assert {LABELS.index(k) for k in ("table", "robot", "torso")} <= labels


def people_of_any_size(n, middle, drawn):
    """`Trials.receiver` (n, 5, 4): torsos below a place, and arms that begin near it and point anywhere; the first forearms
    are balls."""

    def away(low, high):
        v = drawn.normal(size=(n, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True) * drawn.uniform(low, high, (n, 1))

    found = np.ones((n, 5, 4), np.float32)
    found[:, 0, :3] = middle + drawn.uniform(-0.1, 0.1, (n, 3))
    found[:, 1, :3] = found[:, 0, :3] + away(0.15, 0.35)
    found[:, 2, :3] = found[:, 1, :3] + away(0.15, 0.3) * (np.arange(n) >= n // 2)[:, None]
    found[:, :2, 3] = drawn.uniform(0.05, 0.12, (n, 2))
    turn = drawn.uniform(-np.pi, np.pi, n)
    found[:, 3, :3], found[:, 3, 3], found[:, 4, 3] = middle - [0, 0, 0.7], np.cos(turn), np.sin(turn)
    found[:, 4, :3] = drawn.uniform(0.1, 0.25, (n, 3))
    return found


def looking(eye, target):
    """T_world_camera (4, 4) float32 with level rows."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1]) / np.linalg.norm(z[:2])
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], 1), eye
    return T


@pytest.mark.check
def test_depth_of_a_plane_boxes_balls_and_capsules_is_that_of_float64_formulas():
    scene, trials, T = cell()
    drawn, place = np.random.default_rng(0), scene.config.workplace
    middle, far = np.array([1.5, 0.9, 0.8]), [0.3, 0.8, 1.4, 2.0]
    people, cameras = people_of_any_size(len(trials), middle, drawn), []
    for target in (middle, middle - [0, 0, 0.7], np.array([0.2, 0.3, 0])):
        for distance in far:
            d = np.abs(drawn.normal(size=3)) * [1, 1, 0.5] + [0, 0, 0.3]
            cameras.append(looking(target + d / np.linalg.norm(d) * distance, target + drawn.uniform(-0.05, 0.05, 3)))
    side, stride, focal = 40, 6, 260.0
    shown = Trials(
        trials.trial_id, trials.object_index, trials.hand_index, trials.T_world_hand, torch.from_numpy(people)
    )
    depth, label, facing = (
        x.numpy()
        for x in bodies_of(scene).cast(
            shown, T, torch.from_numpy(np.stack(cameras)), torch.zeros((len(trials), len(cameras), 2), dtype=torch.int32),
            focal_px=focal, sensor_px=(side * stride,) * 2, columns=side, rows=side, stride=stride,
        )
    )  # fmt: skip
    v, u = (np.mgrid[:side, :side] + 0.5) * stride - side * stride / 2
    ray = np.stack([u / focal, v / focal, np.ones_like(u)], -1)
    off, steep, met = [], [], {"ball": 0}
    for i, c in each(np.ndindex(len(trials), len(cameras))):
        camera = cameras[c].astype(np.float64)
        bodies = depth_of_bodies(
            people[i], (place.table_center, place.table_half), camera[:3, 3], ray @ camera[:3, :3].T
        )
        names, z = list(bodies), np.stack(list(bodies.values()))
        z[z * np.linalg.norm(ray, axis=-1) > FAR_M] = np.inf
        expected_label = np.array([LABELS.index(name) for name in names])[z.argmin(0)]
        own = np.isin(label[i, c], [LABELS.index(name) for name in names])
        # robot, object and hand are others' matter
        same = own & (label[i, c] == expected_label) & np.isfinite(z.min(0))
        assert (own & ~same).sum() <= 2 and (np.isfinite(z.min(0)) & (label[i, c] == 0)).sum() <= 2
        off.append(np.abs(depth[i, c] - z.min(0))[same])
        steep.append(facing[i, c][same] < np.cos(np.radians(80)))
        for name in each(names):
            met[name] = met.get(name, 0) + int((same & (label[i, c] == LABELS.index(name))).sum())
        met["ball"] += int((same & (label[i, c] == LABELS.index("forearm"))).sum()) * (i < len(trials) // 2)
    assert min(met.values()) > 500, met
    off, steep = np.concatenate(off), np.concatenate(steep)
    assert off[~steep].max() < 5e-6 and np.median(off) < 2e-7
    # where a ray grazes a surface, the last bits of a float32 move it further
    assert steep.sum() > 100 and off[steep].max() < 1e-5


def test_a_background_that_is_kept_changes_no_bit():
    scene, trials, T = cell()
    own = Bodies(scene)
    corners = window_corners(RIG, middles(scene, trials, T), 192)
    corners[0, 0] = torch.tensor([1200, -30])  # partly beyond the sensor
    how = {"focal_px": RIG.focal_px, "sensor_px": RIG.sensor_px, "columns": 192, "rows": 192}
    found = [own.cast(trials, T, RIG.T_world_camera, corners, **how) for _ in range(5)]
    pixels = 2 * RIG.width * RIG.height
    # asked for as many rays as there are pixels, it is there
    assert len(trials) * 2 * 192 * 192 < pixels <= 5 * len(trials) * 2 * 192 * 192
    assert {*found[0][1].unique().tolist()} >= {LABELS.index(k) for k in ("nothing", "table", "robot", "object")}
    for a, b in each(zip(found[0], found[-1])):
        assert torch.equal(a, b)


def test_images_have_the_same_bits_with_one_thread_and_with_three():
    scene, trials, _ = cell()
    one, three = (observe_with(n, scene, trials) for n in (1, 3))
    for name in each(("object", "hand")):
        for part in ("depth_m", "label"):
            assert torch.equal(*(getattr(getattr(x, name), part) for x in (one, three)))
    assert not torch.equal(one.object.depth_m, observe(scene, trials, RIG, seed=1).object.depth_m)


SMALL = RIG.model_copy(update={"width": 320, "height": 180, "focal_px": 162.5, "object_px": 32, "hand_px": 16})
"""cell-v1 with a quarter of its pixels each way, and windows of few pixels."""


@pytest.mark.parametrize("count", [16, pytest.param(128, marks=pytest.mark.slow)])
def test_many_trials_have_the_bits_that_they_have_alone_in_sevens_permuted_and_with_one_thread_and_with_two(count):
    scene, trials, T = cell(count=count)
    order = torch.from_numpy(np.random.default_rng(3).permutation(len(trials)))

    def shown(rows, threads):
        """All arrays of what is seen of these trials."""
        with on_threads(threads):
            seen = look(
                scene, trials[rows], SMALL, T[rows], labels="grown", model="lab", region="told",
            )  # fmt: skip
        known = {"known": seen.known.T_world_obj, "cloud": seen.cloud(64)[0]}
        return {**{k: torch.from_numpy(x) for k, x in packed(seen).items() if not k.startswith(OF_MESHES)}, **known}

    assert len(order) == 2 * count
    every = torch.arange(len(trials))
    whole = shown(every, 1)
    assert len(whole) == 15 and whole["region"].any()
    assert torch.equal(moments(scene, trials[order[:7]]), T[order[:7]])
    for rows, threads in each(
        [(every, 2), (order, 1), (order, 2), (order[:7], 1), (order[7:14], 2), (order[-1:], 1), (order[:1], 2)]
    ):
        for name, array in each(shown(rows, threads).items()):
            assert torch.equal(array, whole[name][rows]), (name, len(rows), threads)


OF_MESHES = ("vertices", "faces", "known")
"""Arrays that are not one row a trial."""


def observe_with(threads, scene, trials):
    with on_threads(threads):
        return observe(scene, trials, RIG, labels="grown")


def test_the_robot_at_home_is_mujocos_with_an_open_gripper():
    scene = cell()[0]
    vertices, faces = robot_at_home(scene.robot, tuple(scene.config.workplace.home_q))
    ours, theirs = vertices[faces].astype(np.float64).mean(1), robot_of_mujoco().mean(1)
    far = [cKDTree(a).query(b)[0] for a, b in ((ours, theirs), (theirs, ours))]
    assert len(ours) == len(theirs) and max(d.max() for d in far) < 0.02
    assert np.quantile(far[0], 0.99) < 1e-5  # a box may be cut along its other diagonal


def test_labels_of_left_and_right_cameras_differ_as_the_cameras_do():
    one = look(*cell()[:2], RIG.only("right"), cell()[2], noise=0)
    assert torch.equal(one.object.depth_m[:, 0], seen().object.depth_m[:, 1])
    assert not torch.equal(one.object.depth_m[:, 0], seen().object.depth_m[:, 0])


def test_moments_and_images_have_the_same_bits_alone_in_sevens_and_permuted():
    scene, trials, T = cell(count=10)
    whole = observe(scene, trials, RIG)
    order = torch.from_numpy(np.random.default_rng(2).permutation(len(trials)))
    parts = [order[k : k + 7] for k in range(0, len(order), 7)] + [torch.tensor([3])]
    for rows in each(parts):
        assert torch.equal(moments(scene, trials[rows]), T[rows])
        part = observe(scene, trials[rows], RIG)
        for one, all_of in ((part.object, whole.object), (part.hand, whole.hand)):
            for name in ("depth_m", "label", "K"):
                assert torch.equal(getattr(one, name), getattr(all_of, name)[rows])
        for one, every in zip(part.cloud(300), whole.cloud(300), strict=True):
            assert torch.equal(one, every[rows])


def test_objects_find_places_on_the_table_of_a_small_arm_and_those_of_larger_arms_stay():
    usual = load_benchmark("r2h-v3")
    for name in ("ur5e_2f85", "panda_hand", "ur10e_2f85"):
        assert region_scale(usual.on(load_robot(name)).workplace) == 1.0
    small = usual.on(load_robot("ur3e_2f85"))
    reach = load_robot("ur3e_2f85").reach_m / load_robot("ur5e_2f85").reach_m
    assert region_scale(small.workplace) == pytest.approx(reach)
    scene, trials = Evaluator(small).scene, small.trials(12)
    for i, T in each(enumerate(moments(scene, trials).double().numpy())):
        v = scene.objects[int(trials.object_index[i])].vertices @ T[:3, :3].T + T[:3, 3]
        middle = 0.5 * (v.min(0) + v.max(0)) / reach
        assert PLACE_X[0] - 1e-6 <= middle[0] <= PLACE_X[1] + 1e-6
        assert PLACE_Y[0] - 1e-6 <= abs(middle[1]) <= PLACE_Y[1] + 1e-6
        assert v[:, 0].max() <= 0.45 * reach + 1e-6 and np.abs(v[:, 1]).max() <= 0.6 * reach + 1e-6
    narrow = Workplace(table_center=(0.0, 0.0, -0.025), table_half=(0.3, 0.3, 0.025))
    assert region_scale(narrow) == 0.5  # the smaller share: 0.3 of 0.6 m, not 0.3 of 0.45 m


@pytest.mark.parametrize("benchmark", ["r2h-v2", "r2h-v1"])
def test_objects_rest_on_the_table_away_from_the_hand_and_touch_nobody(benchmark):
    scene, trials, T = cell(benchmark, 12)
    robot = cKDTree(np.unique(robot_of_mujoco().reshape(-1, 3), axis=0))
    for i in each(range(len(trials))):
        model, pose = scene.objects[int(trials.object_index[i])], T[i].double().numpy()
        v = model.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert v[:, 2].min() == pytest.approx(0.0, abs=1e-6)
        middle = 0.5 * (v.min(0) + v.max(0))
        assert PLACE_X[0] - 1e-6 <= middle[0] <= PLACE_X[1] + 1e-6
        assert PLACE_Y[0] - 1e-6 <= abs(middle[1]) <= PLACE_Y[1] + 1e-6
        assert middle[1] * float(trials.T_world_hand[i, 1, 3]) <= 0
        assert v[:, 0].max() <= 0.45 and np.abs(v[:, 1]).max() <= 0.6
        # the centre of mass is over the hull of what touches the table
        com = pose[:3, :3] @ model.com + pose[:3, 3]
        low = v[v[:, 2] < 6e-4][:, :2] - com[:2]
        angles = np.sort(np.arctan2(low[:, 1], low[:, 0]))
        assert np.diff([*angles, angles[0] + 2 * np.pi]).max() < np.pi
        assert robot.query(v)[0].min() > TOUCH_M


def test_frames_of_the_default_benchmark_rest_on_a_table():
    objects = cell()[0].objects
    for model in each(objects):
        assert np.array_equal(resting_rotation(model), np.eye(3))


def test_a_point_near_a_body_is_found_and_one_beyond_is_not():
    scene, trials, T = cell()
    table = scene.config.workplace
    top = table.table_center[2] + table.table_half[2]
    points = torch.tensor([[[-0.3, 0.5, top + 0.009], [-0.3, 0.5, top + 0.011]]]).expand(len(trials), -1, -1)
    found = bodies_of(scene).near(trials, T, points, within_m=0.01, resting=False)
    assert (found == torch.tensor([1, 0])).all()
    shoulder = trials.receiver[:, 0, :3]
    found = bodies_of(scene).near(trials, T, shoulder[:, None], within_m=0.01, resting=True)
    assert (found > 4).all()
    top = heads_of(trials.receiver)[:, 1]
    above = top[:, None, :3] + torch.tensor([[0.0, 0.0, 0.009], [0.0, 0.0, 0.012]]) + top[:, None, 3:] * torch.eye(3)[2]
    found = bodies_of(scene).near(trials, T, above, within_m=0.01, resting=True)
    assert (found == torch.tensor([LABELS.index("head"), 0])).all()


def test_clouds_lie_on_the_surface_of_the_object_and_of_the_hand():
    import trimesh

    scene, trials, T = cell()
    for label, count in each([("object", 300), ("hand", 300)]):
        cloud, mask = seen().cloud(count, label=label)
        for i in each([i for i in range(len(trials)) if mask[i].any()]):
            corners, labels = triangles(scene, trials, T, i)
            own = corners[labels == LABELS.index(label)]
            mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(own))
            points = cloud[i][mask[i]][:50].double().numpy()
            away = trimesh.proximity.ProximityQuery(mesh).on_surface(points)[1]
            # float32 rays that graze a face end up to 0.1 mm beside its edge
            assert np.quantile(away, 0.95) < 1e-5 and away.max() < 2e-4


def test_clouds_take_every_pixel_once_and_mask_the_rest():
    cloud, mask = seen().cloud(20_000)
    images = seen().object
    count = ((images.label == 3) & (images.depth_m > 0)).sum((1, 2, 3))
    assert torch.equal(mask.sum(1), count)
    assert (cloud[~mask] == 0).all()
    for i in each(range(len(cloud))):
        assert len(torch.unique(cloud[i][mask[i]], dim=0)) == int(count[i])


def test_a_cloud_that_cannot_be_is_refused_in_words():
    with pytest.raises(ValueError, match="label is 'objekt'; allowed are nothing, table"):
        seen().cloud(10, label="objekt")
    with pytest.raises(ValueError, match="points is -3; it must be"):
        seen().cloud(-3)
    with pytest.raises(TypeError, match=r"points is 2\.5; it must be"):
        seen().cloud(2.5)
    assert seen().cloud(0)[0].shape == (len(seen()), 0, 3)


def test_pixels_come_into_clouds_by_their_numbers_and_the_first_of_those_with_the_same(monkeypatch):
    images, drawn = seen().object, {}

    def few(key, ids, count, *, purpose, attempt):
        """One of 64 numbers for each pixel."""
        drawn["turn"] = (np.random.default_rng(4).integers(0, 1 << 6, len(ids)) * 2**26 + 0.5) * 2.0**-32
        return drawn["turn"][None]

    monkeypatch.setattr("r2h_batch.base.rng.uniforms", few)
    cloud, mask = seen().cloud(20_000)
    row, camera, v, u = ((images.label == 3) & (images.depth_m > 0)).nonzero(as_tuple=True)
    for i in each(range(len(cloud))):
        own = np.flatnonzero(row.numpy() == i)
        own = own[np.argsort(drawn["turn"][own], kind="stable")]
        z = images.depth_m[i, camera[own], v[own], u[own]]
        T, K = seen().T_world_camera[i, camera[own]], images.K[i, camera[own]]
        x, y = ((k[own] + 0.5 - K[:, a, 2]) / K[:, a, a] * z for a, k in ((0, u), (1, v)))
        points = (T[:, :3, :3] @ torch.stack([x, y, z], 1)[..., None])[..., 0] + T[:, :3, 3]
        assert (cloud[i][mask[i]] - points).abs().max() < 1e-6


def test_clouds_are_even_samples_and_smaller_ones_begin_larger_ones():
    whole, mask = seen().cloud(20_000)
    large, small = seen().cloud(400)[0], seen().cloud(150)[0]
    assert torch.equal(large[:, :150], small)
    other = seen().cloud(400, seed=1)[0]
    assert not torch.equal(other, large)
    for i in each([i for i in range(len(whole)) if int(mask[i].sum()) > 1500]):
        every = whole[i][mask[i]].double()
        for part in each((large[i].double(), other[i].double())):
            # the mean of 400 of m points lies within four deviations of that of all
            away = (part.mean(0) - every.mean(0)).abs() / (every.std(0) / 20)
            assert away.max() < 4
            assert len(torch.unique(part, dim=0)) == 400


BAD = {
    "focal_px is nan": (
        'focal_px = nan\n[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n',
        "finite",
    ),
    "two cameras are called": ('[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n' * 2, "'a'"),
    "object_px": ('object_px = 7\n[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n', "16"),
    "a window is no larger": (
        'object_px = 800\n[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n',
        "1280 x 720",
    ),
    "looks up or down": ('[[cameras]]\nname = "a"\nposition = [0, 0, 1]\ntarget = [0, 0, 0]\n', "1 cm"),
    "cameras": ("width = 640\n", "needed"),
    "x is a dict": (
        f'[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n[{".".join(["x"] * 10_000)}]\ny = 1\n',
        "too deep to read",
    ),
    "focus": ('focus = 3\n[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n', "focus"),
}


@pytest.mark.parametrize("words", BAD)
def test_a_rig_that_cannot_be_is_refused_in_one_line(words, tmp_path):
    file = tmp_path / "rig.toml"
    text, more = BAD[words]
    file.write_text(f'name = "mine"\n{text}')
    with pytest.raises(UserError) as refused:
        load_rig(file)
    message = str(refused.value)
    assert words in message and more in message and "\n" not in message


def test_unknown_rigs_name_the_nearest_one():
    with pytest.raises(UserError, match=r"rig 'cell-v2', did you mean cell-v1\?; allowed are cell-v1"):
        load_rig("cell-v2")
    with pytest.raises(UserError, match="no such file"):
        load_rig("none.toml")
    with pytest.raises(UserError, match="camera 'middle' is not in rig cell-v1; it has left, right"):
        RIG.only("middle")


def rig_at(position, target):
    camera = CELL_V1.cameras[0].model_copy(update={"position": position, "target": target})
    return CELL_V1.model_copy(update={"name": "moved", "cameras": (camera,)})


def test_a_camera_in_a_body_and_an_object_out_of_view_are_refused_in_one_line():
    scene, trials, _ = cell()
    with pytest.raises(UserError, match=r"rig moved: camera 'left' is within 0\.1 m of the table in trial 0; move it"):
        observe(scene, trials, rig_at((0.0, 0.5, -0.02), (0.4, 0, 0.1)))
    with pytest.raises(UserError, match="is in no camera's image; turn a camera"):
        observe(scene, trials, rig_at((-0.1, 0.75, 0.8), (-1.0, 2.0, 0.8)))
    # it is in the image, and the image shows nothing so far off
    with pytest.raises(UserError, match=r"is [67]\.\d m from the nearest camera that looks at it; they see 4 m$"):
        observe(scene, trials, rig_at((-4.0, 4.0, 3.0), (0.42, 0, 0.15)))


def test_a_rig_file_sees_what_the_rig_of_its_numbers_sees(tmp_path):
    cameras = "".join(
        f'[[cameras]]\nname = "{c.name}"\nposition = {list(c.position)}\ntarget = {list(c.target)}\n'
        for c in CELL_V1.cameras
    )
    (tmp_path / "mine.toml").write_text(f'name = "cell-v1"\n{cameras}')
    assert load_rig(tmp_path / "mine.toml").digest == CELL_V1.digest


def test_a_pixel_shows_the_same_in_every_window_wherever_the_window_begins():
    scene, trials, T = cell()
    at = window_corners(RIG, middles(scene, trials, T), 96)

    def shown(shift):
        return bodies_of(scene).cast(
            trials,
            T,
            RIG.T_world_camera,
            at + shift,
            focal_px=RIG.focal_px,
            sensor_px=RIG.sensor_px,
            columns=96,
            rows=96,
        )

    first = shown(0)
    assert int((first[1] == LABELS.index("object")).sum()) > 1000
    for shift in each((1, 3)):
        for a, b in each(zip(first, shown(shift), strict=True)):
            assert torch.equal(a[..., shift:, shift:], b[..., :-shift, :-shift])
