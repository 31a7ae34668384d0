"""Clips of a moving target: a mesh an instant, as soon as it is done.

    python examples/05_video.py CLIPS OUT

CLIPS holds a folder of images a camera (or video files) and their calibration.
"""

import sys
from pathlib import Path

import mvcore


def main(clips_path, output="out"):
    clips = mvcore.load_video(clips_path)
    for warning in clips.warnings:
        print(f"warning: {warning}")
    folder = Path(output)
    folder.mkdir(exist_ok=True)
    for result in mvcore.reconstruct_video(clips, workdir=folder / "work"):
        instant = result.report["instant"]
        if len(result.faces):
            result.save(folder / f"{instant:04d}.glb")
        print(f"instant {instant}: {len(result.faces)} faces, {result.report.get('surface', 'nothing seen')}")


if __name__ == "__main__":
    main(*sys.argv[1:])
