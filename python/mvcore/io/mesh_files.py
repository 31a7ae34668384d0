"""Meshes from files of any kind that trimesh reads."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FormatError
from .limits import read_bytes

if TYPE_CHECKING:
    import trimesh

MOST_MESH = 4 << 30
"""Bytes of a mesh file."""


def load_mesh(path: Path) -> trimesh.Trimesh | trimesh.PointCloud:
    """One mesh (or point cloud) of a file, node transforms applied. Files that it refers to are not opened.

    Raises
    ------
    FileNotFoundError
        No such file.
    FormatError
        Not a mesh that trimesh reads, or one with faces of missing vertices or with NaN.
    """
    import trimesh

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    data = io.BytesIO(read_bytes(path, MOST_MESH))
    try:
        loaded = trimesh.load(data, file_type=path.suffix.lower().lstrip("."), process=False)
        mesh: Any = loaded.to_geometry() if isinstance(loaded, trimesh.Scene) else loaded
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(getattr(mesh, "faces", np.zeros((0, 3), int)))
    except Exception as error:  # trimesh and what it calls raise whatever a malformed file makes them
        raise FormatError(f"{path}: not a mesh that can be read: {type(error).__name__}: {error!s:.200}") from None
    whole = vertices.ndim == 2 and vertices.shape[1] == 3 and np.isfinite(vertices).all()
    if not whole or (faces.size and not (faces.shape[1:] == (3,) and faces.min() >= 0 and faces.max() < len(vertices))):
        raise FormatError(f"{path}: expected triangles of existing vertices at finite positions")
    return mesh
