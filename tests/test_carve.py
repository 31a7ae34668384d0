import numpy as np
import pytest
import reference
from conftest import look_at, render_target, rig
from hypothesis import given
from hypothesis import strategies as st
from mvcore import Config, InvalidInputError, ReconstructionError, _core
from mvcore.config import CarveConfig, VolumeConfig
from mvcore.evaluation.metrics import mesh_metrics
from mvcore.mesh.surface import extract_surface, isosurface
from mvcore.silhouettes.visual_hull import bounded_hull, carve_silhouettes, shadow, supported
from mvcore.volume.photo_hull import dense, photo_hull, sparse_volume, visual_hull

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


@pytest.fixture(scope="module")
def silhouettes():
    cameras = rig(12)
    return cameras, [(render_target(c, np.eye(4))[1] * 255).astype(np.uint8) for c in cameras]


@given(st.integers(0, 10_000), st.floats(0, 0.5), st.integers(0, 5))
def test_carving_is_every_views_vote_on_every_voxel(seed, tolerance, least):
    rng = np.random.default_rng(seed)
    cameras = [look_at(rng.uniform(1, 3) * v / np.linalg.norm(v), (0, 0, 0), (40, 30), 30) for v in rng.normal(size=(5, 3))]
    masks = [(rng.random((30, 40)) < rng.uniform(0.2, 1)).astype(np.uint8) for _ in cameras]
    shape = tuple(rng.integers(1, 22, 3))
    p = np.stack([c.projection for c in cameras])
    origin, voxel = rng.uniform(-1.5, 0, 3).tolist(), float(rng.uniform(0.05, 0.3))
    found = _core.carve(origin, voxel, list(shape), masks, p, tolerance=tolerance, least_views=least)
    assert (found == reference.carve(origin, voxel, shape, masks, p, tolerance, least)).all()


def test_one_wrong_mask_among_many_does_no_harm(silhouettes):
    cameras, masks = silhouettes
    spoilt = [*masks[:3], np.zeros_like(masks[3]), *masks[4:]]
    whole, voted, strict = (
        carve_silhouettes(m, cameras, BOX, resolution=48, tolerance=t).occupied for m, t in ((masks, 0.0), (spoilt, 0.1), (spoilt, 0.0))
    )
    assert not strict.any()
    assert (whole & voted).sum() > 0.99 * whole.sum()
    assert voted.sum() < 1.25 * whole.sum()


def test_the_hull_covers_its_silhouettes_and_no_more(silhouettes):
    cameras, masks = silhouettes
    surface = isosurface(visual_hull(masks, cameras, BOX, VolumeConfig(voxel=0.015)))
    for camera, mask in zip(cameras, masks):
        depth, _ = _core.rasterize(surface.vertices, surface.faces, camera.projection, camera.width, camera.height)
        both, either = ((depth > 0) & (mask > 0)).sum(), ((depth > 0) | (mask > 0)).sum()
        assert both >= 0.97 * either


def test_foreground_that_no_other_camera_supports_is_noise(silhouettes):
    cameras, masks = silhouettes
    noisy = [m.copy() for m in masks]
    noisy[0][:14, :20] = 255
    seen = supported(noisy, cameras, BOX, CarveConfig(), 0.2)
    assert (seen[0][:10, :14] == 0).all()
    for mask, s in zip(masks, seen):
        assert (s[mask > 0] > 0).mean() > 0.995


def test_phantoms_that_few_views_see_are_left_out():
    # Two cameras side by side see a second place, beyond the others' pictures; nothing there speaks against a target.
    cameras = rig(8, (120, 90))
    masks = [(render_target(c, np.eye(4))[1] * 255).astype(np.uint8) for c in cameras]
    hull = bounded_hull(masks, cameras, np.array([[-4.0, -4, -3], [4, 4, 3]]), CarveConfig())
    full = hull.origin + hull.voxel * np.argwhere(hull.occupied)
    assert (np.abs(full) < 1.0).all()
    assert shadow(hull, cameras[0]).any()


def test_more_views_than_votes_fit_into_a_byte(silhouettes):
    cameras, masks = silhouettes
    few, many = (bounded_hull(masks * k, cameras * k, BOX, CarveConfig(resolution=32)) for k in (1, 25))
    boxes = [h.origin + h.voxel * np.stack([np.argwhere(h.occupied).min(0), np.argwhere(h.occupied).max(0)]) for h in (few, many)]
    assert np.abs(boxes[0] - boxes[1]).max() < 2 * few.voxel


def test_dense_and_sparse_hold_the_same(silhouettes):
    cameras, masks = silhouettes
    volume = visual_hull(masks, cameras, BOX, VolumeConfig(voxel=0.05))
    field = dense(volume, 1.0)
    again = dense(sparse_volume(field, volume.origin, volume.voxel), 1.0)
    assert np.array_equal(field, again)


def block_with_a_pit():
    """A unit block whose top has a wide pit, 0.35 deep: vertices, faces (counter-clockwise from outside)."""
    import trimesh

    block = trimesh.creation.box((1.2, 1.2, 0.7))
    for _ in range(6):
        block = block.subdivide()
    v = block.vertices.copy()
    top = v[:, 2] > 0.349
    x = np.clip((0.42 - np.abs(v[top, :2]).max(1)) / 0.12, 0, 1)
    v[top, 2] -= 0.35 * x
    return np.ascontiguousarray(v), np.ascontiguousarray(block.faces, np.uint32)


def pictures(vertices, faces, cameras):
    """Photographs with a texture in space, and masks."""
    from conftest import texture_of

    images, masks = [], []
    for c in cameras:
        depth, _ = _core.rasterize(vertices, faces, c.projection, c.width, c.height)
        y, x = np.nonzero(depth)
        image = np.zeros((c.height, c.width, 3), np.uint8)
        image[y, x] = texture_of(c.unproject(np.column_stack([x, y]), depth[y, x]) * 0.6)
        images.append(image)
        masks.append((depth > 0).astype(np.uint8) * 255)
    return images, masks


def test_photo_consistency_carves_what_silhouettes_cannot():
    vertices, faces = block_with_a_pit()
    angles = 2 * np.pi * np.arange(16) / 16
    cameras = [look_at((1.6 * np.cos(a), 1.6 * np.sin(a), 1.5 + 1.2 * (i % 2)), (0, 0, 0.1), (240, 180), 230) for i, a in enumerate(angles)]
    images, masks = pictures(vertices, faces, cameras)
    hull = visual_hull(masks, cameras, np.array([[-0.8, -0.8, -0.5], [0.8, 0.8, 0.6]]), VolumeConfig(voxel=0.02))
    carved = photo_hull(hull, images, cameras, CarveConfig())
    scores = []
    for volume in (hull, carved):
        surface = extract_surface(volume, solid=True)
        # What no camera sees, the underside, tells nothing.
        above = surface.vertices[surface.faces].mean(1)[:, 2] > -0.2
        kept = (surface.vertices, surface.faces[above])
        scores.append(mesh_metrics(kept, (vertices, faces), [0.04], samples=40_000)["accuracy"])
    assert scores[1] < 0.6 * scores[0]
    # It must not eat into the block either: its volume stays.
    inside = [float((dense(v, 1.0) < 0).sum()) * 0.02**3 for v in (hull, carved)]
    true = 1.2 * 1.2 * 0.7 - 0.35 * (0.72**2)
    assert abs(inside[1] - true) < abs(inside[0] - true)


def test_photographs_that_never_agree_leave_nothing(silhouettes):
    cameras, masks = silhouettes
    images = [np.full((c.height, c.width, 3), 20 + 19 * n, np.uint8) for n, c in enumerate(cameras)]
    hull = visual_hull(masks, cameras, BOX, VolumeConfig(voxel=0.05))
    with pytest.raises(ReconstructionError, match="carves everything away"):
        photo_hull(hull, images, cameras, CarveConfig(rounds=50))


def test_wrong_arguments_are_named(silhouettes):
    cameras, masks = silhouettes
    with pytest.raises(InvalidInputError, match="bounds"):
        carve_silhouettes(masks, cameras, BOX[::-1])
    with pytest.raises(InvalidInputError, match="masks"):
        carve_silhouettes(masks[1:], cameras, BOX)
    with pytest.raises(InvalidInputError, match="tolerance"):
        carve_silhouettes(masks, cameras, BOX, tolerance=1.0)
    with pytest.raises(InvalidInputError, match="least_view"):
        Config.from_dict({"carve": {"least_view": 2}})
