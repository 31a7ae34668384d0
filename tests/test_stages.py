from dataclasses import replace

import cv2
import mvcore
import numpy as np
import pytest
import reference
from conftest import look_at
from hypothesis import given, settings
from hypothesis import strategies as st
from mvcore import _core
from mvcore.config import Config, DepthConfig, SurfaceConfig, VolumeConfig
from mvcore.depth import (
    View,
    estimate_depth,
    filter_depth,
    guided_depth,
    refine_depth,
    seeded_depth,
    sweep_depth,
)
from mvcore.depth.stereo import _speckles
from mvcore.errors import InvalidInputError, ReconstructionError
from mvcore.geometry.epipolar import fundamental
from mvcore.geometry.rig import common_volume, convergence, surrounds
from mvcore.io.images import read_image
from mvcore.mesh.surface import (
    Surface,
    cleaned,
    decimate,
    drop_small_parts,
    drop_unseen,
    extract_surface,
    isosurface,
    marching_cubes,
    smooth,
)
from mvcore.silhouettes.occluder_repair import repaired_masks
from mvcore.sparse.calibration_check import CalibrationError, calibration_error, check_calibration
from mvcore.sparse.features import candidate_pairs, detect
from mvcore.sparse.points import find_points, match_and_triangulate
from mvcore.sparse.view_selection import choose_sources, depth_ranges, search_box, view_scores
from mvcore.types import DepthMap, Report, SparsePoints
from mvcore.volume.hull_prior import hull_share, silhouette_distance
from mvcore.volume.tsdf import Volume, _Fusion, fuse, fuse_tiles


def test_unknown_settings_name_the_nearest():
    with pytest.raises(InvalidInputError, match="did you mean 'footprints'"):
        Config.from_dict({"volume": {"footprint": 2}})
    with pytest.raises(InvalidInputError, match="matcher"):
        Config.from_dict({"matcher": "magic"})
    assert Config.from_dict({"depth": {"planes": 64}}).depth.planes == 64


def test_the_fundamental_matrix_puts_points_on_lines():
    a, b = look_at((2, 0, 0.3), (0, 0, 0)), look_at((1.7, 1, 0.2), (0, 0, 0))
    p = np.random.default_rng(0).normal(size=(20, 3)) * 0.2
    x, y = (np.column_stack([c.project(p), np.ones(20)]) for c in (a, b))
    assert np.abs(np.einsum("ni,ij,nj->n", y, fundamental(a, b), x)).max() < 1e-9


def test_points_ranges_and_box_of_a_ring(ring):
    cameras, images, depths, _ = ring
    report = Report()
    points = find_points(images, cameras, report=report)
    assert len(points) > 40
    radius = np.linalg.norm(points.positions, axis=1)
    assert np.median(np.abs(radius[radius < 1] - 0.5)) < 0.005
    assert surrounds(cameras)
    assert np.allclose(convergence(cameras), 0, atol=1e-6)
    box = search_box(cameras, points)
    assert (box[0] < -0.5).all()
    assert (box[1] > 0.5).all()
    for (near, far), depth in zip(depth_ranges(cameras, points, box, 0.25, False), depths):
        assert near < depth[depth > 0].min()
        assert far > depth.max()
    sources = choose_sources(view_scores(cameras, points, box, DepthConfig()), 4)
    assert {sources[3][0], sources[3][1]} == {2, 4}


def test_a_wrong_calibration_is_refused_and_a_doubtful_one_is_said(sample):
    scene = mvcore.load(sample)
    cameras = list(scene.calib)
    features = [detect(read_image(f), None, 2000) for f in scene.frames]
    pairs = candidate_pairs(cameras, 6)

    def check(degrees):
        r = cv2.Rodrigues(np.radians(degrees) * np.array([0.8, 0.5, 0.3]))[0]
        turned = [mvcore.Camera(c.K, (r if n % 2 else r.T) @ c.R, c.t, c.width, c.height) for n, c in enumerate(cameras)]
        report, config = Report(), Config().sparse
        error = calibration_error(turned, features, pairs)
        points = match_and_triangulate(turned, features, pairs, config.band, config)
        check_calibration(error, points, turned, config, report)
        return report

    assert not check(0.0).warnings
    assert "doubtful" in check(0.25).warnings[0]
    with pytest.raises(ReconstructionError, match="does not fit the images"):
        check(2.0)


def test_a_pattern_that_repeats_does_not_refuse_a_calibration_that_many_points_fit(ring):
    cameras = ring[0][:4]
    config, wrong = Config().sparse, CalibrationError(30.0, [30.0] * 4, np.repeat([1.0, 30.0], [20, 100]))

    def check(points, views):
        visible = np.zeros((4, points), bool)
        visible[:views] = True
        report = Report()
        check_calibration(wrong, SparsePoints(np.zeros((points, 3)), visible, np.zeros(points, np.float32)), cameras, config, report)
        return report

    assert "50 points of three and more views fit it" in check(50, 3).warnings[0]
    for points, views in ((49, 3), (200, 2), (0, 3)):
        with pytest.raises(ReconstructionError, match="does not fit the images"):
            check(points, views)


def test_textureless_scenes_fall_back_to_the_common_volume(ring):
    cameras = ring[0]
    grey = [np.full((c.height, c.width, 3), 90, np.uint8) for c in cameras]
    report = Report()
    points = find_points(grey, cameras, report=report)
    assert len(points) == 0
    box = search_box(cameras, points)
    assert np.allclose(box, common_volume(cameras))
    assert "too few sure matches" in report.warnings[0]


def test_depth_of_a_sphere_and_its_filter(ring):
    cameras, images, depths, masks = ring
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c) for i, c in zip(images, cameras)]
    found = [estimate_depth(views[n], [views[j % 12] for j in (n - 2, n - 1, n + 1, n + 2)], 1.2, 2.6) for n in range(12)]
    share, kept, right = [], [], []
    for n in range(12):
        want = masks[n]
        share.append((np.abs(found[n].depth - depths[n]) < 0.01 * depths[n])[want].mean())
        filtered, support = filter_depth(n, found, cameras, [(n - 1) % 12, (n + 1) % 12])
        on = want & (filtered.depth > 0)
        kept.append(on.sum() / want.sum())
        right.append((np.abs(filtered.depth - depths[n]) < 0.01 * depths[n])[on].mean())
        assert ((support > 0) == (filtered.depth > 0)).all()
    assert np.mean(share) > 0.8
    assert np.mean(kept) > 0.5
    assert np.mean(right) > 0.95


def test_an_expected_surface_seeds_the_depth_and_a_wrong_one_does_no_harm(ring):
    cameras, images, depths, masks = ring
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c) for i, c in zip(images, cameras)]
    sources = [views[j] for j in (10, 11, 1, 2)]

    def share(rough):
        found = refine_depth(views[0], sources, rough, ())
        return (np.abs(found.depth - depths[0]) < 0.01 * depths[0])[masks[0]].mean()

    config = DepthConfig()
    known = np.where(masks[0], depths[0], 0).astype(np.float32)
    nearly = np.where(masks[0], depths[0] + 0.03 * np.sin(np.arange(depths[0].shape[1]) / 9.0), 0).astype(np.float32)
    swept = share(sweep_depth(views[0], sources, 1.2, 2.6, config))
    assert share(seeded_depth(views[0], sources, 1.2, 2.6, known, config)) > swept - 0.02
    assert share(seeded_depth(views[0], sources, 1.2, 2.6, nearly, config)) > swept - 0.02
    wrong = np.where(masks[0], 2.4, 0).astype(np.float32)
    assert share(seeded_depth(views[0], sources, 1.2, 2.6, wrong, config)) > swept - 0.05
    assert share(seeded_depth(views[0], sources, 1.2, 2.6, np.zeros_like(known), config)) == swept
    # With few planes the sweep misses the surface; what is expected carries it.
    few = replace(config, planes=6)
    assert share(seeded_depth(views[0], sources, 1.2, 2.6, known, few)) > share(sweep_depth(views[0], sources, 1.2, 2.6, few))
    with pytest.raises(InvalidInputError, match="seed"):
        seeded_depth(views[0], sources, 1.2, 2.6, known[:-1], config)


def test_the_surface_of_all_views_mends_a_views_depth_and_a_wrong_one_does_no_harm(ring):
    cameras, images, depths, masks = ring
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c) for i, c in zip(images, cameras)]
    sources = [views[j] for j in (10, 11, 1, 2)]
    rough = sweep_depth(views[0], sources, 1.2, 2.6)
    alone = refine_depth(views[0], sources, rough, ())
    h, w = masks[0].shape
    true = np.where(masks[0], depths[0], 0).astype(np.float32)

    def guided(found, surface):
        return guided_depth(views[0], sources, DepthMap(found, alone.confidence), rough, surface)

    def error(found):
        return np.abs(found.depth - depths[0])[masks[0]] / depths[0][masks[0]]

    # A patch that the view took for something else comes back; elsewhere the surface's accuracy is not lost.
    spoilt = alone.depth.copy()
    spoilt[h // 2 - 15 : h // 2 + 15, w // 2 - 15 : w // 2 + 15] = 2.4
    assert (error(DepthMap(spoilt, alone.confidence)) < 0.01).mean() < (error(alone) < 0.01).mean() - 0.05
    mended = guided(spoilt, true)
    assert (error(mended) < 0.01).mean() > (error(alone) < 0.01).mean() + 0.02
    assert np.median(error(mended)) <= np.median(error(alone))
    # Photographs speak against a surface that stands off, and its absence changes little.
    for surface in (np.where(masks[0], 2.4, 0).astype(np.float32), np.zeros_like(true)):
        kept = guided(alone.depth, surface)
        assert (error(kept) < 0.01).mean() > (error(alone) < 0.01).mean() - 0.03
    assert (guided(np.zeros_like(true), np.zeros_like(true)).depth == 0).all()
    with pytest.raises(InvalidInputError, match="surface"):
        guided(alone.depth, true[:-1])


def test_depth_is_looked_for_where_the_mask_wants_it(ring):
    cameras, images, depths, masks = ring
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c) for i, c in zip(images, cameras)]
    sources = [views[j] for j in (10, 11, 1, 2)]
    left = (np.arange(masks[0].shape[1]) < masks[0].shape[1] // 2)[None] & masks[0]
    asked = replace(views[0], mask=left.astype(np.uint8))
    everywhere, here = (estimate_depth(v, sources, 1.2, 2.6) for v in (views[0], asked))
    right = [(np.abs(d.depth - depths[0]) < 0.01 * depths[0])[left].mean() for d in (everywhere, here)]
    assert right[1] > right[0] - 0.02
    away = cv2.dilate(left.astype(np.uint8), np.ones((61, 61), np.uint8)) == 0
    assert away.any()
    assert (here.depth[away] == 0).all()
    assert (here.confidence[here.depth == 0] == 0).all()


def test_black_pictures_have_no_depth(ring):
    cameras, images, _, masks = ring
    night = [
        np.where((np.arange(240) < 70)[None, :, None], np.random.default_rng(n).integers(0, 8, i.shape), i) for n, i in enumerate(images)
    ]
    views = [View(cv2.cvtColor(i.astype(np.uint8), cv2.COLOR_RGB2GRAY), c, i.astype(np.uint8)) for i, c in zip(night, cameras)]
    views[0].colour[60:80, 100:120] = (0, 0, 60)  # hardly any grey, but seen
    found = estimate_depth(views[0], [views[j] for j in (10, 11, 1, 2)], 1.2, 2.6)
    assert (found.depth[:, :69] == 0).all()
    assert (found.confidence[:, :69] == 0).all()
    assert (found.depth[:, 72:] > 0)[masks[0][:, 72:]].mean() > 0.99


def test_burnt_out_pictures_have_no_depth_and_glints_do(ring):
    cameras, images, _, masks = ring
    light = np.where((np.arange(240) < 70)[None, :, None], np.random.default_rng(1).integers(251, 256, images[0].shape), images[0])
    light = light.astype(np.uint8)
    light[76:92, 116:132] = 255  # a glint
    light[120:160, 10:50, 2] = 240  # a bright colour
    views = [View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c, i) for i, c in zip([light, *images[1:]], cameras)]
    found = estimate_depth(views[0], [views[j] for j in (10, 11, 1, 2)], 1.2, 2.6)
    assert (found.depth[:104, :54] == 0).all()
    assert (found.confidence[:104, :54] == 0).all()
    assert (found.depth[120:160, 10:50] > 0).all()
    assert (found.depth[:, 71:] > 0)[masks[0][:, 71:]].mean() > 0.99


def test_depth_needs_sources_and_a_range(ring):
    cameras, images, _, _ = ring
    view = View(cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY), cameras[0])
    with pytest.raises(InvalidInputError, match="sources"):
        estimate_depth(view, [], 1, 2)
    with pytest.raises(InvalidInputError, match="near, far"):
        estimate_depth(view, [view], 2, 1)


def test_consistency_equals_its_twin():
    cameras = [look_at((x, -3.0, 0.1 * x), (x, 0, 0), (24, 18), 30.0) for x in (0.0, 0.3, -0.3)]
    rng = np.random.default_rng(1)
    maps = [np.where(rng.random((18, 24)) < 0.3, 3.6, 3.0).astype(np.float32) for _ in cameras]
    maps[0][3, 4] = 0
    there = np.stack([mvcore.geometry.cameras.relative_map(cameras[0], c) for c in cameras[1:]])
    back = np.stack([mvcore.geometry.cameras.relative_map(c, cameras[0]) for c in cameras[1:]])
    for min_views in (1, 2):
        # 20 % steps: no two taps of a bilinear sample mix, so the nearest pixel decides in both
        kept, _ = _core.consistency(maps[0], maps[1:], there, back, min_views, 0.5, 0.05)
        twin = reference.consistency(maps[0], maps[1:], cameras, 0.5, 0.05, min_views)
        same = (kept > 0) == (twin > 0)
        assert same.mean() > 0.99  # rounding decides a pixel or two at ties
        assert 0.1 < (kept > 0).mean() < 0.9


def test_fusion_equals_its_twin(ring):
    cameras, _, depths, _ = ring
    maps = [DepthMap(d.astype(np.float32), np.ones(d.shape, np.float32)) for d in depths]
    bounds = np.array([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])
    config = VolumeConfig(voxel=0.03, free_weight=0.5, min_weight=0.0, truncation=4.0, smoothing=0.0)
    volume = fuse(maps, cameras, bounds, config=config)
    local = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = volume.origin + volume.voxel * (volume.coords[:, None].astype(float) * 8 + local).reshape(-1, 3)
    # The twin samples the nearest pixel and weighs all views alike: compare where weights are alike and the surface is smooth.
    twin = reference.tsdf(points, depths, cameras, 4 * volume.voxel, 0.5)
    ours = volume.values.reshape(-1)
    both = np.isfinite(twin) & np.isfinite(ours) & (np.linalg.norm(points, axis=1) < 0.62)
    assert both.sum() > 1000
    assert np.median(np.abs(twin - ours)[both]) < 0.05
    surface = extract_surface(volume, SurfaceConfig(decimation=0))
    radius = np.linalg.norm(surface.vertices, axis=1)
    assert np.abs(radius - 0.5).mean() < 0.1 * volume.voxel


def test_silhouettes_alone_give_the_hull(ring):
    cameras, _, _, masks = ring
    nothing = [DepthMap(np.zeros(m.shape, np.float32), np.zeros(m.shape, np.float32)) for m in masks]
    cut = [(m * 255).astype(np.uint8) for m in masks]
    bounds = np.array([[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]])
    surface = extract_surface(fuse(nothing, cameras, bounds, cut, VolumeConfig(voxel=0.03)))
    radius = np.linalg.norm(surface.vertices, axis=1)
    assert radius.min() > 0.48
    assert np.median(radius) < 0.53


def test_few_depths_do_not_overrule_silhouettes_and_many_do(ring):
    cameras, _, depths, masks = ring
    cut = [(m * 255).astype(np.uint8) for m in masks]
    bounds = np.array([[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]])
    # All views have a dent on one side: its middle lies 0.1 deeper than the ball's surface.
    dents = []
    for camera, depth, mask in zip(cameras, depths, masks):
        points = camera.unproject(camera.pixel_grid().reshape(-1, 2), np.maximum(depth, 1e-3).ravel()).reshape(*depth.shape, 3)
        dents.append(mask & (points[..., 0] > 0.35))

    def radii(known, confidence):
        maps = [
            DepthMap(np.where(k, d + 0.1 * t, 0).astype(np.float32), np.full(d.shape, confidence, np.float32))
            for k, d, t in zip(known, depths, dents)
        ]
        v = extract_surface(fuse(maps, cameras, bounds, cut, VolumeConfig(voxel=0.03))).vertices
        return np.linalg.norm(v[v[:, 0] > 0.42], axis=1)

    chance = [t & (np.random.default_rng(n).random(t.shape) < 0.1) for n, t in enumerate(dents)]
    assert np.median(radii(chance, 0.5)) > 0.47
    # Where all of the target was measured even doubtful depths make the dent.
    assert len(radii(masks, 0.1)) < 0.5 * len(radii(chance, 0.1))


@pytest.mark.parametrize("post", [0, 6])
def test_an_occluder_in_a_mask_is_found_by_the_other_views_depth(ring, post):
    cameras, _, depths, masks = ring
    maps = [DepthMap(d.astype(np.float32), np.ones(d.shape, np.float32)) for d in depths]
    cut = [(m * 255).astype(np.uint8) for m in masks]
    whole = cut[0].copy()
    y, x = (int(v.mean()) for v in np.nonzero(whole))
    half = max(12, int(0.25 * np.sqrt(whole.astype(bool).sum())))
    cut[0][y - half : y + half, x - half : x + half] = 0
    if post:  # A sign on a post: the slit is open at the lower end.
        cut[0][y:, x - post : x + post + 1] = 0
    maps[0] = DepthMap(np.where(cut[0] > 0, maps[0].depth, 0).astype(np.float32), maps[0].confidence)
    repaired = repaired_masks(maps, cameras, cut, 1.35 * 1.6 / 225)
    lost = (whole > 0) & (cut[0] == 0)
    assert (repaired[0] > 0)[lost].mean() > 0.9
    below = lost[y + half + 2 :]
    # The ball's rim, which the others see aslant, has few points.
    assert not post or (repaired[0] > 0)[y + half + 2 :][below].mean() > 0.6
    assert (repaired[0] > 0)[whole == 0].mean() < 0.01
    assert all(((r > 0) == (m > 0)).all() for r, m in zip(repaired[1:], cut[1:]))


def test_silhouette_distance_is_signed_pixels():
    mask = np.zeros((9, 9), np.uint8)
    mask[:, 4:] = 255
    assert silhouette_distance(mask)[4].tolist() == [3.5, 2.5, 1.5, 0.5, -0.5, -1.5, -2.5, -3.5, -4.5]


def test_voxels_grow_until_the_memory_suffices(ring):
    cameras, _, depths, _ = ring
    maps = [DepthMap(d.astype(np.float32), np.ones(d.shape, np.float32)) for d in depths]
    report = Report()
    bounds = np.array([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])
    fuse(maps, cameras, bounds, config=VolumeConfig(voxel=0.01, max_memory=1 << 20), report=report)
    assert "voxels grew" in report.warnings[0]
    with pytest.raises(ReconstructionError, match="inside the bounds"):
        fuse(maps, cameras, bounds + 100, config=VolumeConfig(voxel=0.03))


@pytest.mark.parametrize("cut", [False, True])
def test_tiles_join_to_the_surface_of_the_whole(ring, cut):
    cameras, _, depths, masks = ring
    maps = [DepthMap(d.astype(np.float32), np.ones(d.shape, np.float32)) for d in depths]
    given = [(m * 255).astype(np.uint8) for m in masks] if cut else None
    bounds = np.array([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])
    config, report = VolumeConfig(voxel=0.02), Report()
    whole = fuse(maps, cameras, bounds, given, config)
    tiles = list(fuse_tiles(maps, cameras, bounds, given, replace(config, max_memory=2 * whole.values.nbytes // 3), report))
    assert len(tiles) > 2
    assert report.values["volume"]["tiles"] == len(tiles)
    assert report.values["volume"]["voxel"] == whole.voxel
    assert not report.warnings
    # Shared samples are the same bits: every known sample of a tile is the whole's.
    slot = {tuple(c): n for n, c in enumerate(whole.coords.tolist())}
    for tile in tiles:
        same = whole.values[[slot[tuple(c)] for c in tile.coords.tolist()]]
        known = np.isfinite(tile.values)
        assert (tile.values[known] == same[known]).all()
    one, joined = isosurface(whole), isosurface(tiles)

    def triangles(surface):
        """Each triangle from its least corner on, in order."""
        corners = [[tuple(c) for c in t] for t in surface.vertices[surface.faces].tolist()]
        return sorted(min((a, b, c), (b, c, a), (c, a, b)) for a, b, c in corners)

    assert len(joined.vertices) == len(one.vertices)
    assert triangles(joined) == triangles(one)
    with pytest.raises(ReconstructionError, match="max_memory"):
        list(fuse_tiles(maps, cameras, bounds, given, replace(config, max_memory=1000)))


@settings(max_examples=30)
@given(st.tuples(*[st.integers(2, 20)] * 3), st.integers(0, 2**32 - 1))
def test_marching_cubes_equals_the_sparse_form_and_stays_inside(shape, seed):
    values = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    vertices, faces = marching_cubes(values)
    assert (vertices >= 0).all()
    assert (vertices <= np.array(shape) - 1).all()
    assert len(faces) == 0 or faces.max() < len(vertices)
    blocks = tuple(-(-n // 8) for n in shape)
    padded = np.full([8 * b for b in blocks], np.nan, np.float32)
    padded[: shape[0], : shape[1], : shape[2]] = values
    coords = np.ascontiguousarray(np.argwhere(np.ones(blocks, bool)), np.uint32)
    cut = padded.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 8, 8, 8)
    sparse_vertices, sparse_faces = _core.isosurface_sparse(coords, np.ascontiguousarray(cut))
    assert (sparse_vertices == vertices).all()
    assert (sparse_faces == faces).all()


def test_marching_cubes_refuses_another_shape():
    with pytest.raises(InvalidInputError, match="values"):
        marching_cubes(np.zeros((3, 3), np.float32))


def ball(n=40, radius=14.0):
    x = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float32)] * 3, indexing="ij")) - (n - 1) / 2
    vertices, faces = marching_cubes(np.sqrt((x**2).sum(0)) - radius)
    return Surface(vertices.astype(np.float64), faces)


def test_small_parts_are_dropped():
    large, small = ball(), ball(16, 3.0)
    both = Surface(
        np.concatenate([large.vertices, small.vertices + 100]),
        np.concatenate([large.faces, small.faces + len(large.vertices)]).astype(np.uint32),
    )
    assert len(drop_small_parts(both, 0.2).faces) == len(large.faces)
    assert len(drop_small_parts(both, 0.0).faces) == len(both.faces)


def test_small_holes_are_closed_unless_the_settings_say_otherwise():
    x, y, z = np.mgrid[-20:20, -20:20, -20:20].astype(np.float32)
    vertices, faces = marching_cubes(np.sqrt(x**2 + y**2 + z**2) - 14.3)
    middles = vertices[faces].mean(1) - 20
    small, large = np.linalg.norm(middles - (14.3, 0, 0), axis=1) < 3, middles[:, 0] < -6
    open_ = Surface(vertices.astype(np.float64), np.ascontiguousarray(faces[~small & ~large]))
    closed = cleaned(open_, 1.0, SurfaceConfig(close_holes=40, decimation=0))
    assert (closed.vertices[closed.faces[: len(open_.faces)]] == open_.vertices[open_.faces]).all()
    added = closed.vertices[closed.faces[len(open_.faces) :]].mean(1) - 20
    assert len(added) > 20
    assert (np.linalg.norm(added - (14.3, 0, 0), axis=1) < 4).all()  # the large one stays
    assert np.abs(np.linalg.norm(added, axis=1) - 14.3).max() < 0.7
    assert len(cleaned(open_, 1.0, SurfaceConfig(close_holes=0, decimation=0)).faces) == len(open_.faces)


def test_smoothing_keeps_the_volume_and_decimation_the_shape():
    surface = ball()
    noisy = Surface(surface.vertices + np.random.default_rng(0).normal(0, 0.2, surface.vertices.shape), surface.faces)
    center = surface.vertices.mean(0)
    radius = np.linalg.norm(smooth(noisy, 10).vertices - center, axis=1)
    assert radius.std() < 0.5 * np.linalg.norm(noisy.vertices - center, axis=1).std()
    assert abs(radius.mean() - 14) < 0.1
    small = decimate(surface, max_faces=500)
    assert 300 < len(small.faces) <= 510
    assert np.abs(np.linalg.norm(small.vertices - center, axis=1) - 14).max() < 0.5


def test_an_empty_field_is_an_error():
    volume = Volume(np.zeros(3), 1.0, (8, 8, 8), np.zeros((1, 3), np.uint32), np.ones((1, 8, 8, 8), np.float32))
    with pytest.raises(ReconstructionError, match="no surface"):
        extract_surface(volume, SurfaceConfig())


def test_chance_patches_of_a_disparity_map_are_told_from_thin_things():
    d = np.full((60, 80), 8.0, np.float32)
    d[10:13, 10:13] = 20
    d[5:55, 40] = 20
    marked = _speckles(d)
    assert marked[10:13, 10:13].all()
    assert marked.sum() == 9
    assert not _speckles(np.linspace(0, 40, 60 * 80, dtype=np.float32).reshape(60, 80)).any()
    assert not _speckles(np.full((4, 5), 1e5, np.float32)).any()


@pytest.mark.parametrize("slack", [0.0, 0.8])
def test_the_weighted_median_equals_its_twin(slack):
    random = np.random.default_rng(5)
    values = random.normal(3, 1, (19, 23)).astype(np.float32)
    values[random.random(values.shape) < 0.15] = np.nan
    guide = random.integers(0, 255, (19, 23, 3), np.uint8)
    doubtful = (random.random(values.shape) < 0.3).astype(np.uint8)
    settings = {"radius": 4, "step": 2, "colour": 30.0, "distance": 2.5, "slack": slack}
    found = _core.weighted_median(values, guide, doubtful, **settings)
    assert np.allclose(found, reference.weighted_median(values, guide, doubtful, **settings), equal_nan=True)
    with pytest.raises(ValueError, match="guide"):
        _core.weighted_median(values, guide[:, :-1].copy(), doubtful, **settings)


def test_disparities_have_their_edges_where_the_picture_has_them(monkeypatch):
    """A disc before a wall: windows fatten it; the median by colours takes most of that off again."""
    random = np.random.default_rng(1)
    wall, front = (cv2.resize(random.integers(lo, hi, (60, 90, 3), np.uint8), (270, 180)) for lo, hi in ((20, 110), (120, 240)))
    truth = np.full((180, 240), 6, np.float32)
    disc = np.hypot(*np.mgrid[-90:90, -120:120]) < 45
    truth[disc] = 20
    rows, columns = np.mgrid[:180, :240]
    left = np.where(disc[..., None], front[rows, columns], wall[rows, columns + 10])
    shown = np.roll(disc, -20, 1)  # where the right picture shows the disc
    right = np.where(shown[..., None], front[rows, np.minimum(columns + 20, 269)], wall[rows, np.minimum(columns + 16, 269)])
    seen = (columns > 24) & (np.hypot(*np.mgrid[-90:90, -120:120]) < 70)

    def bad():
        found, _ = mvcore.disparity(left, right, max_disparity=32)
        return float((np.abs(found - truth) > 2)[seen].mean())

    sharp = bad()
    monkeypatch.setattr("mvcore.depth.stereo.MEDIAN_ROUNDS", 0)
    assert sharp < 0.6 * bad()
    assert sharp < 0.03


def test_a_ball_fills_its_hull_and_a_dented_one_does_not(ring):
    cameras, _, depths, masks = ring
    outlines = [m.astype(np.uint8) for m in masks]
    ball = [DepthMap(d.astype(np.float32), m.astype(np.float32)) for d, m in zip(depths, masks)]
    assert hull_share(ball, cameras, outlines) > 0.95
    # Every view sees a deep dent in the middle of its picture.
    inner = [cv2.erode(m, np.ones((25, 25), np.uint8)) > 0 for m in outlines]
    dented = [DepthMap(np.where(i, d + 0.2, d).astype(np.float32), m.astype(np.float32)) for d, m, i in zip(depths, masks, inner)]
    share = np.mean([i.sum() / m.sum() for i, m in zip(inner, masks)])
    # Near the ball's outline in another view a dent may meet the hull again.
    assert hull_share(dented, cameras, outlines) == pytest.approx(1 - share, abs=0.1)
    # What is hardly believed hardly counts.
    doubted = [DepthMap(v.depth, np.where(i, 0.1, v.confidence).astype(np.float32)) for v, i in zip(dented, inner)]
    assert hull_share(doubted, cameras, outlines) > 0.9
    nothing = [DepthMap(np.zeros_like(v.depth), np.zeros_like(v.depth)) for v in ball]
    assert hull_share(nothing, cameras, outlines) == 1
    # With the same pixels unmeasured the dented one is dug out at less weight.
    open_rows = [np.where(np.arange(180)[:, None] < 80, 0, 1).astype(np.float32)] * len(cameras)
    box = np.array([[-0.7] * 3, [0.7] * 3])
    weights = []
    for maps in (ball, dented):
        seen = [DepthMap(v.depth * o, v.confidence * o) for v, o in zip(maps, open_rows)]
        weights.append(_Fusion.of(seen, cameras, box, outlines, VolumeConfig(), None, None).solid_weight)
    assert 0 < weights[1] < 0.6 * weights[0]


def test_a_hollow_volume_has_the_surface_of_the_full_one(ring):
    cameras, _, depths, _ = ring
    maps = [DepthMap(d.astype(np.float32), (d > 0).astype(np.float32)) for d in depths]
    cut = [(d > 0).astype(np.uint8) * 255 for d in depths]
    bounds = np.array([[-0.7] * 3, [0.7] * 3])
    config = VolumeConfig(voxel=0.008)
    full = fuse(maps, cameras, bounds, cut, config)
    (hollow,) = fuse_tiles(maps, cameras, bounds, cut, config)
    assert len(hollow.coords) < len(full.coords)
    one, two = (extract_surface(v) for v in (full, hollow))
    assert np.array_equal(one.vertices, two.vertices)
    assert np.array_equal(one.faces, two.faces)


def test_a_hull_that_no_camera_sees_is_not_made_and_what_one_sees_stays_the_same(ring):
    # Three neighbours: most of the hull lies behind. Half of what they see is measured.
    cameras, depths = ring[0][:3], ring[2][:3]
    half = np.arange(cameras[0].width) < cameras[0].width // 2
    maps = [DepthMap(np.where(half, d, 0).astype(np.float32), (half & (d > 0)).astype(np.float32)) for d in depths]
    masks = [(d > 0).astype(np.uint8) * 255 for d in depths]
    bounds, config = np.array([[-0.9] * 3, [0.9] * 3]), VolumeConfig(voxel=0.006)
    whole, part = (list(fuse_tiles(maps, cameras, bounds, masks, config, unseen_reach=reach)) for reach in (None, 1.0))
    assert sum(len(v.coords) for v in part) < 0.75 * sum(len(v.coords) for v in whole)
    full = isosurface(whole)
    seen, less = (drop_unseen(s, cameras, config.voxel, 1.0) for s in (full, isosurface(part)))
    missing, _ = _core.nearest(seen.vertices, np.ascontiguousarray(less.vertices))
    assert len(seen.vertices) > 10_000
    assert (missing < 1e-9).mean() > 0.99
    # Smoothing lacks its surroundings where blocks were left out.
    moved, _ = _core.nearest(less.vertices, np.ascontiguousarray(full.vertices))
    assert moved.max() < 2 * config.voxel
