"""The same job stage by stage, with every intermediate result in hand.

python examples/02_step_by_step.py [SCENE] [OUT.ply]
"""

import sys
from pathlib import Path

import cv2
import mvcore
from mvcore import depth
from mvcore.config import DepthConfig
from mvcore.io.images import load_frame, undistort
from mvcore.mesh import surface
from mvcore.sparse import points as sparse
from mvcore.sparse import view_selection
from mvcore.volume import tsdf as volume

SAMPLE = Path(mvcore.__file__).parent / "cli" / "sample"


def main(scene_path=SAMPLE, output="pickup.ply"):
    scene = mvcore.load(scene_path)
    images = [undistort(load_frame(f, c, n), c) for n, (f, c) in enumerate(zip(scene.frames, scene.calib, strict=True))]
    cameras = [c.pinhole() for c in scene.calib]

    points = sparse.find_points(images, cameras)
    box = view_selection.search_box(cameras, points)
    ranges = view_selection.depth_ranges(cameras, points, box, stretch=0.25, bounded=False)
    sources = view_selection.choose_sources(view_selection.view_scores(cameras, points, box, DepthConfig()), 4)

    views = [depth.View(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), c) for i, c in zip(images, cameras, strict=True)]
    found = [depth.estimate_depth(views[n], [views[j] for j in s], *ranges[n]) for n, s in enumerate(sources)]
    kept = [depth.filter_depth(n, found, cameras, s)[0] for n, s in enumerate(sources)]

    mesh = surface.extract_surface(volume.fuse(kept, cameras, box))
    import trimesh

    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(output)
    print(f"{output}: {len(mesh.faces)} faces")


if __name__ == "__main__":
    main(*sys.argv[1:])
