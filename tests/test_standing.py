"""Silhouettes of what stands on the ground, found without masks, and what they do for the surface."""

from dataclasses import replace

import mvcore
import numpy as np
import pytest
import trimesh
from conftest import look_at, texture_of
from mvcore import _core
from mvcore.config import Config, StandingConfig, SurfaceConfig, VolumeConfig
from mvcore.geometry.cameras import Camera
from mvcore.mesh.surface import Surface, drop_cavities, drop_unseen, extract_surface
from mvcore.silhouettes import object_segmentation as standing
from mvcore.silhouettes.object_segmentation import Plane, find_standing, ground, widest_gap
from mvcore.types import DepthMap, Report
from mvcore.volume.tsdf import fuse_tiles

BOUNDS = np.array([[-0.8, -0.8, -0.2], [0.8, 0.8, 1.0]])
FLOOR = -0.05
"""The world's z of the ground; the ball of radius 0.4 around z = 0.34 stands on it."""


def plain_ball(camera: Camera, paint=(230, 190, 30)):
    """An evenly painted ball on a patterned ground: image, depth, mask."""
    grid = camera.pixel_grid().reshape(-1, 2)
    rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(camera.K).T @ camera.R
    o, to = camera.center, camera.center - (0, 0, 0.34)
    a, b, c = (rays**2).sum(1), rays @ to, to @ to - 0.4**2
    root = b * b - a * c
    hit = root > 0
    ball = (-b - np.sqrt(root.clip(0))) / a
    floor = np.where(rays[:, 2] < 0, (FLOOR - o[2]) / np.minimum(rays[:, 2], -1e-9), 0)
    depth = np.where(hit, ball, floor)
    points = o + rays * depth[:, None]
    light = 0.7 + 0.3 * ((points - (0, 0, 0.34)) / 0.4) @ np.array([0.5, 0.2, 0.8])
    image = np.where(hit[:, None], light[:, None] * paint, texture_of(points * 0.7) * [0.5, 0.6, 0.8])
    shape = (camera.height, camera.width)
    return np.clip(image, 0, 255).astype(np.uint8).reshape(*shape, 3), depth.reshape(shape), hit.reshape(shape)


@pytest.fixture(scope="module")
def stand():
    """Twelve views all around; depth maps know all of the ground and a tenth of the ball, in patches."""
    angles = np.radians(np.arange(0, 360, 30))
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 1.0 + 0.4 * (i % 2)), (0, 0, 0.3)) for i, a in enumerate(angles)]
    images, depths, masks = zip(*(plain_ball(c) for c in cameras))
    random = np.random.default_rng(0)
    maps = []
    for d, m in zip(depths, masks):
        coarse = random.random((d.shape[0] // 12, d.shape[1] // 12)) < 0.1
        patches = np.kron(coarse, np.ones((12, 12), bool))
        known = np.where(m & ~patches, 0, d).astype(np.float32)
        maps.append(DepthMap(known, np.ones(d.shape, np.float32)))
    return cameras, list(images), maps, list(masks)


def test_the_ground_is_found_among_what_stands_on_it():
    random = np.random.default_rng(1)
    flat = np.column_stack([random.uniform(-1, 1, (400, 2)), random.normal(0, 0.002, 400)])
    above = random.uniform((-0.3, -0.3, 0), (0.3, 0.3, 0.8), (500, 3))
    cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 1), (0, 0, 0.3)) for a in (0, 2, 4)]
    plane = ground(np.concatenate([flat, above]), cameras, 0.01, 0.3)
    assert plane.normal @ (0, 0, 1) > 0.9999
    assert abs(plane.offset) < 0.002
    assert ground(above, cameras, 0.01, 0.3) is None
    assert ground(flat[:2], cameras, 0.01, 0.3) is None
    assert ground(np.concatenate([flat, above - (0, 0, 1)]), cameras, 0.01, 0.3) is None  # as much lies under it


def test_the_widest_gap_is_seen_from_above():
    plane = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
    cameras = [look_at((np.cos(a), np.sin(a), 0.7), (0, 0, 0)) for a in np.radians([0, 40, 170, 200])]
    assert widest_gap(cameras, np.zeros(3), plane) == pytest.approx(160)


def test_silhouettes_are_found_where_the_depth_maps_leave_the_target_open(stand):
    cameras, images, maps, masks = stand
    report = Report()
    found = find_standing(images, cameras, maps, BOUNDS, report=report)
    assert report.values["standing"]["silhouettes"]
    assert report.values["standing"]["measured"] < 0.3
    for s, m in zip(found.silhouettes, masks):
        assert ((s > 0) & m).sum() / ((s > 0) | m).sum() > 0.93
    again = find_standing(images, cameras, maps, BOUNDS)
    assert all((a == b).all() for a, b in zip(found.silhouettes, again.silhouettes))


def test_many_views_are_cut_in_groups_with_like_results(stand, monkeypatch):
    cameras, images, maps, masks = stand
    monkeypatch.setattr(standing, "GROUP", 5)
    found = find_standing(images, cameras, maps, BOUNDS)
    for s, m in zip(found.silhouettes, masks):
        assert ((s > 0) & m).sum() / ((s > 0) | m).sum() > 0.93


def test_a_view_that_shows_nothing_sure_learns_from_the_others(stand):
    cameras, images, maps, masks = stand
    shaded, unknown = list(images), list(maps)
    for n in (2, 7):
        shaded[n] = np.where(masks[n][..., None], (images[n] * 0.45).astype(np.uint8), images[n])
        unknown[n] = DepthMap(np.where(masks[n], 0, maps[n].depth).astype(np.float32), maps[n].confidence)
    found = find_standing(shaded, cameras, unknown, BOUNDS)
    for n, (s, m) in enumerate(zip(found.silhouettes, masks)):
        # Where nothing was found the others' hull stands in, which is of coarse voxels.
        assert ((s > 0) & m).sum() / ((s > 0) | m).sum() > (0.8 if n in (2, 7) else 0.93)


def test_what_the_other_views_rule_out_is_no_part_of_a_silhouette(stand):
    cameras, images, maps, masks = stand
    right, middle = int(np.nonzero(masks[4].any(0))[0][-1]), int(np.nonzero(masks[4].any(1))[0].mean())
    beside = np.zeros(masks[4].shape, bool)
    beside[middle - 30 : middle + 30, right - 20 : right + 60] = True
    beside &= ~masks[4]
    painted, unknown = list(images), list(maps)
    painted[4] = np.where(beside[..., None], np.uint8([230, 190, 30]), images[4])
    unknown[4] = DepthMap(np.where(beside, 0, maps[4].depth).astype(np.float32), maps[4].confidence)
    found = find_standing(painted, cameras, unknown, BOUNDS)
    shown = found.silhouettes[4] > 0
    assert (shown & beside).sum() < 0.3 * beside.sum()
    assert (shown & masks[4]).sum() > 0.97 * masks[4].sum()


def test_silhouettes_are_not_trusted_without_reason(stand):
    cameras, images, maps, masks = stand

    def why(count=12, **changes):
        report = Report()
        chosen = {"images": images, "cameras": cameras, "depths": maps} | changes
        few = {k: v[:count] for k, v in chosen.items()}
        assert find_standing(**few, bounds=BOUNDS, report=report) is None
        return report.values["standing"]["why"]

    nothing = [DepthMap(np.zeros_like(m.depth), m.confidence) for m in maps]
    known = [DepthMap(plain_ball(c)[1].astype(np.float32), m.confidence) for c, m in zip(cameras, maps)]
    assert why(depths=nothing) == "no ground"
    assert why(depths=[None] * 12) == "no ground"
    assert why(count=7) == "the cameras do not stand all around"
    assert why(depths=known) == "the depth maps show most of it"
    # Each view shows another half of the ball in the ground's pattern, and nothing was measured there.
    hidden, open_ = [], []
    for n, (camera, image, m, d) in enumerate(zip(cameras, images, masks, maps)):
        x = np.arange(camera.width) - 119.5
        half = m & ((x < 0) if n % 2 else (x > 0))
        pattern = texture_of(camera.unproject(camera.pixel_grid().reshape(-1, 2), np.full(m.size, 2.0)) * 0.7).reshape(image.shape)
        hidden.append(np.where(half[..., None], pattern * [0.5, 0.6, 0.8], image).astype(np.uint8))
        open_.append(DepthMap(np.where(half, 0, d.depth).astype(np.float32), d.confidence))
    assert why(images=hidden, depths=open_) == "the silhouettes disagree"


def test_silhouettes_and_depth_maps_are_brought_together(stand):
    cameras, images, maps, masks = stand
    found = find_standing(images, cameras, maps, BOUNDS)
    wrong = [DepthMap(m.depth.copy(), m.confidence) for m in maps]
    middle = tuple(int(v.mean()) for v in np.nonzero(masks[0]))
    wrong[0].depth[middle] = 3.0  # the ground far behind, through the ball
    beside = np.argwhere(~masks[0] & (np.roll(masks[0], 12, 1)))[0]
    wrong[0].depth[tuple(beside)] = 2.0  # the ball's depth beside it
    kept = found.agreeing(wrong, cameras)
    assert kept[0].depth[middle] == 0
    assert kept[0].depth[tuple(beside)] == 0
    assert found.agreeing([None] * 12, cameras) == [None] * 12
    same = [(k.depth == m.depth).mean() for k, m in zip(kept, maps)]
    assert min(same) > 0.97


def test_silhouettes_complete_the_surface_and_cut_nothing(stand):
    cameras, images, maps, _ = stand
    found = find_standing(images, cameras, maps, BOUNDS)
    config = VolumeConfig(voxel=0.02)
    parts = {
        n: extract_surface(fuse_tiles(maps, cameras, BOUNDS, None, config, found=s), SurfaceConfig(decimation=0))
        for n, s in (("measured", None), ("completed", found.silhouettes))
    }
    ball = plain_sphere_points()
    near = {n: share_near(ball, s.vertices, 0.04) for n, s in parts.items()}
    assert near["measured"] < 0.6
    assert near["completed"] > 0.95
    floor = {n: (np.abs(s.vertices[:, 2] - FLOOR) < 0.02).sum() for n, s in parts.items()}
    assert floor["completed"] > 0.95 * floor["measured"]
    # What stands away from the ground and the ball is nobody's.
    v = parts["completed"].vertices
    away = np.abs(np.linalg.norm(v - (0, 0, 0.34), axis=1) - 0.4)
    assert ((away > 0.08) & (v[:, 2] > FLOOR + 0.05)).mean() < 0.02


def test_a_plain_ball_is_reconstructed_from_photographs_without_masks(stand):
    cameras, images, _, _ = stand
    config = Config.from_dict({"volume": {"voxel": 0.015}})
    result = mvcore.reconstruct(images, cameras, bounds=BOUNDS, config=config)
    off = replace(config, standing=StandingConfig(enabled=False))
    without = mvcore.reconstruct(images, cameras, bounds=BOUNDS, config=off)
    assert result.report["standing"]["silhouettes"]
    assert any("outlines" in w for w in result.report["warnings"])
    assert "standing" not in without.report
    ball = plain_sphere_points()
    assert share_near(ball, result.vertices, 0.05) > max(0.9, share_near(ball, without.vertices, 0.05) + 0.1)


def test_bubbles_are_dropped_and_open_parts_are_not():
    box = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T.astype(np.float64)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    outward = np.array(faces, np.uint32)
    corner = box[outward] - 0.5
    assert np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() > 0
    small, open_ = 0.2 * box + 0.4, 0.3 * box + 3
    vertices = np.concatenate([box, small, open_])
    every = np.concatenate([outward, outward[:, ::-1] + 8, outward[:-1, ::-1] + 16]).astype(np.uint32)
    kept = drop_cavities(Surface(vertices, every))
    assert len(kept.faces) == 12 + 11
    assert (kept.vertices == np.concatenate([box, open_])).all()


@pytest.mark.parametrize("subdivisions", [4, 6])
def test_what_no_camera_sees_is_dropped_but_for_a_rim(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions)
    surface = Surface(np.array(ball.vertices), np.array(ball.faces, np.uint32))
    K = [[100, 0, 79.5], [0, 100, 59.5], [0, 0, 1]]
    # Both look down from 4 above the middle: what lies lower than 1 / 4 is seen by neither.
    above = [Camera(K, np.diag([1, -1, -1]), [x, 0, 4], 160, 120) for x in (-0.3, 0.3)]
    for reach in (1.0, 4.0):
        kept = drop_unseen(surface, above, 0.1, reach)
        middles = kept.vertices[kept.faces].mean(1)
        assert 0.25 - 0.15 * reach - 0.1 < middles[:, 2].min() < 0.25 - 0.05 * reach
        # Nothing of the seen side is lost, however fine the faces are.
        assert (kept.vertices[:, 2] > 0.3).sum() == (surface.vertices[:, 2] > 0.3).sum()
    assert drop_unseen(surface, [Camera(K, np.eye(3), [0, 0, -9], 160, 120)], 0.1, 1.0) is surface


def plain_sphere_points() -> np.ndarray:
    """Points of the ball that cameras see: not its underside."""
    n = np.arange(2000) + 0.5
    z, angle = 1 - 2 * n / 2000, np.pi * (1 + 5**0.5) * n
    unit = np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
    return 0.4 * unit[z > -0.6] + (0, 0, 0.34)


def share_near(points, vertices, reach) -> float:
    distance, _ = _core.nearest(points, np.ascontiguousarray(vertices, np.float64))
    return float((distance < reach).mean())
