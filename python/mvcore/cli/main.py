"""The command line: one command a job. Errors are one line on stderr with exit code 2; ``--debug`` shows the traceback."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ..io.scene import Scene

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, help=__doc__)

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


@contextmanager
def _one_line_errors(debug: bool) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise typer.Exit(130) from None
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        if debug:
            raise
        print(f"mvcore: {' '.join(str(error).split())}", file=sys.stderr)
        raise typer.Exit(2) from None


class _Bars:
    """rich's progress bars as a `Track`."""

    def __call__(self, items: Iterable[Any], description: str, total: int | None = None) -> Iterable[Any]:
        from rich.console import Console
        from rich.progress import track

        return track(items, description, total, console=Console(stderr=True))


def _numbers(name: str, text: str | None, count: int | None = None, kind: type = float) -> list[Any] | None:
    if text is None:
        return None
    try:
        values = [kind(word) for word in text.split(",") if word.strip()]
    except ValueError:
        raise ValueError(f"{name}: expected numbers separated by commas, got {text!r}") from None
    if count is not None and len(values) != count:
        raise ValueError(f"{name}: expected {count} numbers, got {len(values)}")
    return values


def _without(scene: Scene, excluded: list[int] | None) -> tuple[list[Any], list[Any], list[int]]:
    excluded = excluded or []
    wrong = [n for n in excluded if not 0 <= n < len(scene)]
    if wrong:
        raise ValueError(f"--exclude: expected views 0 to {len(scene) - 1}, got {wrong[0]}")
    kept = [n for n in range(len(scene)) if n not in set(excluded)]
    return [scene.frames[n] for n in kept], [scene.calib[n] for n in kept], kept


def _settings(matcher: str, device: str, max_image_size: int | None, max_faces: int | None, closed: bool) -> dict[str, Any]:
    """A configuration from the options that commands share."""
    if max_image_size is not None and max_image_size < 16:
        raise ValueError(f"--max-image-size: expected at least 16, got {max_image_size}")
    settings: dict[str, Any] = {"matcher": matcher, "device": device}
    if max_image_size is not None:
        settings["depth"] = {"max_image_size": max_image_size}
    surface: dict[str, Any] = {}
    if max_faces is not None:
        surface["max_faces"] = max_faces
    if closed:
        surface["unseen_reach"] = None
    return settings | ({"surface": surface} if surface else {})


Matcher = Annotated[str, typer.Option(help="Depth matcher: sgm (classical) or dcnn (with the network).")]
Closed = Annotated[bool, typer.Option("--closed", help="Keep the sides that silhouettes bound but no photograph shows.")]
Device = Annotated[str, typer.Option(help="Where the network runs: cpu or cuda.")]


@app.command()
def reconstruct(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file; the format is found by itself.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Mesh to write: .glb, .obj or .ply.")],
    exclude: Annotated[str | None, typer.Option(help="Views to leave out, e.g. 4,9.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, bright on the target.")] = None,
    bounds: Annotated[str | None, typer.Option(help="Box of the target: x0,y0,z0,x1,y1,z1.")] = None,
    max_image_size: Annotated[int | None, typer.Option(help="Reduce images to this many pixels on the longer side.")] = None,
    max_faces: Annotated[int | None, typer.Option(help="Decimate the mesh to this many faces.")] = None,
    closed: Closed = False,
    report: Annotated[Path | None, typer.Option(help="Write figures and warnings as JSON.")] = None,
    save_depth: Annotated[Path | None, typer.Option(help="Folder for the depth maps.")] = None,
    matcher: Matcher = "sgm",
    device: Device = "cpu",
    debug: Debug = False,
) -> None:
    """Calibrated photographs in, a textured mesh out."""
    with _one_line_errors(debug):
        from ..io import load
        from ..io.images import find_masks
        from ..pipeline import reconstruct as pipeline
        from ..io.meshes import FORMATS

        if output.suffix.lower() not in FORMATS:
            raise ValueError(f"--output: expected a name ending in {', '.join(FORMATS)}, got {str(output)!r}")
        settings = _settings(matcher, device, max_image_size, max_faces, closed)
        scene = load(path)
        frames, cameras, kept = _without(scene, _numbers("--exclude", exclude, kind=int))
        box = _numbers("--bounds", bounds, 6)
        given = find_masks(masks, frames) if masks is not None else None
        if given is None and scene.masks is not None:
            print("masks lie beside the images; pass --masks to use them", file=sys.stderr)
        result = pipeline.reconstruct(
            frames, cameras, masks=given, bounds=box if box is not None else scene.bounds, config=settings, track=_Bars()
        )
        result.report |= {"input": str(path), "format": scene.format, "view_numbers": kept}
        result.save(output)
        if save_depth is not None:
            result.save_depth(save_depth)
        if report is not None:
            result.save_report(report)
        for warning in result.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        seconds = result.report["seconds"].values()
        cpu, wall = sum(s["cpu"] for s in seconds), sum(s["wall"] for s in seconds)
        print(f"{output}: {len(result.faces)} faces from {len(frames)} views, {wall:.0f} s ({cpu:.0f} CPU seconds)")


@app.command()
def video(
    path: Annotated[Path, typer.Argument(help="A folder of clips: video files, or a folder of images a camera.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the meshes and their index.")],
    calib: Annotated[Path | None, typer.Option(help="Calibration; by default what lies in the folder.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of mask clips, bright on the target; by default it is found.")] = None,
    background: Annotated[str | None, typer.Option(help="Folder of clean plates; 'none' for the whole scene.")] = None,
    regions: Annotated[Path | None, typer.Option(help="Folder of CAMERA.png, bright where targets may be (a road).")] = None,
    bounds: Annotated[str | None, typer.Option(help="Box where targets are: x0,y0,z0,x1,y1,z1.")] = None,
    start: Annotated[int, typer.Option(help="First instant.")] = 0,
    stop: Annotated[int | None, typer.Option(help="Instant to stop before.")] = None,
    stride: Annotated[int, typer.Option(help="Take every so manieth instant.")] = 1,
    target: Annotated[str, typer.Option(help="free, or rigid: all instants make one model.")] = "free",
    scheduler: Annotated[str | None, typer.Option(help="A dask.distributed scheduler, tcp://host:port.")] = None,
    workdir: Annotated[Path | None, typer.Option(help="Keeps results; an interrupted run goes on there.")] = None,
    max_image_size: Annotated[int | None, typer.Option(help="Reduce images to this many pixels on the longer side.")] = None,
    max_faces: Annotated[int | None, typer.Option(help="Decimate each mesh to this many faces.")] = None,
    closed: Closed = False,
    matcher: Matcher = "sgm",
    device: Device = "cpu",
    debug: Debug = False,
) -> None:
    """Synchronised clips in, a textured mesh an instant out."""
    with _one_line_errors(debug):
        from ..io import load_video
        from ..io.images import find_pictures
        from ..video.api import reconstruct_video

        clips = load_video(path, calib, start=start, stop=stop, stride=stride)
        settings = _settings(matcher, device, max_image_size, max_faces, closed)
        if scheduler is not None and workdir is None:
            workdir = output / "work"  # a temporary folder would be this machine's alone
        names = [c.name for c in clips.clips]
        run = reconstruct_video(
            clips,
            masks=masks,
            background=False if background == "none" else background,
            regions=find_pictures(regions, names) if regions is not None else None,
            bounds=_numbers("--bounds", bounds, 6),
            target=target,
            config=settings,
            scheduler=scheduler,
            workdir=workdir,
            track=_Bars(),
        )
        run.save(output)
        for warning in run.warnings:
            print(f"warning: {warning}", file=sys.stderr)
        print(f"{output}: {len(run)} instants of {len(names)} cameras, {sum(run.seconds):.0f} s")


@app.command()
def view(
    output: Annotated[Path, typer.Argument(help="Folder that 'mvcore video' wrote.")],
    page: Annotated[Path | None, typer.Option(help="Page to write; by default view.html in the folder.")] = None,
    debug: Debug = False,
) -> None:
    """One self-contained HTML page with a time slider, depth maps and the report."""
    with _one_line_errors(debug):
        from ..viewer.page import write_page

        print(write_page(output, page))


@app.command()
def disparity(
    left: Annotated[Path, typer.Argument(help="Left image of a rectified pair.")],
    right: Annotated[Path, typer.Argument(help="Right image.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Disparity map to write: .pfm, or .png (a picture).")],
    max_disparity: Annotated[int, typer.Option(help="Largest disparity in pixels.")],
    min_disparity: Annotated[int, typer.Option(help="Smallest disparity in pixels.")] = 0,
    matcher: Matcher = "sgm",
    device: Device = "cpu",
    debug: Debug = False,
) -> None:
    """Disparity of the left image of a rectified pair."""
    with _one_line_errors(debug):
        from .. import _core
        from ..depth import disparity as match
        from ..io.files import atomically
        from ..io.images import read_image
        from ..io.maps import colourise, write_pfm

        if output.suffix not in (".pfm", ".png"):
            raise ValueError(f"--output: expected a name ending in .pfm or .png, got {str(output)!r}")
        ends = {"max_disparity": max_disparity, "min_disparity": min_disparity}
        found, _ = match(read_image(left), read_image(right), **ends, matcher=matcher, device=device)
        if output.suffix == ".pfm":
            write_pfm(output, found)
        else:
            picture = _core.encode_png(colourise(1 / found.clip(1e-3)))
            atomically(output, lambda p: p.write_bytes(picture) and None)
        print(f"{output}: {found.shape[1]} x {found.shape[0]}, median {float(sorted(found.ravel())[found.size // 2]):.2f} px")


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file.")],
    debug: Debug = False,
) -> None:
    """What was read, and how well the calibration fits the images."""
    with _one_line_errors(debug):
        from ..errors import ReconstructionError
        from ..io import load
        from ..io.images import load_frame, undistort
        from ..sparse.points import find_points
        from ..sparse.view_selection import target_box
        from ..types import Report

        scene = load(path)
        sizes = sorted({(c.width, c.height) for c in scene.calib})
        print(f"{path}: {scene.format}, {len(scene)} views of {', '.join(f'{w} x {h}' for w, h in sizes)}")
        print(f"distortion: {'yes' if any(c.distortion.size for c in scene.calib) else 'no'}; masks: {'yes' if scene.masks else 'no'}")
        scene.calib.check_baselines()
        report = Report()
        images = [undistort(load_frame(f, c, n), c) for n, (f, c) in enumerate(zip(scene.frames, scene.calib, strict=True))]
        cameras = [c.pinhole() for c in scene.calib]
        try:
            points = find_points(images, cameras, report=report, track=_Bars())
        except ReconstructionError as error:
            print(f"calibration: {error}")
            raise typer.Exit(1) from None
        error_px = report.values["calibration"]["median_epipolar_error_px"]
        shown = "unknown (too few matches)" if error_px is None else f"median epipolar error {error_px:.2f} px"
        print(f"calibration: {shown}; {len(points)} sparse points")
        box = scene.bounds if scene.bounds is not None else target_box(cameras, points)
        print(f"target box: {box.round(4).tolist()}{' (given)' if scene.bounds is not None else ''}")
        for warning in report.warnings:
            print(f"warning: {warning}")


@app.command()
def convert(
    path: Annotated[Path, typer.Argument(help="A folder or calibration file of any known format.")],
    output: Annotated[Path, typer.Argument(help="cameras.json, or a folder for COLMAP or MVSNet files.")],
    to: Annotated[str | None, typer.Option(help="mvcore, colmap or mvsnet; by default mvcore for .json, else colmap.")] = None,
    debug: Debug = False,
) -> None:
    """Calibrations from one format to another."""
    with _one_line_errors(debug):
        from ..io import load, save_calibration

        format = to or ("mvcore" if output.suffix == ".json" else "colmap")
        scene = load(path, images=False)
        save_calibration(output, scene, format)
        print(f"{output}: {len(scene)} views as {format}")


@app.command(name="eval")
def evaluate(
    result: Annotated[Path, typer.Argument(help="Mesh or points to judge.")],
    truth: Annotated[Path, typer.Argument(help="True mesh or points.")],
    thresholds: Annotated[str, typer.Option(help="Distances for the F-score, world units.")],
    visible: Annotated[Path | None, typer.Option(help="Points of the truth that the views see.")] = None,
    samples: Annotated[int, typer.Option(help="Samples of each surface.")] = 1_000_000,
    debug: Debug = False,
) -> None:
    """Accuracy, completeness, overall and F-score of a mesh, as JSON."""
    with _one_line_errors(debug):
        from ..evaluation.metrics import load_geometry, mesh_metrics

        seen = load_geometry(visible)[0] if visible is not None else None
        found = mesh_metrics(
            load_geometry(result),
            load_geometry(truth),
            _numbers("--thresholds", thresholds) or [],
            visible=seen,
            samples=samples,
        )
        print(json.dumps(found, indent=1))


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the result.")] = Path("out"),
    debug: Debug = False,
) -> None:
    """Reconstruct the bundled sample: a pickup in a yard, 16 views."""
    with _one_line_errors(debug):
        sample = Path(__file__).parent / "sample"
        if not (sample / "cameras.json").is_file():
            raise FileNotFoundError(f"{sample}: the bundled sample is not installed")
        reconstruct(sample, output / "pickup.glb", masks=sample / "masks", report=output / "report.json", save_depth=output / "depth")


train = typer.Typer(no_args_is_help=True, help="Train the network, or look at what it is trained on.")
app.add_typer(train, name="train")


@train.command("data")
def train_data(
    preview: Annotated[Path, typer.Option(help="Contact sheet to write, a PNG.")],
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 1,
    held_out: Annotated[bool, typer.Option(help="Shapes and textures kept for validation.")] = False,
    debug: Debug = False,
) -> None:
    """A contact sheet of procedural scenes: views, true inverse depth, what the first source sees."""
    with _one_line_errors(debug):
        from .._core import encode_png
        from ..io.files import atomically
        from ..network.procedural.scenes import contact_sheet

        sheet, speed = contact_sheet(seed, held_out)
        encoded = encode_png(sheet)

        def write(path: Path) -> None:
            path.write_bytes(encoded)

        atomically(preview, write)
        print(f"{preview}: {speed:.1f} samples a second")


@train.command("disparity")
def train_disparity_network(
    out: Annotated[Path, typer.Option(help="Folder of checkpoints, log and weights; an earlier run there goes on.")],
    steps: Annotated[int, typer.Option(min=1, help="Batches in all.")] = 10_000,
    preset: Annotated[str, typer.Option(help="compact or paper.")] = "compact",
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    hours: Annotated[float | None, typer.Option(help="End after this long if not by the steps; the rate falls to zero by then.")] = None,
    data: Annotated[
        list[str] | None, typer.Option(help="A published set, LAYOUT:FOLDER (dtu, blendedmvs, sceneflow, kitti, middlebury).")
    ] = None,
    middlebury: Annotated[Path | None, typer.Option(help="Folder of Middlebury pairs to validate on as well.")] = None,
    batch: Annotated[int, typer.Option(min=2, help="Samples a batch.")] = 2,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the samples, multiples of 16.")] = "256x192",
    workers: Annotated[int, typer.Option(min=0, help="Processes that render.")] = 1,
    rate: Annotated[float, typer.Option(help="Learning rate.")] = 1e-3,
    start: Annotated[Path | None, typer.Option(help="Weights to begin from.")] = None,
    freeze_norms: Annotated[bool, typer.Option(help="Batch normalisation keeps the statistics of --start: for small batches.")] = False,
    bfloat16: Annotated[bool | None, typer.Option(help="Most of the work in that precision; by default on CUDA.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Batches between checkpoints.")] = 250,
    seed: Annotated[int, typer.Option(help="Of the scenes.")] = 1,
    debug: Debug = False,
) -> None:
    """Train the disparity network on procedural scenes, and on published sets where given."""
    with _one_line_errors(debug):
        from ..network.features import PRESETS
        from ..network.training.batches import Recipe
        from ..network.training.datasets import find_items
        from ..network.training.logs import plot_log
        from ..network.training.train_disparity import Training, keep_memory, train_disparity

        if preset not in PRESETS:
            raise ValueError(f"--preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
        for source in data or ():
            print(f"{source}: {len(find_items(source))} samples")
        width, height = _sides(size)
        recipe = Recipe(seed, batch, width, height, data=tuple(data or ()))
        pairs = str(middlebury) if middlebury else None
        begun = str(start) if start else None
        training = Training(
            steps,
            preset,
            rate=rate,
            every=every,
            hours=hours,
            workers=workers,
            bfloat16=bfloat16,
            freeze_norms=freeze_norms,
            recipe=recipe,
            middlebury=pairs,
            start=begun,
        )
        keep_memory()
        print(train_disparity(training, out, device))
        plot_log(out / "log.csv", out / "log.png")


def _sides(size: str) -> tuple[int, int]:
    sides = [int(n) for n in size.split("x")] if re.fullmatch(r"\d+x\d+", size) else []
    if len(sides) != 2 or min(sides) < 32 or sides[0] % 16 or sides[1] % 16:
        raise ValueError(f"--size: expected WIDTHxHEIGHT, multiples of 16 from 32 on, got {size!r}")
    return sides[0], sides[1]


@train.command("recognition")
def train_recognition_head(
    out: Annotated[Path, typer.Option(help="Folder of checkpoint, log and weights; an earlier run there goes on.")],
    steps: Annotated[int, typer.Option(min=1, help="Batches in all.")] = 3000,
    preset: Annotated[str, typer.Option(help="compact or paper.")] = "compact",
    error: Annotated[str, typer.Option(help="entropy, or squared (the paper's eq 34).")] = "entropy",
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    debug: Debug = False,
) -> None:
    """Train the recognition head on procedural targets seen from several angles."""
    with _one_line_errors(debug):
        from ..network.features import PRESETS
        from ..network.training.logs import plot_log
        from ..network.training.train_recognition import RecognitionTraining, train_recognition

        if preset not in PRESETS:
            raise ValueError(f"--preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
        if error not in ("entropy", "squared"):
            raise ValueError(f"--error: expected entropy or squared, got {error!r}")
        print(train_recognition(RecognitionTraining(steps=steps, preset=preset, error=error), out, device))
        plot_log(out / "log.csv", out / "log.png")


def main() -> None:
    """Entry point; Ctrl-C ends quietly."""
    try:
        app()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
