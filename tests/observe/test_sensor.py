"""Errors of depth cameras (r2h_batch.observe.sensor) against a float64 twin and against their stated distributions."""

from functools import cache
from math import cos, erf, radians, sqrt

import numpy as np
import pytest
import torch
from rays_twin import RIG, cell, first_hit, triangles
from rounds import each
from scipy.spatial.transform import Rotation

from r2h_batch.base import rng
from r2h_batch.base.errors import UserError
from r2h_batch.observe import LABELS, load_rig, look, observe
from r2h_batch.observe.rays import bodies_of
from r2h_batch.observe.rig import CELL_V1, Sensor
from r2h_batch.observe.sensor import Errors
from r2h_batch.observe.windows import middles, window_corners
from r2h_batch.scene.person import heads_of

PLACE, FATE, STEREO, MASK = range(4)


def normal(words):
    """Sums of the 16-bit halves of words (k, n), as a number of mean 0 and variance 1."""
    half = np.concatenate([words & 0xFFFF, words >> 16]).astype(np.float64)
    return (half.sum(0) - len(half) * 32767.5) / (65536 * sqrt(len(half) / 12))


def words_of(seed, camera, trial, pixels, purpose):
    """(4, n) random words of pixels of a trial."""
    u = rng.uniforms(
        rng.key_of(f"sensor {seed} {camera}"), np.full(pixels.size, trial), 4, purpose=purpose, attempt=pixels.ravel()
    )
    return np.floor(u * 2.0**32).astype(np.int64)


def uniform(word):
    return ((word >> 9) + 0.5) / 2.0**23


def twin(rig, camera, trial, corner, exact, facing, *, noise, seed):
    """Measured depth (h, w) in float64, pixel by pixel as docs/observe.md says it."""
    sensor, (h, w) = rig.sensor, exact.shape
    v, u = np.mgrid[:h, :w]
    y, x = v + corner[1], u + corner[0]
    pixel = y * rig.width + x
    shape = lambda words: words.reshape(4, h, w)  # noqa: E731
    place, fate = (shape(words_of(seed, camera, trial, pixel, p)) for p in (PLACE, FATE))
    k = sensor.disparity_side_px
    axial = normal(shape(words_of(seed, camera, trial, y // k * rig.width + x // k, STEREO)))
    across, down = (
        np.floor(noise * sensor.lateral_px * normal(place[two]) + 0.5).astype(int) for two in ([0, 1], [2, 3])
    )
    rows, columns = np.clip(v + down, 0, h - 1), np.clip(u + across, 0, w - 1)
    z, steep = exact[rows, columns].astype(np.float64), facing[rows, columns] < cos(radians(sensor.steepest_deg))
    padded = np.pad(exact.astype(np.float64), 1)
    near9 = np.stack([padded[1 + a : 1 + a + h, 1 + b : 1 + b + w] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    near, far = np.where(near9 > 0, near9, 1e6).min(0), near9.max(0)
    edge = far - near > sensor.edge_m
    at = uniform(fate[1])
    gone = edge & (at < noise * sensor.edge_lost)
    flying = edge & ~gone & (at < noise * (sensor.edge_lost + sensor.edge_flying))
    z = np.where(flying, near + (far - near) * uniform(fate[2]), z)
    gone |= (uniform(fate[0]) < noise * sensor.lost) | (steep & ~flying) | (z <= 0)
    z = z + noise * sensor.disparity_px / (rig.focal_px * sensor.baseline_m) * z**2 * axial
    z = np.floor(z / sensor.step_m + 0.5) * sensor.step_m
    return np.where(gone, 0.0, np.maximum(z, 0.0)), flying, edge


@cache
def exact_windows(rig=RIG):
    """Corners, depth, labels and facing of the windows about the object, of four trials."""
    scene, trials, T = cell()
    corner = window_corners(rig, middles(scene, trials, T), rig.object_px)
    return corner, *bodies_of(scene).cast(
        trials, T, rig.T_world_camera, corner, focal_px=rig.focal_px, sensor_px=rig.sensor_px,
        columns=rig.object_px, rows=rig.object_px,
    )  # fmt: skip


@pytest.mark.check
@pytest.mark.parametrize("noise", [1.0, 0.4])
def test_measured_depth_is_that_of_a_float64_twin(noise):
    _, trials, _ = cell()
    corner, depth, _, facing = exact_windows()
    found = Errors(RIG, noise=noise, labels="exact", seed=3, device="cpu").measured(
        trials.trial_id, corner, depth, facing
    )
    for i, c in each([(1, 0), (2, 1)]):
        expected, flying, edge = twin(
            RIG, RIG.cameras[c].name, int(trials.trial_id[i]), corner[i, c].numpy(), depth[i, c].numpy(),
            facing[i, c].numpy(), noise=noise, seed=3,
        )  # fmt: skip
        own = found[i, c].double().numpy()
        assert flying.sum() > 50 and edge.sum() > 500
        assert ((own > 0) == (expected > 0)).mean() > 0.9999
        both = (own > 0) & (expected > 0)
        off = np.abs(own - expected)[both]
        # a depth halfway between two steps may be rounded to the other one
        assert both.sum() > 20_000 and (off > 1e-6).mean() < 2e-3 and off.max() < 1.01e-4


def sparse(rows, columns, n, cameras=2, seed=0):
    """Depth (n, c, h, w), mostly none, and facing; the last window shows one pixel."""
    drawn = np.random.default_rng(seed)
    shape = (n, cameras, rows, columns)
    depth = np.where(drawn.random(shape) < 0.1, drawn.uniform(0.4, 1.5, shape), 0)
    depth[-1] = 0
    depth[-1, :, rows // 2, columns // 2] = 0.9
    return torch.from_numpy(depth.astype(np.float32)), torch.from_numpy(drawn.uniform(0.1, 1, shape).astype(np.float32))


@pytest.mark.parametrize("side", [1, 2, 3])
def test_windows_of_any_size_and_place_that_show_little_are_measured_as_the_twin_says(side):
    rig = RIG.model_copy(update={"sensor": Sensor(disparity_side_px=side, lateral_px=1.0)})
    corner = torch.tensor([[[-5, 11], [1270, 300]], [[301, 0], [-12, -7]], [[400, 401], [17, 716]]], dtype=torch.int32)
    ids = torch.tensor([3, 1 << 40, 12], dtype=torch.int64)
    for rows, columns in each([(13, 29), (3, 1), (1, 8)]):
        depth, facing = sparse(rows, columns, 3)
        found = Errors(rig, noise=2.0, labels="exact", seed=3, device="cpu").measured(ids, corner, depth, facing)
        for i, c in np.ndindex(3, 2):
            at = corner[i, c].numpy()
            expected, *_ = twin(
                rig, rig.cameras[c].name, int(ids[i]), at, depth[i, c].numpy(), facing[i, c].numpy(), noise=2.0, seed=3
            )
            y, x = np.mgrid[:rows, :columns] + at[::-1, None, None]
            expected[(x < 0) | (x >= rig.width) | (y < 0)] = 0
            assert np.abs(found[i, c].double().numpy() - expected).max() < 1.01e-4
            assert ((found[i, c] > 0).numpy() == (expected > 0)).all()
        assert columns < 9 or ((found[-1] > 0).sum() > 2 and (found[0, 0] > 0).any())


def test_rows_and_single_pixels_of_a_thread_give_the_same_bits(monkeypatch):
    _, trials, _ = cell()
    corner, depth, label, facing = exact_windows()
    label, ids = label[..., :90, :90].contiguous(), trials.trial_id
    for kind in each(("missed", "grown", "eroded")):
        errors = Errors(RIG, noise=1.0, labels=kind, seed=3, device="cpu")
        by_row = errors.measured(ids, corner, depth, facing), errors.masked(ids, label)
        with monkeypatch.context() as patch:  # as a thread of a GPU takes them
            patch.setattr(Errors, "_several", lambda self, columns: 1)
            alone = errors.measured(ids, corner, depth, facing), errors.masked(ids, label)
        assert all(torch.equal(a, b) for a, b in zip(by_row, alone, strict=True))


def test_the_angle_to_the_surface_is_that_of_float64_rays():
    scene, trials, T = cell()
    corner, depth, label, facing = exact_windows()
    drawn, K = np.random.default_rng(3), np.array([[RIG.focal_px, 0, 640], [0, RIG.focal_px, 360], [0, 0, 1]])
    cameras, met = RIG.T_world_camera.double().numpy(), 0
    half = np.array(scene.config.workplace.table_half)
    for _ in each(range(80)):
        i, c, u, v = (int(drawn.integers(n)) for n in (len(trials), 2, 192, 192))
        at = corner[i, c].numpy() + (u + 0.5, v + 0.5)
        ray = np.array([(at[0] - K[0, 2]) / K[0, 0], (at[1] - K[1, 2]) / K[1, 1], 1.0])
        direction = cameras[c][:3, :3] @ (ray / np.linalg.norm(ray))
        corners, labels = triangles(scene, trials, T, i)
        t, which = first_hit(cameras[c][:3, 3], direction, corners)
        shown = int(label[i, c, v, u])
        if shown == LABELS.index("table"):
            p = cameras[c][:3, 3] + direction * np.linalg.norm(ray) * float(depth[i, c, v, u])
            side = np.abs(np.abs(p - scene.config.workplace.table_center) - half).argmin()
            assert float(facing[i, c, v, u]) == pytest.approx(abs(direction[side]), abs=1e-5)
        elif np.isfinite(t) and shown == labels[which]:
            a, b, d = corners[which]
            n = np.cross(b - a, d - a)
            expected = abs(direction @ n) / np.linalg.norm(n)
            met += float(facing[i, c, v, u]) == pytest.approx(expected, abs=1e-3)
    assert met > 5


def test_arm_torso_and_head_face_the_ray_as_a_ball_and_a_box_do():
    scene, trials, T = cell()
    corner = torch.zeros((len(trials), 1, 2), dtype=torch.int32)
    depth, label, facing = bodies_of(scene).cast(
        trials, T, RIG.T_world_camera[:1], corner, focal_px=RIG.focal_px, sensor_px=RIG.sensor_px,
        columns=320, rows=180, stride=4,
    )  # fmt: skip
    T_camera = RIG.T_world_camera[0].double().numpy()
    for name in each(("forearm", "upper_arm", "torso", "head")):
        i, _, v, u = (label == LABELS.index(name)).nonzero()[::200].T.numpy()
        ray = np.stack([(4 * u + 2 - 640) / RIG.focal_px, (4 * v + 2 - 360) / RIG.focal_px, np.ones(len(u))], 1)
        p = (ray * depth[i, 0, v, u].double().numpy()[:, None]) @ T_camera[:3, :3].T + T_camera[:3, 3]
        d = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ T_camera[:3, :3].T
        s, e, w, m, half = trials.receiver[i].double().numpy().transpose(1, 0, 2)
        if name == "torso":
            turn = np.stack([np.stack([m[:, 3], half[:, 3]], 1), np.stack([-half[:, 3], m[:, 3]], 1)], 1)
            flat = np.concatenate([np.einsum("nij,nj->ni", turn, (p - m[:, :3])[:, :2]), (p - m[:, :3])[:, 2:]], 1)
            ahead = np.concatenate([np.einsum("nij,nj->ni", turn, d[:, :2]), d[:, 2:]], 1)
            side = np.abs(np.abs(flat) - half[:, :3]).argmin(1)
            expected = np.abs(ahead[np.arange(len(side)), side])
        else:
            ends = heads_of(trials.receiver)[i].double().numpy().transpose(1, 0, 2)
            a, b = {"forearm": (e, w), "upper_arm": (s, e), "head": ends}[name]
            along = b[:, :3] - a[:, :3]
            t = np.clip(((p - a[:, :3]) * along).sum(1) / (along * along).sum(1), 0, 1)
            n = p - a[:, :3] - t[:, None] * along
            expected = np.abs((n * d).sum(1)) / np.linalg.norm(n, axis=1)
        found = facing[i, 0, v, u].double().numpy()
        assert len(found) > 3 and np.abs(found - expected).max() < 2e-3


def plane(z_m, trials=40, side=192, rig=RIG, facing=1.0, **options):
    """Measured depth (n, h, w) of a plane that fills a window."""
    errors = Errors(rig, **{"noise": 1.0, "labels": "exact", "seed": 0, "device": "cpu", **options})
    n = len(rig.cameras)
    depth = torch.full((trials, n, side, side), z_m, dtype=torch.float32)
    corner = torch.full((trials, n, 2), 300, dtype=torch.int32)
    ids = torch.arange(trials, dtype=torch.int64)
    return errors.measured(ids, corner, depth, torch.full_like(depth, facing))


@pytest.mark.check
@pytest.mark.parametrize("z_m", [0.5, 0.9, 1.5])
def test_noise_of_depth_grows_with_its_square_as_stereo_has_it_and_has_no_bias(z_m):
    found = plane(z_m).double().numpy()
    there = found[found > 0]
    sigma = z_m**2 * 0.08 / (650 * 0.050)
    assert there.size > 1e6
    assert there.std() == pytest.approx(sqrt(sigma**2 + 0.0001**2 / 12), rel=0.02)
    assert abs(there.mean() - z_m) < 0.01 * sigma
    steps = int(sigma / 1e-4)  # a depth within so many is one within half a step more before rounding
    inside = (np.abs(there - z_m) < (steps + 0.5) * 1e-4).mean()
    assert inside == pytest.approx(erf((steps + 0.5) * 1e-4 / sigma / sqrt(2)), abs=0.01)
    assert np.abs(np.round(there / 1e-4) * 1e-4 - there).max() < 1e-7


def test_noise_is_shared_by_squares_of_two_pixels_and_by_nothing_else():
    found = plane(0.9).double().numpy()
    z = np.where(found > 0, found, np.nan) - 0.9

    def correlation(a, b):
        both = np.isfinite(a) & np.isfinite(b)
        return np.corrcoef(a[both], b[both])[0, 1]

    # windows begin at the even pixel 300
    assert correlation(z[..., 0::2], z[..., 1::2]) > 0.99 and correlation(z[..., 0::2, :], z[..., 1::2, :]) > 0.99
    for a, b in each(
        [
            (z[..., 1:-1:2], z[..., 2::2]),
            (z[..., 1:-1:2, :], z[..., 2::2, :]),
            (z[:, 0], z[:, 1]),
            (z[:-1], z[1:]),
        ]
    ):
        assert abs(correlation(a, b)) < 0.01


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_the_share_that_is_lost_anywhere_is_the_stated_one(noise):
    assert float((plane(0.9, noise=noise) == 0).double().mean()) == pytest.approx(0.005 * noise, rel=0.02)


def test_surfaces_steeper_than_eighty_degrees_are_lost_and_others_are_not():
    assert float((plane(0.9, 2, facing=cos(radians(80.1))) == 0).double().mean()) == 1
    assert float((plane(0.9, 2, facing=cos(radians(79.9))) == 0).double().mean()) < 0.01


def steps(rig=RIG, trials=30, **options):
    """Measured depth (n c, h, stripe, 4) of stripes four columns wide, at 0.8 and 1.1 m in turn: the first and the last column
    of each are edges, 10^6 pixels in all."""
    errors = Errors(rig, **{"noise": 1.0, "labels": "exact", "seed": 0, "device": "cpu", **options})
    depth = torch.full((trials, len(rig.cameras), 192, 48, 4), 0.8, dtype=torch.float32)
    depth[..., 1::2, :] = 1.1
    depth = depth.flatten(-2)
    corner = torch.full((trials, len(rig.cameras), 2), 300, dtype=torch.int32)
    ids = torch.arange(trials, dtype=torch.int64)
    found = errors.measured(ids, corner, depth, torch.ones_like(depth)).flatten(0, 1).double().numpy()
    # the window's own border is no edge
    return found.reshape(*found.shape[:2], 48, 4)[:, :, 1:-1]


def test_shares_of_lost_and_flying_pixels_at_edges_are_the_stated_ones_and_flying_ones_lie_anywhere_between():
    stripes = steps()
    found, away = stripes[..., [0, 3]], stripes[..., [1, 2]]
    assert found.size > 1e6
    lost, between = found == 0, found[(found > 0.83) & (found < 1.07)]
    assert lost.mean() == pytest.approx(0.3 + 0.7 * 0.005, rel=0.01)
    # 80 % of a flying pixel's range is between these
    assert between.size / found.size == pytest.approx(0.3 * 0.995 * 0.8, rel=0.01)
    assert np.histogram(between, 8, (0.83, 1.07))[0] / between.size == pytest.approx(1 / 8, rel=0.02)
    assert (away == 0).mean() == pytest.approx(0.005, rel=0.04) and not ((away > 0.83) & (away < 1.07)).any()


def test_a_pixel_looks_beside_itself_as_often_as_half_a_pixel_of_deviation_makes_it():
    found = steps(RIG.model_copy(update={"sensor": Sensor(edge_lost=0, edge_flying=0)}))
    # of sums of four uniform numbers (deviation 1), as many are beyond 1 and beyond 3 (Irwin and Hall)
    one, two = ((s**4 - 4 * max(s - 1, 0) ** 4) / 24 for s in (2 - k / sqrt(3) for k in (1, 3)))
    for column, other in each([(0, one), (1, two), (2, two), (3, one)]):
        shown, size = 0, 0
        for first, depth in ((0, 1.1), (1, 0.8)):
            there = found[:, :, first::2, column]
            there = there[there > 0]
            shown, size = shown + (np.abs(there - (1.9 - depth)) < 0.02).sum(), size + there.size
        assert shown / size == pytest.approx(other, rel=0.01 if other == one else 0.2)


def test_a_pixel_has_the_same_error_in_every_window_that_shows_it_and_in_any_batch():
    errors = Errors(RIG, noise=1.0, labels="exact", seed=0, device="cpu")
    whole, ids = torch.full((3, 2, 96, 96), 0.9), torch.tensor([4, 900_000_000_007, 4 + (1 << 32)])
    corner = torch.full((3, 2, 2), 200, dtype=torch.int32)
    one = errors.measured(ids, corner, whole, torch.ones_like(whole))
    for px in (3, 24):
        other = errors.measured(ids, corner + px, whole, torch.ones_like(whole))
        assert torch.equal(one[..., px:, px:], other[..., :-px, :-px])
    # ids that differ in their upper half alone too: those of training streams lie beyond 2^40
    assert not torch.equal(one[0], one[1]) and not torch.equal(one[0], one[2])
    alone = errors.measured(ids[1:2], corner[1:2], whole[1:2], torch.ones_like(whole[1:2]))
    assert torch.equal(alone[0], one[1])
    seeded = Errors(RIG, noise=1.0, labels="exact", seed=1, device="cpu")
    assert not torch.equal(seeded.measured(ids, corner, whole, torch.ones_like(whole)), one)
    right = Errors(RIG.only("right"), noise=1.0, labels="exact", seed=0, device="cpu")
    alone = right.measured(ids, corner[:, :1], whole[:, :1], torch.ones_like(whole[:, :1]))
    assert torch.equal(alone[:, 0], one[:, 1])


def test_without_noise_depths_and_cameras_are_exact():
    scene, trials, T = cell()
    _, depth, label, _ = exact_windows()
    seen = look(scene, trials, RIG, T, noise=0)
    assert torch.equal(seen.object.depth_m, depth) and torch.equal(seen.object.label, label)
    assert torch.equal(seen.T_world_camera, RIG.T_world_camera.expand(len(trials), -1, -1, -1))


def test_calibration_errors_have_the_stated_deviations_in_the_cameras_frame_and_differ_by_camera_and_trial():
    ids = torch.arange(20_000, dtype=torch.int64)
    for noise in each((1.0, 2.0)):
        T = Errors(RIG, noise=noise, labels="exact", seed=0, device="cpu").believed(ids).double().numpy()
        true = RIG.T_world_camera.double().numpy()
        E = np.linalg.inv(true) @ T
        turns = Rotation.from_matrix(E[..., :3, :3].reshape(-1, 3, 3)).as_rotvec(degrees=True)
        assert turns.std(0) == pytest.approx(0.2 * noise, rel=0.02) and np.abs(turns.mean(0)).max() < 0.004 * noise
        assert E[..., :3, 3].reshape(-1, 3).std(0) == pytest.approx(0.002 * noise, rel=0.02)
        both = E[..., :3, 3]
        assert abs(np.corrcoef(both[:, 0].ravel(), both[:, 1].ravel())[0, 1]) < 0.02
    rows = torch.tensor([17, 3])
    part = Errors(RIG, noise=2.0, labels="exact", seed=0, device="cpu").believed(rows)
    assert np.array_equal(part.numpy(), T[rows].astype(np.float32))


def dilated(mask, px):
    h, w = mask.shape
    padded = np.pad(mask, px)
    around = [padded[a : a + h, b : b + w] for a in range(2 * px + 1) for b in range(2 * px + 1)]
    return np.any(around, 0)


def test_masks_shrink_and_grow_by_two_pixels():
    scene, trials, T = cell()
    exact = look(scene, trials, RIG, T, noise=0).object.label.numpy()
    grown, eroded = (look(scene, trials, RIG, T, noise=0, labels=k).object.label.numpy() for k in ("grown", "eroded"))
    thing = LABELS.index("object")
    for i in each(range(len(trials))):
        own = exact[i, 0] == thing
        assert own.sum() > 100
        assert np.array_equal(grown[i, 0] == thing, dilated(own, 2))
        inside = own & ~dilated(~own, 2)
        assert np.array_equal(eroded[i, 0] == thing, inside)
        assert (eroded[i, 0][own & ~inside] == 0).all()
        assert np.array_equal(eroded[i, 0][~own], exact[i, 0][~own])


@pytest.mark.parametrize("px", [1, 3])
def test_masks_that_touch_each_other_and_the_border_shrink_and_grow_as_squares_say(px):
    rig = RIG.model_copy(update={"sensor": Sensor(mask_px=px)})
    drawn = np.random.default_rng(px)
    for rows, columns in each([(11, 19), (2, 23), (5, 1)]):
        blocks = drawn.choice([0, 1, 3, 3, 4, 4], (3, 2, -(-rows // 4), -(-columns // 4)))
        label = np.kron(blocks, np.ones((4, 4), np.uint8))[..., :rows, :columns].astype(np.uint8)
        for kind in ("grown", "eroded"):
            errors = Errors(rig, noise=1.0, labels=kind, seed=0, device="cpu")
            found = errors.masked(torch.arange(3), torch.from_numpy(label.copy())).numpy()
            for i, c in each(np.ndindex(3, 2)):
                own, expected = label[i, c], label[i, c].copy()
                for thing in (3, 4):  # the hand's mask lies above the object's
                    others = ~dilated(own != thing, px)
                    inside = dilated(own == thing, px) if kind == "grown" else others
                    expected[(own == thing) & ~inside & (expected == thing)] = 0
                    expected[inside] = thing
                assert np.array_equal(found[i, c], expected)


def test_one_mask_in_twenty_is_missed_by_camera_trial_and_thing():
    label = torch.full((300_000, 2, 1, 4), LABELS.index("object"), dtype=torch.uint8)
    label[..., 2:] = LABELS.index("hand")
    ids = torch.arange(len(label), dtype=torch.int64)
    found = Errors(RIG, noise=1.0, labels="missed", seed=0, device="cpu").masked(ids, label).numpy()
    there = np.stack([(found[..., :2] == 3).all((2, 3)), (found[..., 2:] == 4).all((2, 3))], -1)
    gone = np.stack([(found[..., :2] == 0).all((2, 3)), (found[..., 2:] == 0).all((2, 3))], -1)
    assert (there ^ gone).all()
    assert gone.mean(0) == pytest.approx(0.05, rel=0.02)
    # both are missed as often as two that have nothing to do with each other
    assert gone.all(2).mean() == pytest.approx(0.0025, rel=0.1) and gone.all(1).mean() == pytest.approx(0.0025, rel=0.1)


def test_noisy_images_differ_from_exact_ones_and_keep_their_bits_in_parts():
    scene, trials, _ = cell()
    whole = observe(scene, trials, RIG, labels="missed")
    assert not torch.equal(whole.object.depth_m, observe(scene, trials, RIG, noise=0).object.depth_m)
    for rows in each((torch.tensor([2, 0]), torch.tensor([3]))):
        part = observe(scene, trials[rows], RIG, labels="missed")
        for one, every in ((part.object, whole.object), (part.hand, whole.hand)):
            assert torch.equal(one.depth_m, every.depth_m[rows]) and torch.equal(one.label, every.label[rows])
        assert torch.equal(part.T_world_camera, whole.T_world_camera[rows])


def test_a_rig_file_says_its_sensor_and_wrong_errors_are_refused_in_one_line(tmp_path):
    camera = '[[cameras]]\nname = "a"\nposition = [1, 0, 1]\ntarget = [0, 0, 0]\n'
    file = tmp_path / "rig.toml"
    file.write_text(f'name = "mine"\n{camera}[sensor]\nbaseline_m = 0.095\nlost = 0.1\n')
    assert load_rig(file).sensor == Sensor(baseline_m=0.095, lost=0.1)
    assert load_rig(file).digest != load_rig(file).model_copy(update={"sensor": Sensor()}).digest
    file.write_text(f'name = "mine"\n{camera}[sensor]\nlost = 3\n')
    with pytest.raises(UserError, match=r"sensor\.lost is 3; .*1"):
        load_rig(file)
    for words, hint in each(
        [
            ("widht = 3", "did you mean width?; it has name, "),
            ("[sensor]\ndisparity = 0.1", "did you mean disparity_px?; it has baseline_m"),
        ]
    ):
        own, last = ("", words) if words.startswith("[") else (words, "")
        file.write_text(f'name = "mine"\n{own}\n{camera}{last}\n')
        with pytest.raises(UserError, match=f"there is no such field, {hint.replace('?', '[?]')}"):
            load_rig(file)
    scene, trials, _ = cell()
    with pytest.raises(ValueError, match="noise"):
        observe(scene, trials, CELL_V1, noise=-1)
    with pytest.raises(ValueError, match="labels is 'none'"):
        observe(scene, trials, CELL_V1, labels="none")
