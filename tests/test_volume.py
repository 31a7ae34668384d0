"""The search box, the weights and the silhouettes that fusion works with."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import look_at
from hypothesis import given, settings
from hypothesis import strategies as st
from mvcore import _core
from mvcore.config import CarveConfig, DepthConfig, VolumeConfig
from mvcore.geometry.linear import solve, weighted_sum
from mvcore.geometry.rig import box_depth, common_volume, surrounds
from mvcore.mesh.surface import isosurface
from mvcore.silhouettes.occluder_repair import repaired_masks
from mvcore.silhouettes.visual_hull import bounded_hull
from mvcore.sparse.view_selection import choose_sources, depth_ranges, nearest_angles, search_box, view_middles, view_scores
from mvcore.types import DepthMap, SparsePoints
from mvcore.volume.hull_prior import silhouette_distance
from mvcore.volume.photo_hull import photo_hull, sparse_volume
from mvcore.volume.tsdf import fuse, fuse_tiles
from scipy.spatial import cKDTree

SIDE = 3.0
"""Half the width of the room, whose walls lie at x, y = ±SIDE."""
ROOM = np.array([[-SIDE, -SIDE, 0.0], [SIDE, SIDE, 2.6]])


def room_depth(camera):
    """z-depth of the room's walls, floor and ceiling, seen from inside."""
    rays = (
        np.column_stack([camera.pixel_grid().reshape(-1, 2), np.ones(camera.width * camera.height)]) @ np.linalg.inv(camera.K).T @ camera.R
    )
    with np.errstate(divide="ignore"):
        ways = np.maximum((ROOM[0] - camera.center) / rays, (ROOM[1] - camera.center) / rays)
    return ways.min(1).reshape(camera.height, camera.width).astype(np.float32)


def outward(count=16, radius=0.9):
    angles = 2 * np.pi * np.arange(count) / count
    ring = [(np.cos(a), np.sin(a)) for a in angles]
    return [look_at((radius * x, radius * y, 1.4), (3 * x, 3 * y, 1.2), (80, 60), 50.0) for x, y in ring]


def across(count=16, radius=2.4):
    """Cameras at the walls that look across the room, at the walls opposite."""
    return outward(count, -radius)


def points_of(cameras, depths, step=6):
    """Sparse points as a matcher would leave them: places of one view that others see too."""
    places = np.concatenate(
        [c.unproject(c.pixel_grid()[::step, ::step].reshape(-1, 2), d[::step, ::step].ravel()) for c, d in zip(cameras, depths)]
    )
    visible = np.zeros((len(cameras), len(places)), bool)
    for n, (c, d) in enumerate(zip(cameras, depths)):
        x = np.rint(c.project(places))
        seen = np.flatnonzero(((x >= 0) & (x < (c.width, c.height))).all(1))
        u, v = x[seen].astype(int).T
        visible[n, seen] = np.abs(d[v, u] - c.to_camera(places[seen])[:, 2]) < 0.1
    return SparsePoints(places, visible, np.zeros(len(places), np.float32))


@pytest.mark.parametrize("rig", [outward, across])
def test_the_box_of_a_room_seen_from_inside_holds_its_walls(rig):
    cameras = rig()
    depths = [room_depth(c) for c in cameras]
    points = points_of(cameras, depths)
    assert surrounds(cameras)
    box = search_box(cameras, points)
    assert (box[0] <= ROOM[0] + 0.05)[:2].all()
    assert (box[1] >= ROOM[1] - 0.05)[:2].all()
    assert (box[1] - box[0] < 1.6 * (ROOM[1] - ROOM[0])).all()
    for (near, far), depth in zip(depth_ranges(cameras, points, box, 0.25, False), depths):
        assert near < np.quantile(depth, 0.05)
        assert far > np.quantile(depth, 0.95)
    # Each view is served by those that look at the same wall.
    sources = choose_sources(view_scores(cameras, points, box, DepthConfig()), 2)
    assert all({(n - 1) % 16, (n + 1) % 16} == set(s) for n, s in enumerate(sources))


def test_cameras_that_look_inwards_keep_their_common_volume(ring):
    cameras, _, depths, masks = ring
    target = points_of(cameras, [np.where(m, d, 0) for d, m in zip(depths, masks)], 4)
    rng = np.random.default_rng(0)
    # As many points again on the background far behind, each seen by two neighbours.
    far = rng.normal(size=(len(target), 3)) * 12
    seen = np.zeros((len(cameras), len(far)), bool)
    seen[rng.integers(0, 12, len(far)), np.arange(len(far))] = True
    seen |= np.roll(seen, 1, 0)
    points = SparsePoints(
        np.concatenate([target.positions, far]), np.concatenate([target.visible, seen], 1), np.zeros(2 * len(far), np.float32)
    )
    assert np.array_equal(search_box(cameras, points), common_volume(cameras))


def test_a_view_that_has_the_box_behind_it_serves_none():
    cameras = [look_at((x, -3.0, 0.0), (x, 0.0, 0.0)) for x in (0.0, 0.3)] + [look_at((x, 3.0, 0.0), (x, 9.0, 0.0)) for x in (0.0, 0.3)]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    none = SparsePoints(np.zeros((0, 3)), np.zeros((4, 0), bool), np.zeros(0, np.float32))
    assert [box_depth(c, box) for c in cameras] == pytest.approx([3, 3, 0, 0])
    assert choose_sources(view_scores(cameras, none, box, DepthConfig()), 3) == [[1], [0], [], []]
    assert box_depth(look_at((0.5, 0, 0), (9, 0, 0)), box) == pytest.approx(0.25)


@pytest.mark.parametrize("rig", [outward, across])
def test_a_room_seen_from_inside_is_fused(rig):
    cameras = rig()
    maps = [DepthMap(d, np.full(d.shape, 0.6, np.float32)) for d in map(room_depth, cameras)]
    bounds = ROOM + np.array([[-2.0], [2.0]])
    surface = isosurface(fuse(maps, cameras, bounds, None, VolumeConfig(voxel=0.06)))
    off = np.abs(np.concatenate([surface.vertices - ROOM[0], surface.vertices - ROOM[1]], 1)).min(1)
    assert np.quantile(off, 0.95) < 0.06
    # At the height of the cameras all four walls are there, a patch of 20 cm at every place.
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1)):
        on = surface.vertices[np.abs(surface.vertices[:, axis] - ROOM[side, axis]) < 0.06]
        on = on[np.abs(on[:, 2] - 1.3) < 0.3]
        assert len(np.unique(np.floor(on[:, 1 - axis] / 0.2))) >= 28


def test_carving_takes_views_that_have_the_hull_behind_them(ring):
    cameras, images, _, masks = ring
    away = look_at((3, 0, 0), (9, 0, 0))
    outlines = [m.astype(np.uint8) for m in masks]
    box = np.array([[-0.8] * 3, [0.8] * 3])
    config = CarveConfig(resolution=48)
    one = bounded_hull(outlines, cameras, box, config)
    two = bounded_hull([*outlines, outlines[0]], [*cameras, away], box, config)
    assert two.occupied.sum() == pytest.approx(one.occupied.sum(), rel=0.05)
    field = np.where(np.linalg.norm(np.indices((32,) * 3) / 31 - 0.5, axis=0) < 0.4, -1, 1).astype(np.float32)
    hull = sparse_volume(field, np.full(3, -0.6), 1.2 / 31)
    kept = [photo_hull(hull, [*images, images[0]][:n], [*cameras, away][:n]) for n in (12, 13)]
    assert np.array_equal(kept[0].values, kept[1].values)


def test_angles_between_views_are_those_at_what_they_look_at():
    cameras = outward(8)
    points = points_of(cameras, [room_depth(c) for c in cameras], 3)
    middles = view_middles(cameras, points, ROOM)
    # 45 degrees between the axes, centres 0.69 apart, at a wall some 2.3 away: at the middle of the room it would be 45 degrees.
    assert max(nearest_angles(cameras, middles)) < 35
    inward = [look_at((3 * np.cos(a), 3 * np.sin(a), 0), (0, 0, 0)) for a in np.radians([0, 20, 50])]
    none = SparsePoints(np.zeros((0, 3)), np.zeros((3, 0), bool), np.zeros(0, np.float32))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    assert nearest_angles(inward, view_middles(inward, none, box)) == pytest.approx([20, 20, 30])


@settings(max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_the_distance_transform_equals_its_twin(h, w, share, seed):
    sites = (np.random.default_rng(seed).random((h, w)) < share).astype(np.uint8)
    squared, nearest = _core.distance_transform(sites)
    if not sites.any():
        assert (squared == 2**32 - 1).all()
        assert (nearest == 2**32 - 1).all()
        return
    at = np.argwhere(sites)
    pixels = np.indices((h, w)).reshape(2, -1).T
    twin = ((pixels[:, None] - at[None]) ** 2).sum(-1).min(1)
    assert np.array_equal(squared.ravel(), twin)
    assert np.array_equal(((pixels - np.column_stack(np.divmod(nearest.ravel(), w))) ** 2).sum(1), twin)
    assert sites.ravel()[nearest].all()


@pytest.mark.parametrize("value", [0, 1])
def test_a_mask_without_a_border_is_far_from_it(value):
    distance = silhouette_distance(np.full((5, 7), value, np.uint8))
    assert (distance == (0.5 - 65536 if value else 65536 - 0.5)).all()


def ball_maps(ring):
    cameras, _, depths, masks = ring
    cut = [m.astype(np.uint8) * 255 for m in masks]
    maps = [DepthMap(d.astype(np.float32), m.astype(np.float32)) for d, m in zip(depths, masks)]
    return cameras, maps, cut


@pytest.mark.parametrize("width", [6, 12, 60])
def test_one_cut_mask_of_many_drills_no_hole(ring, width):
    cameras, maps, cut = ball_maps(ring)
    y, x = (int(v.mean()) for v in np.nonzero(cut[2]))
    bad = [m.copy() for m in cut]
    bad[2][y - width // 2 : y + width // 2, x - width // 2 : x + width // 2] = 0
    maps[2] = DepthMap(np.where(bad[2] > 0, maps[2].depth, 0).astype(np.float32), maps[2].confidence)
    box, config = np.array([[-0.7] * 3, [0.7] * 3]), VolumeConfig()
    whole, holed = (isosurface(fuse(maps, cameras, box, m, config)) for m in (cut, bad))
    voxel = 1.35 * 1.6 / 225
    assert cKDTree(holed.vertices).query(whole.vertices)[0].max() < 2 * voxel


def test_masks_that_nothing_contradicts_stay_as_they_are(ring):
    cameras, maps, cut = ball_maps(ring)
    # Depth as noisy as stereo's: half a pixel's footprint, and stray points in front that one view alone sees.
    rng = np.random.default_rng(1)
    noisy = []
    for m in maps:
        depth = m.depth + rng.normal(0, 0.0035, m.depth.shape)
        stray = rng.random(m.depth.shape) < 0.02
        noisy.append(DepthMap(np.where(m.depth > 0, np.where(stray, 0.8 * depth, depth), 0).astype(np.float32), m.confidence))
    repaired = repaired_masks(noisy, cameras, cut, 0.0096)
    # Points on the rim that the noise moved by two footprints and more: a few pixels at most.
    assert max(np.mean((r > 0) != (m > 0)) for r, m in zip(repaired, cut)) < 0.001


class Read(Sequence):
    """Items that are read when asked for; which ones were."""

    def __init__(self, items):
        self.items, self.asked = items, []

    def __len__(self):
        return len(self.items)

    def __getitem__(self, n):
        item = self.items[n]
        self.asked.append(n)
        return item


def test_tiles_read_the_maps_of_the_views_that_see_them():
    cameras = outward(8)
    maps = [DepthMap(d, np.full(d.shape, 0.6, np.float32)) for d in map(room_depth, cameras)]
    config = VolumeConfig(voxel=0.05)
    bounds = ROOM + np.array([[-0.3], [0.3]])
    whole = fuse(maps, cameras, bounds, None, config)
    lazy = Read([*maps, None])
    cameras.append(cameras[0])
    values = {tuple(c): v for c, v in zip(whole.coords.tolist(), whole.values)}
    asked, samples = [], 0
    for tile in fuse_tiles(lazy, cameras, bounds, None, replace(config, max_memory=whole.values.nbytes // 2)):
        asked.append(len(lazy.asked))
        for c, block in zip(tile.coords.tolist(), tile.values):
            known = np.isfinite(block)
            assert np.array_equal(block[known], values[tuple(c)][known])
            samples += known.sum()
    assert samples >= np.isfinite(whole.values).sum()
    # No tile of a quarter of the room lies before all cameras.
    assert len(asked) >= 4
    assert 0 < min(np.diff(asked)) < 8


BYTES = """
import hashlib, sys, cv2, numpy as np
cv2.setNumThreads(int(sys.argv[1]))
sys.path.insert(0, sys.argv[3])
from conftest import look_at, render_sphere
from mvcore.config import VolumeConfig
from mvcore.types import DepthMap
from mvcore import depth as stage
from mvcore.volume.tsdf import fuse
random = np.random.default_rng(int(sys.argv[2]))
held = []
def moved(a):  # a copy at another address modulo 64, and the heap stirred
    held.append(np.empty(int(random.integers(1, 5000)), np.uint8))
    raw = np.empty(a.nbytes + 64, np.uint8)
    start = int(random.integers(0, 64 // a.itemsize)) * a.itemsize
    out = raw[start : start + a.nbytes].view(a.dtype).reshape(a.shape)
    out[...] = a
    return out
cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.3), (0, 0, 0), (96, 72), 90.0) for a in np.radians([0, 15, 30, 45])]
views = []
for c in cameras:
    image, _, mask = render_sphere(c)
    image = moved(image)
    views.append((stage.View(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), c, image, None), moved(mask.astype(np.uint8))))
only = [v for v, _ in views]
total = hashlib.sha256()
rough = [stage.sweep_depth(v, [o for o in only if o is not v], 1.0, 7.0) for v in only]
maps = []
for n, v in enumerate(only):
    near = [k for k in range(4) if k != n]
    d = stage.refine_depth(v, [only[k] for k in near], rough[n], [rough[k] for k in near])
    d = stage.guided_depth(v, [only[k] for k in near], d, rough[n], moved(d.depth))
    maps.append(DepthMap(moved(d.depth), moved(d.confidence)))
kept = [stage.filter_depth(n, maps, cameras, [k for k in range(4) if k != n])[0] for n in range(4)]
for d in maps + kept:
    total.update(np.ascontiguousarray(d.depth).tobytes() + np.ascontiguousarray(d.confidence).tobytes())
masked = [DepthMap(moved(np.where(m > 0, k.depth, 0).astype(np.float32)), moved(k.confidence)) for k, (_, m) in zip(kept, views)]
volume = fuse(masked, cameras, np.array([[-0.7] * 3, [0.7] * 3]), [m for _, m in views], VolumeConfig())
total.update(volume.values.tobytes() + volume.coords.tobytes())
print(total.hexdigest())
"""


def test_depth_and_fusion_give_the_same_bytes_at_any_address_and_for_any_threads():
    def digest(threads, seed):
        env = os.environ | {"RAYON_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
        env["PYTHONPATH"] = os.pathsep.join(sys.path)
        command = [sys.executable, "-c", BYTES, str(threads), str(seed), os.path.dirname(__file__)]
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    assert len({digest(threads, seed) for threads, seed in ((1, 0), (2, 1), (4, 2))}) == 1


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_systems_are_solved(n, seed):
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(n, n)) + n * np.eye(n), rng.normal(size=(n, 2))
    shuffled = rng.permutation(n)  # so that pivots lie off the diagonal
    assert np.allclose(matrix[shuffled] @ solve(matrix[shuffled], right), right)
    assert np.allclose(solve(matrix, right[:, 0]), solve(matrix, right)[:, 0])
    assert np.allclose(weighted_sum(right, right[:, 0]), right.T @ right[:, 0])
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.zeros((n, n)), right)
