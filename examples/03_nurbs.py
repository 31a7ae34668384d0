"""A mesh becomes one NURBS surface: fitted to a tolerance, written for CAD programs, drawn as a picture.

python examples/03_nurbs.py [PICTURE.png] [MESH]
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import trimesh
from mvcore import nurbs


def vase():
    """A mesh that knows nothing of splines: sections skinned, then cut into triangles and roughened."""
    heights = np.linspace(0, 3, 9)
    sections = [nurbs.circle(0.6 + 0.25 * np.sin(2 * z), center=(0, 0, z)) for z in heights]
    mesh = nurbs.to_mesh(nurbs.loft(sections), 0.002)
    mesh.vertices += np.random.default_rng(0).normal(0, 0.002, mesh.vertices.shape)
    return mesh


def picture(surface, size=700):
    """Points of the surface and their normals, painted from the farthest to the nearest, lit from the viewer's side."""
    axes = [np.linspace(*d, 1800) for d in surface.domain]
    d = surface.derivatives_grid(*axes, 1)
    points, normals = d[0, 0].reshape(-1, 3), np.cross(d[1, 0], d[0, 1]).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-300
    towards = np.array([0.8, -0.5, 0.33]) / np.linalg.norm([0.8, -0.5, 0.33])
    right = np.cross([0, 0, 1], towards)
    right /= np.linalg.norm(right)
    frame = np.stack([right, -np.cross(towards, right), towards])
    place = (points - points.mean(0)) @ frame.T
    scale = 0.9 * size / np.ptp(place[:, :2], axis=0).max()
    x, y = ((place[:, k] - (place[:, k].min() + place[:, k].max()) / 2) * scale + size / 2 for k in (0, 1))
    light = np.abs(normals @ (towards + 0.4 * right) / np.linalg.norm(towards + 0.4 * right))
    order = place[:, 2].argsort()
    image = np.full((size, size), 255, np.uint8)
    image[y[order].astype(int), x[order].astype(int)] = (40 + 200 * light[order]).astype(np.uint8)
    return image


def main(output="nurbs.png", mesh_path=None):
    mesh = vase() if mesh_path is None else trimesh.load(mesh_path, force="mesh")
    size = float(np.linalg.norm(mesh.extents))
    fit = nurbs.fit_target(mesh, tolerance=0.01 * size, max_control_points=4000)
    print(
        f"{fit.control_points} control points, {len(mesh.vertices)} vertices, off by {fit.rms_deviation:.2g} rms, {fit.max_deviation:.2g}"
    )
    print("within the tolerance" if fit.converged else f"tolerance not reached; {fit.ignored:.0%} of the sections lie in other loops")
    folder = Path(output).parent
    nurbs.save_step(folder / "nurbs.step", fit.surface)
    nurbs.save_obj(folder / "nurbs.obj", fit.surface)
    cv2.imwrite(str(output), picture(fit.surface))


if __name__ == "__main__":
    main(*sys.argv[1:])
