"""The network's parts: geometry of the cost space, gradients, the procedural truth, training, weights."""

import csv
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from mvcore.errors import FormatError, InvalidInputError
from mvcore.geometry.cameras import relative_map
from mvcore.network.cost import correlate, landing, scaled_maps, unit
from mvcore.network.features import PRESETS, Trunk, load_vgg16
from mvcore.network.folding import renormalised
from mvcore.network.matcher import SHIPPED
from mvcore.network.model import DisparityNet
from mvcore.network.procedural.scenes import Tiles, random_pair, random_views
from mvcore.network.regularise import soft_argmin, windowed_soft_argmin
from mvcore.network.training.batches import Recipe, make_batch
from mvcore.network.training.losses import HIDDEN_SHARE, loss, split_loss
from mvcore.network.training.stream import Stock, _Tasks, mirrored
from mvcore.network.training.train_disparity import Training, _rate, _Run, train_disparity
from mvcore.network.weights import load_disparity, save_weights

SMALL = Recipe(width=64, height=48)


@pytest.fixture(scope="module")
def tiles():
    return Tiles(np.random.default_rng(0), False, 12)


def test_planes_land_where_the_cameras_project(tiles):
    sample = random_views(np.random.default_rng(1), tiles, 2, 64, 48)[0]
    reference, source = sample.cameras
    maps = torch.from_numpy(relative_map(reference, source))[None]
    x, y = landing(maps, torch.from_numpy(sample.inverse)[None, None])
    world = reference.unproject(reference.pixel_grid().reshape(-1, 2), 1 / sample.inverse.reshape(-1))
    expected = source.project(world).reshape(48, 64, 2)
    assert np.allclose(np.stack([x[0, 0], y[0, 0]], -1), expected, atol=0.05)
    # A quarter-size pixel u covers the full-size pixels 4u .. 4u + 3: its middle is 4u + 1.5.
    quarter = scaled_maps(maps, 4)
    qx, _ = landing(quarter, torch.full((1, 1, 12, 16), float(sample.inverse[21, 29])))
    full, _ = landing(maps, torch.full((1, 1, 48, 64), float(sample.inverse[21, 29])))
    between = full[0, 0, 21:23, 29:31].mean()
    assert abs(4 * qx[0, 0, 5, 7] + 1.5 - between) < 0.05


def test_the_true_plane_correlates_best(tiles):
    """Correlating the images themselves, the true disparity beats its neighbours where both views see the surface, in the mirror too."""
    looks = [random_pair(np.random.default_rng(seed), tiles, 128, 96, max_disparity=30.0) for seed in range(8)]
    planes = torch.arange(0, 36.0).view(1, -1, 1, 1).expand(1, 36, 96, 128)
    for pair in zip(*looks, strict=True):
        shares = []
        for sample in pair:
            images = [torch.from_numpy(i.copy()).permute(2, 0, 1)[None].float() for i in sample.images]
            patches = [torch.nn.functional.unfold(i, 7, padding=3).view(1, -1, 96, 128) for i in images]
            features = [unit(p - p.mean(1, keepdim=True), 1) for p in patches]
            maps = torch.from_numpy(relative_map(*sample.cameras))[None]
            corr = correlate(features[0], features[1:], [maps], planes, 1, torch.ones(1), torch.zeros(()))
            right = np.abs(corr[0, 0].argmax(0).numpy() - sample.inverse) < 1.5
            shares.append(right[sample.seen[0]].mean())
        assert np.median(shares) > 0.5


def test_gradients_of_the_cost_space_equal_finite_differences():
    torch.manual_seed(0)
    maps = torch.tensor([[1, 0.02, 0.1, -0.01, 1, 0.2, 0, 0, 1, -1.0, 0.1, 0.01]], dtype=torch.float64)
    planes = torch.tensor([0.3, 1.1, 1.7], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 4, 5)
    a, b = (torch.rand(1, 4, 4, 5, dtype=torch.float64, requires_grad=True) for _ in range(2))
    gain = torch.rand(2, dtype=torch.float64, requires_grad=True)
    bias = torch.zeros((), dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(lambda f, g, k, c: correlate(f, [g, 1 - g], [maps, maps], planes, 2, k, c), (a, b, gain, bias))


def test_the_window_stays_on_one_side_of_an_edge():
    scores = torch.full((1, 20, 1, 1), -9.0)
    scores[0, 3], scores[0, 15] = 2.0, 1.9
    plane, confidence = windowed_soft_argmin(scores)
    assert abs(plane.item() - 3) < 0.01
    assert 4 < soft_argmin(scores).item() < 14
    assert 0.4 < confidence.item() < 0.6


def test_batches_are_functions_of_seed_and_number():
    first, again, other = make_batch(SMALL, 5), make_batch(SMALL, 5), make_batch(replace(SMALL, seed=2), 5)
    assert torch.equal(first.images[0], again.images[0])
    assert torch.equal(first.inverse, again.inverse)
    assert not torch.equal(first.images[0], other.images[0])
    assert (first.inverse > 0).float().mean() > 0.9


def test_twenty_steps_lower_the_loss():
    torch.manual_seed(0)
    net = DisparityNet().train()
    optimiser = torch.optim.AdamW(net.parameters(), 1e-3)
    batch = make_batch(SMALL, 0)
    values = []
    for _ in range(20):
        optimiser.zero_grad()
        out = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, 24)
        value = loss(out, batch.inverse, batch.low, batch.high, batch.seen)
        value.backward()
        optimiser.step()
        values.append(float(value.detach()))
    assert np.mean(values[-3:]) < 0.7 * np.mean(values[:3])


def test_hidden_pixels_count_apart_from_seen_ones():
    """What the loss says of the seen pixels does not change with the truth of the hidden ones, nor the other way round."""
    torch.manual_seed(0)
    batch = make_batch(replace(SMALL, pairs=1.0), 0)
    out = DisparityNet().train()(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, 24)
    hidden = ~batch.seen.any(1) & (batch.inverse > 0)
    assert 0.02 < hidden.float().mean() < 0.9
    middle = ((batch.low + batch.high) / 2)[:, None, None].expand_as(batch.inverse)
    true, moved, unknown = (
        split_loss(out, i, batch.low, batch.high, batch.seen)
        for i in (batch.inverse, torch.where(hidden, middle, batch.inverse), torch.where(hidden, 0, batch.inverse))
    )
    assert moved[0] == true[0]
    assert moved[1] != true[1]
    assert (unknown[0], unknown[1]) == (true[0], 0)
    whole = loss(out, batch.inverse, batch.low, batch.high, batch.seen)
    assert whole.item() == pytest.approx(((1 - HIDDEN_SHARE) * true[0] + HIDDEN_SHARE * true[1]).item())


@pytest.mark.parametrize("axis", [-1, -2])
def test_a_mirrored_batch_lands_in_mirrored_places(axis):
    batch = make_batch(replace(SMALL, pairs=0.0), 0)
    turned = mirrored(batch, axis)
    row, side = -1 - axis, batch.inverse.shape[axis]
    before = landing(batch.maps[0], batch.inverse[:, None])[row]
    after = landing(turned.maps[0], turned.inverse[:, None])[row].flip(axis)
    good = (before.abs() < 1e3) & (after.abs() < 1e3)
    assert good.float().mean() > 0.9
    assert torch.allclose(after[good], side - 1 - before[good], atol=0.05)
    assert torch.equal(mirrored(turned, axis).images[1], batch.images[1])


def test_a_stock_keeps_the_latest_samples_and_draws_the_true_ones():
    batches = [make_batch(replace(SMALL, pairs=1.0, batch=4), n) for n in range(3)]
    stock = Stock(8, torch.device("cpu"), 0)
    for batch in batches:
        stock.add(batch)
    drawn = [stock.draw(6, 24) for _ in range(4)]
    latest = torch.cat([b.inverse for b in batches[1:]])
    for batch in drawn:
        assert batch.planes == 24
        assert batch.seen.shape == (6, 1, 48, 64)
        for truth in batch.inverse:
            assert any(torch.equal(truth, k) or torch.equal(truth.flip(0), k) for k in latest)


def test_what_a_rendering_process_is_told_fits_a_pipe():
    """With more, each process would start only when the one before it had imported torch."""
    tasks = _Tasks([(SMALL, range(3, 10)), (replace(SMALL, seed=2), range(100_000))])
    assert len(pickle.dumps(tasks)) < 4096
    assert len(tasks) == 100_007
    assert torch.equal(tasks[9].inverse, make_batch(replace(SMALL, seed=2), 2).inverse)


def test_a_training_that_replays_goes_on_after_a_stop(tmp_path):
    training = Training(steps=4, every=2, workers=0, replay=8, validation=4, recipe=replace(SMALL, every=True))
    train_disparity(training, tmp_path, report=lambda _: None, stop_after=2)
    assert not (tmp_path / "report.json").exists()
    train_disparity(training, tmp_path, report=lambda _: None)
    with (tmp_path / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(r["step"]) for r in rows] == [2, 4]
    assert all(float(r["loss_seen"]) > 0 and float(r["loss_hidden"]) > 0 for r in rows)
    assert set(json.loads((tmp_path / "report.json").read_text())) == {"best"}


def test_a_step_without_a_finite_gradient_leaves_the_weights(tmp_path):
    run = _Run(Training(steps=4, recipe=SMALL), tmp_path, torch.device("cpu"))
    batch = make_batch(SMALL, 0)
    before = {k: v.clone() for k, v in run.net.named_parameters()}
    run.train_on(replace(batch, images=[torch.full_like(i, float("nan"), dtype=torch.float32) for i in batch.images]))
    assert run.sums.tolist() == [0, 0, 1]
    assert all(torch.equal(before[k], v) for k, v in run.net.named_parameters())


def test_renormalised_weights_compute_the_same(tmp_path):
    """And their normalisations hold the statistics of the inputs, also where folding had left the identity."""
    net, batch = load_disparity(SHIPPED), make_batch(SMALL, 0)
    arguments = (batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
    with torch.no_grad():
        before = net(*arguments).inverse
        renormalised(net, [arguments])
        as_batch = net.eval()(*arguments).inverse
    span = (batch.high - batch.low)[:, None, None]
    assert ((before - as_batch).abs() / span).median() < 1e-4
    means = []
    norm = net.coarse.enter[0][1]
    norm.register_forward_hook(lambda m, i, _: means.append((i[0].mean((0, 2, 3, 4)) - m.running_mean).abs().max()))
    with torch.no_grad():
        net(*arguments)
    assert means[0] < 0.05


def test_a_killed_training_goes_on_to_the_same_weights(tmp_path):
    training = Training(steps=4, every=2, workers=0, validation=4, recipe=SMALL)
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    train_disparity(training, straight, report=lambda _: None)
    train_disparity(training, broken, report=lambda _: None, stop_after=2)
    train_disparity(training, broken, report=lambda _: None)
    states = [torch.load(p / "last.pt", weights_only=True)["net"] for p in (straight, broken)]
    assert all(torch.equal(states[0][k], states[1][k]) for k in states[0])
    with (broken / "log.csv").open() as file:
        assert [int(r["step"]) for r in csv.DictReader(file)] == [2, 4]


def test_training_begins_from_given_weights(tmp_path):
    torch.manual_seed(7)
    net = DisparityNet()
    save_weights(net, tmp_path / "start.safetensors")
    training = Training(steps=1, every=1, rate=1e-9, workers=0, validation=4, recipe=SMALL, start=str(tmp_path / "start.safetensors"))
    train_disparity(training, tmp_path / "run", report=lambda _: None)
    after = torch.load(tmp_path / "run" / "last.pt", weights_only=True)["net"]
    assert torch.allclose(after["gain"], net.gain, atol=1e-3)
    first = "features.trunk.blocks.0.0.weight"
    assert torch.allclose(after[first], net.state_dict()[first], atol=1e-3)


def test_frozen_statistics_stay_and_the_weights_are_those_of_the_usual_build(tmp_path):
    torch.manual_seed(7)
    net, batch = DisparityNet(), make_batch(SMALL, 0)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm3d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    save_weights(net, tmp_path / "start.safetensors")
    begun = str(tmp_path / "start.safetensors")
    training = Training(2, every=2, rate=1e-9, workers=0, freeze_norms=True, validation=4, recipe=SMALL, start=begun)
    best = train_disparity(training, tmp_path / "run", report=lambda _: None)
    with pytest.raises(InvalidInputError, match="freeze_norms: expected True, as the run in"):
        train_disparity(replace(training, freeze_norms=False), tmp_path / "run", report=lambda _: None)
    arguments = (batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
    with torch.no_grad():
        before, after = (load_disparity(p)(*arguments).inverse for p in (tmp_path / "start.safetensors", best))
    assert ((before - after).abs() / (batch.high - batch.low)[:, None, None]).median() < 1e-3


def test_bfloat16_leaves_the_gradients_of_the_second_stage_as_they_are():
    net, batch = load_disparity(SHIPPED).train(), make_batch(SMALL, 0)
    gradients = []
    for net.bfloat16 in (False, True):
        net.zero_grad()
        out = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, 32)
        assert out.coarse_scores[0].dtype == (torch.bfloat16 if net.bfloat16 else torch.float32)
        assert out.fine_scores[0].dtype == torch.float32
        loss(out, batch.inverse, batch.low, batch.high, batch.seen).backward()
        gradients.append(torch.cat([p.grad.flatten() for p in net.fine.parameters()]))
    assert torch.isfinite(gradients[1]).all()
    assert torch.nn.functional.cosine_similarity(*gradients, dim=0) > 0.95


def test_frozen_statistics_need_weights_to_start_from(tmp_path):
    from mvcore.cli.main import app
    from typer.testing import CliRunner

    result = CliRunner().invoke(app, ["train", "disparity", "--out", str(tmp_path), "--freeze-norms"])
    assert result.exit_code == 2
    assert "start: expected weights" in result.stderr


def test_the_rate_falls_to_zero_by_the_steps_or_by_the_hours():
    by_steps, by_hours = Training(steps=1000, warmup=10), Training(steps=1000, warmup=10, hours=1.0)
    assert _rate(by_steps, 0, 0.0) == pytest.approx(by_steps.rate / 10)
    assert _rate(by_steps, 200, 1e9) == by_steps.rate
    assert _rate(by_steps, 999, 0.0) < 0.01 * by_steps.rate
    assert _rate(by_hours, 200, 0.0) == by_hours.rate
    assert _rate(by_hours, 200, 3590.0) < 0.01 * by_hours.rate
    assert _rate(by_hours, 200, 9999.0) == 0


@pytest.mark.parametrize("size", ["320", "320x250", "16x16", "ax b"])
def test_sizes_that_training_cannot_take_are_named(size, tmp_path):
    from mvcore.cli.main import app
    from typer.testing import CliRunner

    result = CliRunner().invoke(app, ["train", "disparity", "--out", str(tmp_path), "--size", size])
    assert result.exit_code == 2
    assert "--size" in result.stderr


def test_weights_come_back_and_others_are_refused(tmp_path):
    net = DisparityNet(hourglasses=1)
    save_weights(net, tmp_path / "w.safetensors")
    loaded = load_disparity(tmp_path / "w.safetensors")
    assert torch.allclose(loaded.gain, net.gain, atol=1e-3)
    assert sum(p.numel() for p in DisparityNet().parameters()) < 3_500_000
    (tmp_path / "no.safetensors").write_bytes(b"not weights")
    with pytest.raises(FormatError, match=r"no\.safetensors"):
        load_disparity(tmp_path / "no.safetensors")


def test_vgg16_weights_are_taken_by_their_names():
    trunk = Trunk(PRESETS["paper"])
    shapes = [(0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256)]
    state = {f"features.{n}.weight": torch.full((o, i, 3, 3), float(n)) for n, i, o in shapes}
    state |= {f"features.{n}.bias": torch.zeros(o) for n, _, o in shapes}
    load_vgg16(trunk, state)
    assert float(trunk.blocks[2][4].weight[0, 0, 0, 0].detach()) == 14
    del state["features.7.bias"]
    with pytest.raises(ValueError, match=r"features\.7\.bias"):
        load_vgg16(trunk, state)
