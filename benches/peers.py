"""Each kernel beside what a user would pick instead, in one process on one input: medians and ratios.

    python benches/peers.py [--middlebury DIR]

Peers: OpenCV's StereoSGBM, Open3D's TSDF volume and silhouette carving, NumPy, VTK's FlyingEdges, scikit-image's Marching Cubes; those
that are not installed are left out. Threads: as the environment sets them (RAYON_NUM_THREADS, OMP_NUM_THREADS).
"""

import argparse
import statistics
import time
from pathlib import Path

import cv2
import mvcore
import numpy as np
from mvcore import _core
from mvcore.config import VolumeConfig
from mvcore.evaluation import metrics
from mvcore.mesh.surface import isosurface, marching_cubes
from mvcore.types import DepthMap
from mvcore.volume.tsdf import fuse


def median(job, repeats=5):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = job()
        times.append(time.perf_counter() - start)
    return statistics.median(times), result


def line(name, seconds, ours, note=""):
    print(f"  {name:32s} {seconds:8.3f} s   {seconds / ours:6.2f} x ours   {note}")


def aggregation():
    print("aggregation, 8 directions, 1280 x 960 x 128, with winner (OpenCV includes its matching cost)")
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (960, 1280), np.uint8), (0, 0), 1.0)
    right = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    x, y = np.meshgrid(np.arange(1280, dtype=np.float32), np.arange(960, dtype=np.float32))
    truth = 20 + 60 * np.exp(-((x - 640) ** 2 + (y - 480) ** 2) / 1e5).astype(np.float32)
    left = cv2.remap(right, x - truth, y, cv2.INTER_LINEAR)
    pair = np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, -1, 0, 0]], np.float32)
    costs = _core.sweep(left, [right], pair, np.arange(128, dtype=np.float32))
    ours, (plane, _) = median(lambda: _core.aggregate(costs, left, 6, 60, 12))
    inner = np.s_[10:-10, 100:-10]
    line("mvcore aggregate", ours, ours, f"median error {np.median(np.abs(plane - truth)[inner]):.3f} px")
    for name, mode in (("OpenCV HH", cv2.STEREO_SGBM_MODE_HH), ("OpenCV HH4", cv2.STEREO_SGBM_MODE_HH4)):
        peer = cv2.StereoSGBM_create(0, 128, 5, 8 * 25, 32 * 25, 1, 0, 10, 0, 0, mode)
        seconds, found = median(lambda peer=peer: peer.compute(left, right), 3)
        line(name, seconds, ours, f"median error {np.median(np.abs(found / 16 - truth)[inner]):.3f} px")


def camera(k, n, width=640, height=480, focal=600.0):
    a = 2 * np.pi * k / n
    r = np.array([[-np.sin(a), np.cos(a), 0], [0, 0, -1], [-np.cos(a), -np.sin(a), 0]])
    matrix = [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]
    return mvcore.Camera(matrix, r, [0, 0, 3], width, height)


def sphere_depth(c, radius=1.0):
    rays = np.column_stack([c.pixel_grid().reshape(-1, 2), np.ones(c.width * c.height)]) @ np.linalg.inv(c.K).T @ c.R
    a, b, d = (rays**2).sum(1), rays @ c.center, c.center @ c.center - radius**2
    root = b * b - a * d
    depth = np.where(root > 0, (-b - np.sqrt(root.clip(0))) / a, 0)
    return depth.reshape(c.height, c.width).astype(np.float32)


def fusion():
    print("fusion, 24 depth maps 640 x 480 of a unit sphere, 256 voxels a side")
    cameras = [camera(k, 24) for k in range(24)]
    depths = [sphere_depth(c) for c in cameras]
    voxel = 2.2 / 256
    maps = [DepthMap(d, np.ones_like(d)) for d in depths]
    bounds = np.array([[-1.1] * 3, [1.1] * 3])
    ours, volume = median(lambda: fuse(maps, cameras, bounds, config=VolumeConfig(voxel=voxel)))

    def error(vertices):
        if not len(vertices):
            return "no surface: not comparable"
        return f"mean error {np.abs(np.linalg.norm(vertices, axis=1) - 1).mean() / voxel:.3f} voxel"

    line("mvcore fuse", ours, ours, error(isosurface(volume).vertices))
    try:
        import open3d as o3d
    except ImportError:
        return

    def theirs():
        tsdf = o3d.pipelines.integration.ScalableTSDFVolume(voxel, 4 * voxel, o3d.pipelines.integration.TSDFVolumeColorType.NoColor)
        for c, d in zip(cameras, depths):
            rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(np.zeros((c.height, c.width, 3), np.uint8)), o3d.geometry.Image(d), 1.0, 10.0, False
            )
            k = c.K
            pinhole = o3d.camera.PinholeCameraIntrinsic(c.width, c.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = c.R, c.t
            tsdf.integrate(rgbd, pinhole, pose)
        return tsdf

    seconds, tsdf = median(theirs, 3)
    line("Open3D ScalableTSDFVolume", seconds, ours, error(np.asarray(tsdf.extract_triangle_mesh().vertices)))


def lumps(c, balls):
    """Silhouette of some balls, (h, w) uint8."""
    rays = np.concatenate([c.pixel_grid(), np.ones((c.height, c.width, 1))], -1).reshape(-1, 3) @ np.linalg.inv(c.K).T @ c.R
    inside = np.zeros(len(rays), bool)
    for center, radius in balls:
        to = c.center - center
        inside |= (rays @ to) ** 2 - (rays**2).sum(1) * (to @ to - radius**2) > 0
    return np.ascontiguousarray(inside.reshape(c.height, c.width).astype(np.uint8) * 255)


def numpy_carving(origin, voxel, n, masks, cameras):
    """The votes of all views on all voxels, vectorised."""
    axis = [o + voxel * np.arange(n) for o in origin]
    points = np.stack(np.meshgrid(*axis, indexing="ij"), -1).reshape(-1, 3)
    seen, against = np.zeros(len(points), np.uint8), np.zeros(len(points), np.uint8)
    for mask, c in zip(masks, cameras):
        q = points @ c.projection[:, :3].T + c.projection[:, 3]
        x = np.rint(q[:, :2] / q[:, 2:]).astype(np.int32)
        inside = (q[:, 2] > 0) & (x >= 0).all(1) & (x[:, 0] < c.width) & (x[:, 1] < c.height)
        seen += inside
        against[inside] += mask[x[inside, 1], x[inside, 0]] == 0
    return ((seen >= 1) & (against == 0)).reshape(n, n, n)


def carving():
    print("carving, 24 silhouettes 640 x 480 into 256^3")
    rng = np.random.default_rng(0)
    balls = [(rng.uniform(-0.6, 0.6, 3), rng.uniform(0.2, 0.5)) for _ in range(9)]
    cameras = [camera(k, 24) for k in range(24)]
    masks = [lumps(c, balls) for c in cameras]
    n, origin, voxel = 256, [-1.13, -1.11, -1.12], 2.2 / 255
    p = np.stack([c.projection for c in cameras])
    ours, hull = median(lambda: _core.carve(origin, voxel, [n] * 3, masks, p, tolerance=0.0, least_views=1))
    line("mvcore carve", ours, ours)
    seconds, theirs = median(lambda: numpy_carving(origin, voxel, n, masks, cameras), 1)
    line("NumPy, vectorised", seconds, ours, f"{(hull != theirs).sum()} of {hull.size} voxels differ")
    try:
        import open3d as o3d
    except ImportError:
        return

    def carve():
        grid = o3d.geometry.VoxelGrid.create_dense(np.array(origin) - voxel / 2, np.zeros(3), voxel, n * voxel, n * voxel, n * voxel)
        for mask, c in zip(masks, cameras):
            view = o3d.camera.PinholeCameraParameters()
            k = c.K
            view.intrinsic = o3d.camera.PinholeCameraIntrinsic(c.width, c.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            view.extrinsic = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])
            grid.carve_silhouette(o3d.geometry.Image((mask > 0).astype(np.float32)), view, False)
        return grid

    seconds, grid = median(carve, 1)
    line("Open3D carve_silhouette", seconds, ours, f"{len(grid.get_voxels())} voxels, ours {hull.sum()}")


def surfaces():
    print("Marching Cubes, sphere in 512 x 512 x 512")
    axis = np.arange(512, dtype=np.float32) - 255.5
    field = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2) - np.float32(200)
    ours, (_, faces) = median(lambda: marching_cubes(field))
    line("mvcore marching_cubes", ours, ours, f"{len(faces)} faces")
    try:
        import vtk
        from vtk.util.numpy_support import numpy_to_vtk

        vtk.vtkSMPTools.SetBackend("STDThread")
        image = vtk.vtkImageData()
        image.SetDimensions(512, 512, 512)
        image.GetPointData().SetScalars(numpy_to_vtk(field.ravel()))

        def edges():
            flying = vtk.vtkFlyingEdges3D()
            flying.SetInputData(image)
            flying.SetValue(0, 0.0)
            flying.ComputeNormalsOff()
            flying.Update()
            return flying

        seconds, flying = median(edges, 3)
        line("VTK FlyingEdges", seconds, ours, f"{flying.GetOutput().GetNumberOfPolys()} faces")
    except ImportError:
        pass
    try:
        from skimage.measure import marching_cubes as theirs

        seconds, found = median(lambda: theirs(field, 0.0), 1)
        line("scikit-image marching_cubes", seconds, ours, f"{len(found[1])} faces")
    except ImportError:
        pass


PAIRS = (
    ("cone", "im2.png", "im6.png", "disp2.png", 4),
    ("teddy", "im2.png", "im6.png", "disp2.pgm", 4),
    ("Cloth3", "view1.png", "view5.png", "disp1.png", 2),
    ("adirondack", "Adirondack_left.png", "Adirondack_right.png", "Adirondack_gt.png", 1),
)


def middlebury(folder):
    print("Middlebury pairs: bad-2.0 over known pixels with holes counted, median error of the rest")
    rows = []
    for name, left, right, true, scale in PAIRS:
        a, b = (cv2.imread(str(folder / name / f)) for f in (left, right))
        truth = cv2.imread(str(folder / name / true), cv2.IMREAD_GRAYSCALE).astype(np.float32) / scale
        most = int(np.ceil((truth.max() + 1) / 16) * 16)
        found, _ = mvcore.disparity(a[..., ::-1].copy(), b[..., ::-1].copy(), max_disparity=most)
        peer = cv2.StereoSGBM_create(0, most, 5, 8 * 75, 32 * 75, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
        theirs = peer.compute(a, b).astype(np.float32) / 16
        row = [metrics.disparity_metrics(d, truth) for d in (found, theirs)]
        rows.append([row[0]["bad_2"], row[0]["median"], row[1]["bad_2"], row[1]["median"]])
        print(
            f"  {name:12s} mvcore {100 * rows[-1][0]:5.1f} %  {rows[-1][1]:.3f} px    HH {100 * rows[-1][2]:5.1f} %  {rows[-1][3]:.3f} px"
        )
    mean = np.mean(rows, 0)
    print(f"  {'mean':12s} mvcore {100 * mean[0]:5.1f} %  {mean[1]:.3f} px    HH {100 * mean[2]:5.1f} %  {mean[3]:.3f} px")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--middlebury", type=Path, help="folder with cone, teddy, Cloth3, adirondack")
    arguments = parser.parse_args()
    aggregation()
    fusion()
    carving()
    surfaces()
    if arguments.middlebury:
        middlebury(arguments.middlebury)


if __name__ == "__main__":
    main()
