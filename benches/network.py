"""The network's figures, one command each, beside the classical matcher and OpenCV's MODE_HH on the same run.

    python benches/network.py size                       parameters, GMAC, CPU seconds and memory of a view
    python benches/network.py heldout                    pairs and views of families that training never saw
    python benches/network.py stereo FOLDER              Middlebury's cone, teddy, Cloth3, adirondack
    python benches/network.py synthetic FOLDER           rectified pairs with exact truth (pairs.json)
    python benches/network.py views FOLDER...            scenes with exact depth (cameras.json, depth/, masks/)
    python benches/network.py confidence PICTURE.png     precision against coverage on held-out pairs and views
    python benches/network.py ablation [STEPS]           short trainings of equal length, one difference each

``--weights FILE`` measures other weights than the package's.
"""

import argparse
import json
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import mvcore
import numpy as np
import torch
from mvcore import depth as depth_stage
from mvcore.config import MATCHERS, Config
from mvcore.evaluation import metrics
from mvcore.io.images import load_frame
from mvcore.network import matcher as match
from mvcore.network.matcher import SHIPPED, Matcher, planes_for, shipped_matcher
from mvcore.network.training.batches import Recipe, make_batch
from mvcore.network.training.train_disparity import Training, train_disparity
from mvcore.network.training.validation import HeldOut, validate
from mvcore.network.weights import load_disparity
from mvcore.sparse import points as sparse
from mvcore.sparse import view_selection
from peers import PAIRS


def size(arguments):
    from torch.utils.flop_counter import FlopCounterMode

    net = load_disparity(arguments.weights)
    print(f"parameters {sum(p.numel() for p in net.parameters()) / 1e6:.2f} M, file {arguments.weights.stat().st_size / 1e6:.2f} MB")
    pair = [torch.randint(0, 255, (1, 3, 480, 640), dtype=torch.uint8) for _ in range(2)]
    maps = [torch.tensor([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], dtype=torch.float32)]
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        net(pair[0], pair[1:], maps, torch.zeros(1), torch.full((1,), 64.0), planes_for(64))
    print(f"640 x 480 pair, 64 disparities: {counter.get_total_flops() / 2e9:.1f} GMAC")
    matcher = Matcher(arguments.weights)
    random = np.random.default_rng(0)
    width, height = 1024, 682
    images = [random.integers(0, 255, (height, width, 3), np.uint8) for _ in range(5)]
    K = [[900, 0, (width - 1) / 2], [0, 900, (height - 1) / 2], [0, 0, 1]]
    cameras = [mvcore.Camera(K, np.eye(3), [-0.1 * k, 0, 0], width, height) for k in range(5)]
    views = [depth_stage.View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c, i) for i, c in zip(images, cameras, strict=True)]
    for name, job in (
        ("network alone, full size", lambda: matcher.depth(images[0], cameras[0], images[1:], cameras[1:], 2, 8)),
        ("first pass as in the pipeline", lambda: depth_stage.network_depth(views[0], views[1:], 2, 8)),
    ):
        job()
        for used in (matcher, shipped_matcher()):
            used.seen.clear()  # a view alone, of which nothing is known
        started, cpu = time.perf_counter(), time.process_time()
        job()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        wall, cpu = time.perf_counter() - started, time.process_time() - cpu
        print(f"1024 x 682 with 4 sources, {name}: {cpu:.1f} CPU s, {wall:.1f} s, peak {peak:.0f} MiB")


def heldout(arguments):
    net = load_disparity(arguments.weights)
    sets = HeldOut(Recipe().seed, arguments.count or 200).sets
    print({k: round(v, 4) for k, v in validate(net, sets["report"], torch.device("cpu")).items()})
    errors = {m: [] for m in MATCHERS}
    for n in range(20):
        for left, right, true, most in _pairs_of(make_batch(Recipe(seed=Recipe().seed + 1_000_000, held_out=True, pairs=1.0), n)):
            for matcher, parts in errors.items():
                found, _ = mvcore.disparity(left, right, max_disparity=most, matcher=matcher)
                parts.append(np.abs(found - true)[(true > 0) & (true <= most)])
    for matcher, parts in errors.items():
        means = [e.mean() for e in parts]
        print(f"pairs, {matcher}: mean error {np.concatenate(parts).mean():.2f} px, of the median pair {np.median(means):.2f} px")


def _pairs_of(batch):
    """Left and right image, true disparity and its upper end, of each pair of a batch."""
    for k in range(len(batch.inverse)):
        left, right = (i[k].permute(1, 2, 0).contiguous().numpy() for i in batch.images)
        yield left, right, batch.inverse[k].numpy(), int(np.ceil(float(batch.high[k])))


def _compared(matcher, pairs):
    rows = []
    for name, left, right, truth, clear in pairs:
        most = int(np.ceil((truth[np.isfinite(truth)].max() + 1) / 16) * 16)
        raw, sure = matcher.disparity(left, right, most)
        both = {"network alone": (raw, sure)} | {k: mvcore.disparity(left, right, max_disparity=most, matcher=k) for k in MATCHERS}
        found = {k: d for k, (d, _) in both.items()}
        peer = cv2.StereoSGBM_create(0, most, 5, 8 * 75, 32 * 75, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
        found["HH"] = peer.compute(left[..., ::-1].copy(), right[..., ::-1].copy()).astype(np.float32) / 16
        bad = {k: metrics.disparity_metrics(d, truth)["bad_2"] for k, d in found.items()}
        if clear is not None:
            bad |= {f"{k}, not hidden": metrics.disparity_metrics(d, truth, clear)["bad_2"] for k, d in found.items()}
        known = np.isfinite(truth) & (truth > 0)
        for way, (d, confidence) in both.items():
            wrong, order = (np.abs(d - truth) > 2)[known], np.argsort(confidence[known], kind="stable")
            bad[f"{way}, bad among its least confident tenth"] = wrong[order[: len(order) // 10]].sum() / max(1, wrong.sum())
        bad |= {f"{k}, median px": metrics.disparity_metrics(d, truth)["median"] for k, d in found.items()}
        rows.append(bad)
        print(f"  {name:12s}" + _said(bad), flush=True)
    print(f"  {'mean':12s}" + _said({k: np.mean([r[k] for r in rows]) for k in rows[0]}))


def _said(figures):
    return "".join(f"  {k} {v:.3f}" if k.endswith("px") else f"  {k} {100 * v:.1f} %" for k, v in figures.items())


def stereo(arguments):
    def pairs():
        for name, left, right, true, scale in PAIRS:
            a, b = (cv2.imread(str(arguments.folders[0] / name / f))[..., ::-1].copy() for f in (left, right))
            truth = cv2.imread(str(arguments.folders[0] / name / true), cv2.IMREAD_GRAYSCALE).astype(np.float32) / scale
            yield name, a, b, truth, None

    print("bad-2.0 over all known pixels, holes counted")
    _compared(Matcher(arguments.weights), pairs())


def synthetic(arguments):
    def pairs():
        folder = arguments.folders[0]
        for pair in json.loads((folder / "pairs.json").read_text())["pairs"]:
            own = folder / pair["name"]
            a, b = (cv2.imread(str(own / f))[..., ::-1].copy() for f in ("left.png", "right.png"))
            truth = next(iter(np.load(own / "disp_left.npz").values())).astype(np.float32)
            yield pair["name"], a, b, truth, cv2.imread(str(own / "mask_nonocc.png"), cv2.IMREAD_GRAYSCALE)

    print("bad-2.0 over all known pixels, holes counted")
    _compared(Matcher(arguments.weights), pairs())


def _truth(folder, frame, kind):
    """The file of a view among depth/ or masks/: one a view, or a folder a camera."""
    path = Path(frame)
    found = [p for p in sorted((folder / kind).rglob("*.png")) if p.stem == path.stem and p.parent.name in (path.parent.name, kind)]
    return cv2.imread(str(found[0]), cv2.IMREAD_UNCHANGED)


def views(arguments):
    matcher, config = Matcher(arguments.weights), Config()
    print("share of the target's pixels within 1 % of the true depth, before any filter, no masks")
    for folder in arguments.folders:
        scene = mvcore.load(folder)
        cameras = [c.pinhole() for c in scene.calib]
        images = [load_frame(f, c, n) for n, (f, c) in enumerate(zip(scene.frames, scene.calib, strict=True))]
        points = sparse.find_points(images, cameras)
        box = view_selection.search_box(cameras, points)
        ranges = view_selection.depth_ranges(cameras, points, box, config.sparse.range_stretch, False)
        sources = view_selection.choose_sources(view_selection.view_scores(cameras, points, box, config.depth), config.depth.sources)
        gray = [depth_stage.View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c, i) for i, c in zip(images, cameras, strict=True)]
        scale = json.loads((folder / "cameras.json").read_text())["depth_scale"]
        shares = {"network alone": [], "dcnn": [], "sgm": []}
        for n in np.unique(np.linspace(0, len(images) - 1, arguments.count or 4).astype(int)):
            truth = _truth(folder, scene.frames[n], "depth").astype(np.float32) * scale
            mask = _truth(folder, scene.frames[n], "masks") > 0
            near = [gray[j] for j in sources[n]]
            inverse, _ = matcher.depth(images[n], cameras[n], [v.colour for v in near[:4]], [v.camera for v in near[:4]], *ranges[n])
            rough = depth_stage.network_depth(gray[n], near, *ranges[n])
            found = {
                "network alone": 1 / np.maximum(inverse, 1e-9),
                "dcnn": depth_stage.refine_depth(gray[n], near, rough, ()).depth,
                "sgm": depth_stage.estimate_depth(gray[n], near, *ranges[n]).depth,
            }
            for name, depth in found.items():
                shares[name].append(metrics.depth_metrics(depth, truth, mask & (truth > 0))["within_1_percent"])
        print(f"  {folder.name:14s}" + "".join(f"  {k} {np.mean(v):.3f}" for k, v in shares.items()), flush=True)


def confidence(arguments):
    from matplotlib.figure import Figure

    net = load_disparity(arguments.weights)
    figure = Figure((5, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="share of pixels kept, most confident first", ylabel="share of them that are bad")
    seen = {"pairs, network alone, 2 px": [], "pairs, dcnn, 2 px": [], "pairs, sgm, 2 px": [], "views, network alone, a plane": []}
    for n in range(30):
        for share in (1.0, 0.0):
            batch = replace(make_batch(Recipe(seed=1_000_001, held_out=True, pairs=share), n), planes=32)
            with torch.no_grad():
                found = net(batch.images[0], batch.images[1:], batch.maps, batch.low, batch.high, batch.planes)
            known = (batch.inverse > batch.low[:, None, None]) & (batch.inverse <= batch.high[:, None, None])
            if share == 0.0:
                step = ((batch.high - batch.low) / 31)[:, None, None]
                wrong = ((found.inverse - batch.inverse).abs() / step) > 1
                seen["views, network alone, a plane"].append((wrong[known].numpy(), found.confidence[known].numpy()))
                continue
            seen["pairs, network alone, 2 px"].append(
                (((found.inverse - batch.inverse).abs() > 2)[known].numpy(), found.confidence[known].numpy())
            )
            for (left, right, true, most), on in zip(_pairs_of(batch), known.numpy(), strict=True):
                for matcher in MATCHERS:
                    d, sure = mvcore.disparity(left, right, max_disparity=most, matcher=matcher)
                    seen[f"pairs, {matcher}, 2 px"].append(((np.abs(d - true) > 2)[on], sure[on]))
    for name, parts in seen.items():
        wrong, sure = (np.concatenate(p) for p in zip(*parts, strict=True))
        bad = wrong[np.argsort(-sure, kind="stable")]
        kept = np.arange(1, len(bad) + 1)
        removed = 1 - bad[: int(0.9 * len(bad))].sum() / bad.sum()
        print(f"{name}: {100 * bad.mean():.1f} % bad; the least confident tenth holds {100 * removed:.0f} % of them")
        axes.plot(kept[::1000] / len(bad), (bad.cumsum() / kept)[::1000], label=name)
    axes.legend()
    figure.savefig(arguments.folders[0], dpi=100)


VARIANTS = {
    "as shipped": ({}, {}),
    "one output module": ({"hourglasses": 0}, {}),
    "plain soft-argmin": ({"windowed": False}, {}),
    "single correlation": ({"groups": 1}, {}),
    "no floating shapes": ({}, {"floating": False}),
    "narrow baselines": ({}, {"wide": False}),
}


def ablation(arguments):
    steps = int(str(arguments.folders[0])) if arguments.folders else 300
    print(f"{steps} steps each; on held-out families: shares of pixels off by more than a plane, mean error in px")
    held = HeldOut(Recipe().seed, 40).sets["report"]
    for name, (build, data) in VARIANTS.items():
        with tempfile.TemporaryDirectory() as folder:
            training = Training(steps=steps, every=steps, warmup=20, averaging=0.98, recipe=Recipe(width=160, height=112, **data), **build)
            train_disparity(training, Path(folder), report=lambda _: None)
            net = load_disparity(Path(folder) / "best.safetensors")
        figures = validate(net, held, torch.device("cpu"))
        print(f"  {name:20s}" + "".join(f"  {k} {v:.3f}" for k, v in figures.items()), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = {f.__name__: f for f in (size, heldout, stereo, synthetic, views, confidence, ablation)}
    parser.add_argument("job", choices=jobs)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path, default=SHIPPED)
    parser.add_argument("--count", type=int, help="views of each scene (4), or held-out samples (200)")
    arguments = parser.parse_args()
    match.SHIPPED = arguments.weights
    jobs[arguments.job](arguments)


if __name__ == "__main__":
    main()
