"""The network at work: its cost kernel, matcher, recognition head, published layouts, logs."""

import csv
from dataclasses import replace

import cv2
import mvcore
import numpy as np
import pytest
import torch
from mvcore import FormatError, InvalidInputError, _core, depth
from mvcore.depth import stereo as pairs
from mvcore.geometry.cameras import relative_map
from mvcore.io.maps import write_pfm
from mvcore.network.cost import correlate, cost_space, scaled_maps, unit
from mvcore.network.folding import folded, unfolded
from mvcore.network.matcher import MOST_SEEN, Matcher, padded
from mvcore.network.model import DisparityNet
from mvcore.network.procedural.objects import SIZE, TrainingObject
from mvcore.network.recognition import SHIPPED, TargetClassifier, load_classifier, rank_1, squared_error
from mvcore.network.training.batches import Recipe, make_batch
from mvcore.network.training.datasets import LAYOUTS, cropped, find_items
from mvcore.network.training.logs import plot_log
from mvcore.network.training.train_recognition import RecognitionTraining, train_recognition, validate_recognition
from mvcore.network.weights import save_weights

SMALL = Recipe(width=96, height=64)


@pytest.mark.parametrize(("channels", "groups", "factor"), [(32, 8, 4), (16, 8, 2), (12, 3, 4), (5, 1, 4)])
def test_the_rust_cost_space_equals_the_torch_form(channels, groups, factor):
    torch.manual_seed(channels)
    for share in (0.0, 1.0):
        batch = make_batch(replace(SMALL, pairs=share), 3)
        h, w = 64 // factor, 96 // factor
        features = [unit(torch.randn(2, channels, h, w), groups) for _ in batch.images]
        span = (batch.high - batch.low)[:, None, None, None]
        planes = batch.low[:, None, None, None] + span * torch.rand(2, 10, h, w)
        maps = [scaled_maps(m, factor) for m in batch.maps]
        arguments = (features[0], features[1:], maps, planes, groups, torch.rand(groups), torch.tensor(-0.3))
        with torch.no_grad():
            ours, theirs = cost_space(*arguments), correlate(*arguments)
        assert ours.shape == theirs.shape
        assert (ours - theirs).abs().mean() < 1e-4 * theirs.abs().mean()
        assert (ours - theirs).abs().max() < 1e-3


def test_folding_normalisations_and_unfolding_change_nothing():
    torch.manual_seed(0)
    net = DisparityNet().eval()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm3d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    batch = make_batch(SMALL, 0)
    arguments = (batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, 16)
    with torch.no_grad():
        before = net(*arguments)
        after = folded(net)(*arguments)
        again = unfolded(net)(*arguments)
    left = [name for name, m in net.named_modules() if isinstance(m, torch.nn.BatchNorm3d)]
    assert all("join1" in name for name in left)  # those follow a sum
    span = (batch.high - batch.low)[:, None, None]
    for other in (after, again):
        assert ((before.inverse - other.inverse).abs() / span).max() < 1e-3


def test_padding_keeps_pixels_where_they_are():
    image = np.random.default_rng(0).integers(0, 255, (37, 50, 3), np.uint8)
    tensor = padded(image)
    assert tensor.shape == (1, 3, 48, 64)
    assert np.array_equal(tensor[0, :, :37, :50].permute(1, 2, 0).numpy(), image)
    with pytest.raises(InvalidInputError, match="image"):
        padded(image[..., 0])


def test_shipped_network_finds_the_depth_of_held_out_families():
    matcher = Matcher()
    right, random_guess = [], []
    for number in range(4):
        batch = make_batch(Recipe(seed=77, batch=1, held_out=True, pairs=1.0), number)
        images = [i[0].permute(1, 2, 0).numpy() for i in batch.images]
        most = int(np.ceil(float(batch.high[0])))
        found, confidence = matcher.disparity(images[0], images[1], most)
        truth = batch.inverse[0].numpy()
        assert found.shape == truth.shape == confidence.shape
        assert np.isfinite(found).all()
        assert ((found >= 0) & (found <= most)).all()
        near = 0.06 * most
        right.append((np.abs(found - truth) < near)[truth > 0].mean())
        random_guess.append((np.abs(np.median(truth) - truth) < near)[truth > 0].mean())
    assert np.mean(right) > 0.6
    assert np.mean(right) > np.mean(random_guess) + 0.2


def test_features_are_kept_and_change_nothing(ring):
    cameras, images, _depths, _masks = ring
    looked = []
    matcher = Matcher()
    look = matcher.net.look
    matcher.net.look = lambda image: looked.append(image.shape) or look(image)
    first = matcher.depth(images[0], cameras[0], images[1:3], cameras[1:3], 1.2, 2.6)
    assert len(looked) == 3
    matcher.depth(images[1], cameras[1], [images[0], images[2], images[3]], [cameras[n] for n in (0, 2, 3)], 1.2, 2.6)
    assert len(looked) == 4
    again = matcher.depth(images[0], cameras[0], images[1:3], cameras[1:3], 1.2, 2.6)
    alone = Matcher().depth(images[0], cameras[0], images[1:3], cameras[1:3], 1.2, 2.6)
    for found in (again, alone):
        assert all(np.array_equal(a, b) for a, b in zip(first, found))
    for n in range(30):
        matcher._look(np.full((16, 16, 3), n, np.uint8))
    assert len(matcher.seen) == MOST_SEEN


def test_matcher_names_what_is_wrong():
    matcher = Matcher()
    image = np.zeros((32, 32, 3), np.uint8)
    camera = mvcore.Camera([[30, 0, 15.5], [0, 30, 15.5], [0, 0, 1]], np.eye(3), [0, 0, 0], 32, 32)
    for call, name in (
        (lambda: matcher.depth(image, camera, [], [], 1, 2), "sources"),
        (lambda: matcher.depth(image, camera, [image], [camera], 2, 1), "near, far"),
        (lambda: matcher.disparity(image, image[:16], 8), "right"),
        (lambda: matcher.disparity(image, image, 0), "max_disparity"),
        (lambda: mvcore.disparity(image, image, max_disparity=8, matcher="magic"), "matcher"),
        (lambda: mvcore.Config.from_dict({"device": "tpu"}), "device"),
    ):
        with pytest.raises(InvalidInputError, match=f"^{name}: expected"):
            call()
    grey = depth.View(image[..., 0], camera)
    with pytest.raises(InvalidInputError, match="colours"):
        depth.network_depth(grey, [grey], 1, 2)
    if not torch.cuda.is_available():
        with pytest.raises(InvalidInputError, match="CUDA"):
            Matcher(None, "cuda")


def test_pipeline_runs_with_the_network_and_says_so(ring):
    cameras, images, _depths, _masks = ring
    result = mvcore.reconstruct(images[:6], cameras[:6], config={"matcher": "dcnn"})
    assert result.report["matcher"] == "dcnn"
    assert len(result.faces) > 100


def test_network_helps_the_sweep_where_it_was_never_trained():
    bad = {"sgm": [], "dcnn": []}
    for number in range(4):
        batch = make_batch(Recipe(seed=78, batch=1, held_out=True, pairs=1.0), number)
        left, right = (i[0].permute(1, 2, 0).numpy() for i in batch.images)
        truth, most = batch.inverse[0].numpy(), int(np.ceil(float(batch.high[0])))
        for matcher, shares in bad.items():
            found, _ = mvcore.disparity(left, right, max_disparity=most, matcher=matcher)
            shares.append((np.abs(found - truth) > 2)[(truth > 0) & (truth < most)].mean())
    assert np.mean(bad["dcnn"]) < 0.9 * np.mean(bad["sgm"])


def test_network_sees_large_pairs_reduced_and_means_the_same_disparity(monkeypatch):
    batch = make_batch(Recipe(seed=5, batch=1, pairs=1.0), 1)
    pair = [np.ascontiguousarray(i[0].permute(1, 2, 0).numpy()) for i in batch.images]
    most = int(np.ceil(float(batch.high[0])))
    full = pairs._expected(pair, 0, most, "cpu")
    monkeypatch.setattr(pairs, "PAIR_SIDE", 160)
    reduced = pairs._expected(pair, 0, most, "cpu")
    assert reduced.inverse.shape == reduced.confidence.shape == full.inverse.shape
    assert reduced.inverse.flags.c_contiguous
    sure = (full.confidence > 0.9) & (reduced.confidence > 0.9)
    assert sure.mean() > 0.1
    assert np.median(np.abs(full.inverse - reduced.inverse)[sure]) < 0.5


def test_expected_depth_is_a_bounded_term_of_the_costs():
    random = np.random.default_rng(0)
    costs = random.integers(0, 64, (5, 7, 20), np.uint8)
    place = random.uniform(0, 19, (5, 7)).astype(np.float32)
    sure = random.uniform(0, 1, (5, 7)).astype(np.float32)
    sure[0] = 0
    place[1, 0] = np.nan
    after = costs.copy()
    _core.expect(after, place, sure, 20.0, 6.0)
    term = 20 * sure[..., None] * np.minimum(np.abs(np.arange(20) - place[..., None]) / 6, 1)
    assert np.abs(after.astype(float) - costs - np.nan_to_num(term)).max() <= 0.51
    assert np.array_equal(after[0], costs[0])
    for wrong in ({"weight": 90.0}, {"reach": 0.0}, {"expected": place[:2]}, {"confidence": sure[:2]}):
        name = next(iter(wrong))
        with pytest.raises(InvalidInputError, match=f"^{name}: expected"):
            _core.expect(costs, **({"expected": place, "confidence": sure, "weight": 20.0, "reach": 6.0} | wrong))


def test_network_disparity_fills_or_leaves_out_what_is_hidden():
    batch = make_batch(Recipe(seed=5, batch=1, pairs=1.0), 1)
    left, right = (i[0].permute(1, 2, 0).numpy() for i in batch.images)
    most = int(np.ceil(float(batch.high[0])))
    full, _ = mvcore.disparity(left, right, max_disparity=most, matcher="dcnn")
    checked, confidence = mvcore.disparity(left, right, max_disparity=most, matcher="dcnn", fill=False)
    assert (full > 0).mean() > 0.99
    assert 0.2 < (checked > 0).mean() < 1
    assert np.array_equal(full[checked > 0], checked[checked > 0])
    assert confidence[(checked == 0) & (full > 0)].max() <= pairs.UNSEEN
    assert 0 <= confidence.min() <= confidence.max() <= 1


def test_a_target_is_the_same_from_its_seed_and_differs_from_others():
    def shot(seed, angle):
        return TrainingObject(seed, False).photograph(angle, 0.2, np.random.default_rng(0)).astype(int)

    assert np.array_equal(shot(3, 0.5), shot(3, 0.5))
    assert shot(3, 0.5).shape == (SIZE, SIZE, 3)
    assert np.abs(shot(3, 0.5) - shot(4, 0.5)).mean() > 3
    assert np.abs(shot(3, 0.5) - shot(3, 0.9)).mean() > 1


def test_shipped_recognition_matches_unseen_targets_across_angles():
    figures = validate_recognition(load_classifier(), targets=60, seed=21)
    angles = [v for k, v in figures.items() if k.startswith("rank1")]
    assert len(angles) == 4
    assert min(angles) > 8 * figures["chance"]


def test_embedding_is_a_unit_vector_of_1024():
    net = load_classifier()
    images = [np.random.default_rng(n).integers(0, 255, (40 + n, 90, 3), np.uint8) for n in range(3)]
    vectors = net.embed(images)
    assert vectors.shape == (3, 1024)
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    assert rank_1(vectors, vectors) == 1
    assert np.allclose(net.classify(images).sum(1), 1, atol=1e-5)
    for bad in ([], [images[0][..., 0]], [images[0].astype(float)]):
        with pytest.raises(InvalidInputError, match="images"):
            net.embed(bad)


def test_recognition_training_learns_logs_and_resumes_exactly(tmp_path):
    training = RecognitionTraining(steps=60, classes=6, pictures=6, batch=16, every=30, rate=0.01)
    train_recognition(training, tmp_path / "a", report=lambda _: None)
    train_recognition(training, tmp_path / "b", report=lambda _: None, stop_after=30)
    train_recognition(training, tmp_path / "b", report=lambda _: None)
    a, b = (torch.load(tmp_path / x / "last.pt", weights_only=True)["net"] for x in "ab")
    assert all(torch.equal(a[k], b[k]) for k in a)
    with (tmp_path / "b" / "log.csv").open() as file:
        losses = [float(r["loss"]) for r in csv.DictReader(file)]
    assert len(losses) == 2
    assert losses[1] < losses[0]
    plot_log(tmp_path / "b" / "log.csv", tmp_path / "log.png")
    assert cv2.imread(str(tmp_path / "log.png")) is not None
    assert load_classifier(tmp_path / "a" / "best.safetensors").classes == 6


def test_squared_error_is_that_of_equation_34():
    scores, classes = torch.randn(5, 4, dtype=torch.float64, requires_grad=True), torch.tensor([0, 1, 2, 3, 0])
    p = torch.softmax(scores, 1)
    wanted = sum(0.5 * ((p[n] - torch.eye(4)[c]) ** 2).sum() for n, c in enumerate(classes)) / 5
    assert torch.allclose(squared_error(scores, classes).double(), wanted)
    assert torch.autograd.gradcheck(lambda s: squared_error(s, classes), (scores,))


def test_recognition_weights_of_another_kind_are_refused(tmp_path):
    save_weights(torch.nn.Linear(2, 2), tmp_path / "a.safetensors")
    with pytest.raises(FormatError, match="weights of another network"):
        load_classifier(tmp_path / "a.safetensors")
    assert SHIPPED.stat().st_size < 12e6
    assert TargetClassifier(3).classes == 3


# Published layouts, small folders of each, made from one exact sample.


def _pair(random):
    right = cv2.GaussianBlur(random.integers(0, 255, (40, 60, 3), np.uint8), (0, 0), 1)
    return np.roll(right, 6, 1), right, np.full((40, 60), 6.0, np.float32)


def _png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1])


def _write_pairs(root, layout, left, right, truth):
    if layout == "sceneflow":
        _png(root / "frames_cleanpass/TRAIN/A/0000/left/0006.png", left)
        _png(root / "frames_cleanpass/TRAIN/A/0000/right/0006.png", right)
        (root / "disparity/TRAIN/A/0000/left").mkdir(parents=True)
        write_pfm(root / "disparity/TRAIN/A/0000/left/0006.pfm", truth)
    elif layout == "kitti":
        _png(root / "training/image_2/000000_10.png", left)
        _png(root / "training/image_3/000000_10.png", right)
        _png(root / "training/disp_occ_0/000000_10.png", (truth * 256).astype(np.uint16))
    else:
        _png(root / "cone/im2.png", left)
        _png(root / "cone/im6.png", right)
        _png(root / "cone/disp2.png", (truth * 4).astype(np.uint8))


@pytest.mark.parametrize("layout", ["sceneflow", "kitti", "middlebury"])
def test_published_pairs_are_read_with_their_scale(layout, tmp_path):
    left, right, truth = _pair(np.random.default_rng(0))
    _write_pairs(tmp_path, layout, left, right, truth)
    (item,) = find_items(f"{layout}:{tmp_path}")
    sample = item()
    assert np.array_equal(sample.inverse, truth)
    assert np.array_equal(sample.images, np.stack([left, right]))
    # The cameras say what the disparity says.
    a, b = sample.cameras
    world = a.unproject(np.array([[30.0, 20.0]]), np.array([1 / 6.0]))
    assert np.allclose(b.project(world), [[24, 20]])
    assert cropped(sample, 48, 32, np.random.default_rng(0)).images.shape == (2, 32, 48, 3)
    batch = make_batch(Recipe(width=48, height=32, data=(f"{layout}:{tmp_path}",), files=1.0), 0)
    assert float(batch.inverse.max()) == 6.0
    larger = cropped(sample, 96, 64, np.random.default_rng(0))
    assert float(larger.inverse.max()) == pytest.approx(9.6)


@pytest.mark.parametrize("layout", ["dtu", "blendedmvs"])
def test_published_views_are_read_with_their_cameras(layout, ring, tmp_path):
    cameras, images, depths, _masks = ring
    picked = [0, 1, 2]
    cams = tmp_path / ("Cameras" if layout == "dtu" else "project/cams")
    cams.mkdir(parents=True)
    for n in picked:
        c = cameras[n]
        rows = [" ".join(map(repr, map(float, r))) for r in np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])]
        k = [" ".join(map(repr, map(float, r))) for r in c.K]
        (cams / f"{n:08d}_cam.txt").write_text("\n".join(["extrinsic", *rows, "", "intrinsic", *k, "", "1.0 0.01"]) + "\n")
        if layout == "dtu":
            _png(tmp_path / f"Rectified/scan1_train/rect_{n + 1:03d}_3_r5000.png", images[n])
            path = tmp_path / f"Depths/scan1_train/depth_map_{n:04d}.pfm"
        else:
            (tmp_path / "project/blended_images").mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / f"project/blended_images/{n:08d}.jpg"), images[n][..., ::-1])
            path = tmp_path / f"project/rendered_depth_maps/{n:08d}.pfm"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_pfm(path, depths[n].astype(np.float32))
    (cams / "pair.txt").write_text("3\n0\n2 1 9.0 2 8.0\n1\n2 0 9.0 2 8.0\n2\n2 1 9.0 0 8.0\n")
    items = find_items(f"{layout}:{tmp_path}")
    assert len(items) == 3
    sample = items[0]()
    assert np.allclose(relative_map(*sample.cameras[:2]), relative_map(cameras[0], cameras[1]), atol=1e-4)
    window = cropped(sample, 64, 48, np.random.default_rng(1))
    assert window.images.shape == (3, 48, 64, 3)
    assert make_batch(Recipe(width=64, height=48, data=(f"{layout}:{tmp_path}",), files=1.0), 0).inverse.shape == (2, 48, 64)
    # A reference pixel of the window lies in the world where the whole image has it.
    inside = np.argwhere(window.inverse > 0)[0]
    z = 1 / window.inverse[tuple(inside)]
    world = window.cameras[0].unproject(inside[None, ::-1].astype(float), np.array([z]))
    u, v = sample.cameras[0].project(world)[0]
    assert sample.inverse[round(v), round(u)] == pytest.approx(1 / z)


def test_folders_without_samples_and_unknown_layouts_are_named(tmp_path):
    for layout in LAYOUTS:
        if layout != "dtu":
            with pytest.raises(FormatError, match="no sample"):
                find_items(f"{layout}:{tmp_path}")
    for wrong in ("eth3d:/x", "kitti", "kitti:"):
        with pytest.raises(InvalidInputError, match="LAYOUT:FOLDER"):
            find_items(wrong)
