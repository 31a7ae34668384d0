"""Texturing: short lists of views, colour gains, one image in memory at a time."""

import hashlib
import os
import subprocess
import sys
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from conftest import look_at
from hypothesis import given
from hypothesis import strategies as st
from mvcore import _core
from mvcore.config import TextureConfig
from mvcore.errors import InvalidInputError
from mvcore.evaluation import metrics
from mvcore.mesh.surface import Surface, marching_cubes
from mvcore.mesh.texture import Candidates, TexturePrior, colour_gains, texture


def sphere(n=36, radius=0.5):
    x = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float32)] * 3, indexing="ij")) - (n - 1) / 2
    vertices, faces = marching_cubes(np.sqrt((x**2).sum(0)) - 0.4 * n)
    vertices = vertices.astype(np.float64)
    return Surface((vertices - vertices.mean(0)) / (0.4 * n) * radius, faces)


def digest(textured):
    arrays = (textured.vertices, textured.faces, textured.uv, textured.atlas, textured.view, textured.gains)
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


def rated(qualities, colours, slots):
    """Lists of (V, F) qualities and (V, F, 3) colours."""
    candidates = Candidates.empty(qualities.shape[1], slots)
    for view, (quality, colour) in enumerate(zip(qualities, colours, strict=True)):
        candidates.keep_best(view, quality, colour)
    return candidates


def as_dicts(candidates):
    """What the lists hold, as the twins have it."""
    rows = zip(candidates.views, candidates.qualities, candidates.colours, strict=True)
    return [{int(v): (q, tuple(c)) for v, q, c in zip(*row, strict=True) if q > 0} for row in rows]


def ratings(seed, views=9, faces=40):
    random = np.random.default_rng(seed)
    qualities = random.integers(0, 12, (views, faces)).astype(np.float32)  # many ties, many zeros
    base = random.integers(20, 200, (1, faces, 3))
    return qualities, np.clip(base * random.uniform(0.6, 1.6, (views, 1, 3)), 0, 255).astype(np.uint8)


@given(st.integers(0, 2**32 - 1), st.integers(1, 10))
def test_the_lists_equal_their_twin(seed, slots):
    qualities, colours = ratings(seed)
    found, wanted = as_dicts(rated(qualities, colours, slots)), reference.best_views(qualities, colours, slots)
    # Of views of the same quality the first to come stays, unless a better one took its place.
    assert [sorted(q for q, _ in f.values()) for f in found] == [sorted(q for q, _ in w.values()) for w in wanted]
    assert all(f[v] == (qualities[v, n], tuple(colours[v, n])) for n, f in enumerate(found) for v in f)
    if slots >= len(qualities):
        assert found == wanted


@given(st.integers(0, 2**32 - 1))
def test_compared_views_equal_their_twin(seed):
    candidates = rated(*ratings(seed), 4)
    pairs, common, ratios = _core.compare_views(candidates.views, candidates.qualities, candidates.colours, 9, 1000)
    wanted = reference.compare_views(as_dicts(candidates))
    assert [tuple(p) for p in pairs] == sorted(wanted)
    for pair, count, ratio in zip(pairs, common, ratios, strict=True):
        assert count == wanted[tuple(pair)][0]
        assert np.allclose(ratio, wanted[tuple(pair)][1], atol=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_rejected_views_equal_their_twin(seed):
    candidates = rated(*ratings(seed, faces=30), 5)
    before = as_dicts(candidates)
    gains = np.random.default_rng(seed).uniform(0.7, 1.4, (9, 3)).astype(np.float32)
    vertices, faces = np.zeros((3, 3)), np.tile(np.uint32([0, 1, 2]), (30, 1))
    lists = candidates.views, candidates.qualities, candidates.colours
    labels = _core.select_views(vertices, faces, *lists, gains, 1.0, 0.5, 25.0, 1)
    for kept, views, label in zip(as_dicts(candidates), before, labels, strict=True):
        assert set(views) - set(kept) == reference.outliers(views, gains, 25.0)
        assert label in kept or (label == -1 and not kept)


def test_gains_bring_exposures_together():
    random = np.random.default_rng(0)
    base, factors = random.integers(60, 160, (500, 3)), np.array([0.8, 1.0, 1.25])
    colours = np.stack([np.clip(base * f, 0, 255).astype(np.uint8) for f in factors])
    gains = colour_gains(rated(np.ones((3, 500), np.float32), colours, 3), 3)
    assert np.allclose(gains[:, 0] * factors, (gains[:, 0] * factors).mean(), rtol=0.03)


def test_gains_reach_views_that_share_no_face_through_others():
    """Twenty views in a row, each face in three neighbours' lists; a sixth of the samples are occluded."""
    random = np.random.default_rng(1)
    views, faces = 20, 12_000
    factors = np.exp(random.uniform(-0.25, 0.25, (views, 3)))
    base, place = random.integers(60, 150, (faces, 3)), np.arange(faces) * (views - 2) // faces
    offset = np.arange(views)[:, None] - place
    qualities = np.where((offset >= 0) & (offset < 3), random.uniform(1, 2, offset.shape), 0).astype(np.float32)
    colours = base * factors[:, None] + random.normal(0, 3, (views, faces, 3))
    occluded = random.random((views, faces)) < 1 / 6
    colours[occluded] = random.integers(0, 255, (occluded.sum(), 3))
    levelled = np.log(colour_gains(rated(qualities, np.clip(colours, 0, 255).astype(np.uint8), 4), views) * factors)
    # A row is the least certain of graphs, and gains are pulled towards 1: a tenth of the spread of .29 is left.
    assert (levelled - levelled.mean(0)).std() < 0.03
    # A sample that does not grow with the faces.
    lists = rated(np.tile(qualities, 8), np.tile(colours.clip(0, 255).astype(np.uint8), (1, 8, 1)), 4)
    _, common, _ = _core.compare_views(lists.views, lists.qualities, lists.colours, views, 100)
    assert 0.4 < common.sum() / (3 * 100 * views) <= 1.1


class Lazy:
    """A sequence that makes its items when they are asked for, and knows how many of them are alive."""

    def __init__(self, items):
        self.items, self.alive, self.most, self.asked = items, weakref.WeakSet(), 0, []

    def __len__(self):
        return len(self.items)

    def __getitem__(self, n):
        class Array(np.ndarray):  # a plain array cannot be in a set
            __hash__ = object.__hash__

        item = self.items[n].copy().view(Array)
        self.alive.add(item)
        self.most, self.asked = max(self.most, len(self.alive)), [*self.asked, n]
        return item


def test_texture_shows_the_images_and_holds_one_at_a_time(ring):
    cameras, images, _, masks = ring
    masks = [m.astype(np.uint8) for m in masks]
    lazy, lazy_masks = Lazy(images[1:]), Lazy(masks[1:])
    textured = texture(sphere(), lazy, cameras[1:], lazy_masks)
    assert digest(textured) == digest(texture(sphere(), images[1:], cameras[1:], masks[1:]))
    assert (lazy.most, lazy_masks.most) == (1, 1)
    used = np.unique(textured.view[textured.view >= 0]).tolist()
    assert lazy.asked == [*range(11), *used]
    assert lazy_masks.asked == [*range(11)]
    mesh = SimpleNamespace(vertices=textured.vertices, faces=textured.faces, uv=textured.uv, texture=textured.atlas)
    figures = metrics.photo_metrics(mesh, images[0], cameras[0], masks[0] > 0)
    assert figures["coverage"] > 0.98
    assert figures["psnr_hit"] > 24
    assert (textured.view < 0).mean() < 0.2  # the poles, which no camera sees
    assert textured.figures["views_used"] == len(used)
    assert textured.figures["unseen_faces"] == (textured.view < 0).sum()
    assert textured.figures["atlas"] == [*textured.atlas.shape[1::-1]]
    assert (textured.scale, textured.warnings) == (1.0, ())


def test_short_lists_are_as_good_as_long_ones(ring):
    cameras, images, _, _ = ring

    def psnr(candidates):
        t = texture(sphere(), images[1:], cameras[1:], config=TextureConfig(candidates=candidates))
        mesh = SimpleNamespace(vertices=t.vertices, faces=t.faces, uv=t.uv, texture=t.atlas)
        return metrics.photo_metrics(mesh, images[0], cameras[0], ring[3][0])["psnr_hit"]

    assert psnr(4) > psnr(11) - 0.1


def test_an_occluder_in_a_darker_image_is_not_painted(ring):
    """Exposures differ by more than the check allows, so it needs the gains."""
    cameras, images, _, masks = ring
    exposures = np.where(np.arange(12) % 2, 0.55, 1.0)
    dark = [(i * e).astype(np.uint8) for i, e in zip(images, exposures, strict=True)]
    masks, config = [m.astype(np.uint8) for m in masks], TextureConfig(outlier=50)
    clean = texture(sphere(), dark, cameras, masks, config=config)
    x, y = np.rint(cameras[0].project(np.array([[0.5, 0.0, 0.0]]))[0]).astype(int)
    dark[0][y - 10 : y + 10, x - 10 : x + 10] = (255, 0, 255)
    textured = texture(sphere(), dark, cameras, masks, config=config)
    middles = textured.vertices[textured.faces].mean(1)
    patch = np.linalg.norm(middles - (0.5, 0, 0), axis=1) < 0.06  # nine pixels
    assert (clean.view[patch] == 0).all()
    assert (textured.view[patch] > 0).all()
    # The darker views are not taken for outliers: both exposures are used, nearly everywhere as before.
    used = np.unique(textured.view[textured.view >= 0])
    assert (used % 2).any()
    assert not (used % 2).all()
    assert (textured.view == clean.view)[~patch].mean() > 0.8


def test_an_earlier_frame_decides_where_views_are_about_as_good(ring):
    cameras, images, _, _ = ring
    surface, config = sphere(), TextureConfig(candidates=1, loyalty=1.0, least_patch=1, outlier=0)
    first = texture(surface, images, cameras, config=config)
    centers = surface.vertices[surface.faces].mean(1)
    # Not the best view of a face, the only one that its list would hold.
    wanted = np.where(first.view >= 0, (first.view + 1) % 12, -1).astype(np.int32)
    gains = np.linspace(0.9, 1.1, 36).reshape(12, 3).astype(np.float32)
    second = texture(surface, images, cameras, config=config, prior=TexturePrior(gains, centers, wanted))
    assert (second.gains == gains).all()
    seen = first.view >= 0
    assert (second.view == wanted)[seen].mean() > 0.6  # where that view sees them
    assert not (first.view == wanted)[seen].any()
    indifferent = TextureConfig(candidates=1, loyalty=0.0, least_patch=1, outlier=0)
    again = texture(surface, images, cameras, config=indifferent, prior=TexturePrior(None, centers, wanted))
    assert digest(again) == digest(first)


def test_an_atlas_that_is_too_large_is_reduced_with_a_warning(ring):
    cameras, images, _, _ = ring
    full = texture(sphere(), images, cameras)
    most = max(full.atlas.shape) * 2 // 3
    textured = texture(sphere(), images, cameras, config=TextureConfig(max_size=most))
    assert max(textured.atlas.shape) <= most
    assert 0.4 < textured.scale < 0.7
    assert textured.warnings == (f"the texture was reduced to {100 * textured.scale:.0f} % to fit {most} texels a side",)
    assert (textured.view == full.view).all()
    with pytest.raises(InvalidInputError, match=r"texture\.max_size: expected at least"):
        texture(sphere(), images, cameras, config=TextureConfig(max_size=60))


def test_inputs_that_do_not_fit_are_refused(ring):
    cameras, images, _, masks = ring
    surface = sphere(16)
    with pytest.raises(InvalidInputError, match="images: expected 12"):
        texture(surface, images[1:], cameras)
    with pytest.raises(InvalidInputError, match="images: expected shape"):
        texture(surface, [i[:-1] for i in images], cameras)
    with pytest.raises(InvalidInputError, match="masks: expected shape"):
        texture(surface, images, cameras, [m[:, 1:].astype(np.uint8) for m in masks])
    with pytest.raises(InvalidInputError, match="masks: expected 12"):
        texture(surface, images, cameras, masks[1:])
    with pytest.raises(InvalidInputError, match=r"texture\.candidates"):
        texture(surface, images, cameras, config=TextureConfig(candidates=0))
    with pytest.raises(InvalidInputError, match=r"prior\.gains"):
        texture(surface, images, cameras, prior=TexturePrior(gains=np.ones((3, 3), np.float32)))
    with pytest.raises(InvalidInputError, match=r"prior\.centers"):
        texture(surface, images, cameras, prior=TexturePrior(None, np.ones((3, 3)), np.zeros(2, np.int32)))


def test_a_mesh_that_no_view_sees_is_grey():
    camera = look_at((2, 0, 0), (4, 0, 0))
    for surface in (sphere(16), Surface(np.zeros((0, 3)), np.zeros((0, 3), np.uint32))):
        textured = texture(surface, [np.full((180, 240, 3), 9, np.uint8)], [camera])
        assert (textured.view == -1).all()
        assert len(textured.faces) == len(surface.faces)
        assert len(textured.vertices) == len(surface.vertices)
        assert not len(surface.faces) or (np.abs(textured.atlas[0, 0].astype(int) - 127) < 8).all()


def test_lists_of_other_shapes_are_refused():
    lists = Candidates.empty(5, 2)
    with pytest.raises(ValueError, match="qualities, colours"):
        _core.keep_best(0, np.ones(5, np.float32), np.ones((5, 3), np.uint8), lists.views, lists.qualities[:4], lists.colours)
    with pytest.raises(InvalidInputError, match="quality"):
        lists.keep_best(0, np.ones(4, np.float32), np.ones((5, 3), np.uint8))
    with pytest.raises(ValueError, match="C-contiguous"):
        _core.keep_best(0, np.ones(5, np.float32), np.ones((5, 3), np.uint8), lists.views[:, ::-1], lists.qualities, lists.colours)
    lists.views[3, 1] = 7
    with pytest.raises(InvalidInputError, match="views: expected numbers below 3"):
        _core.compare_views(lists.views, lists.qualities, lists.colours, 3, 10)


TEXTURE_IT = """
import resource, sys
import numpy as np
from conftest import look_at
from test_texture import digest, sphere, texture
count = int(sys.argv[1])
angles = np.linspace(0, 6.2, count)
cameras = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.3), (0, 0, 0), (64, 48), 60) for a in angles]
image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
textured = texture(sphere(int(sys.argv[2])), [image] * count, cameras)
print(digest(textured), len(textured.faces), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def texture_it(views, size, threads="2"):
    """Bytes, faces and peak memory in bytes of a process that textures a sphere."""
    path = os.pathsep.join([*sys.path, os.path.dirname(__file__)])
    env = {**os.environ, "RAYON_NUM_THREADS": threads, "PYTHONPATH": path}
    command = [sys.executable, "-c", TEXTURE_IT, str(views), str(size)]
    out = subprocess.run(command, check=True, env=env, capture_output=True, text=True).stdout.split()
    return out[0], int(out[1]), 1024 * int(out[2])


def test_the_same_bytes_for_any_number_of_threads():
    assert texture_it(9, 40, "1")[0] == texture_it(9, 40, "3")[0]


def test_memory_does_not_grow_with_the_views():
    (_, faces, few), (_, _, many) = texture_it(8, 170), texture_it(40, 170)
    assert faces > 150_000
    # Held for all views, a face's quality and colour would be 32 * 7 bytes more; what remains is the allocator's.
    assert many - few < 32 * faces
