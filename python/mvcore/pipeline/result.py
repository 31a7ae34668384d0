"""What a reconstruction gives back, and how it is saved."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from .. import _core
from ..errors import InvalidInputError, require
from ..geometry.cameras import Calibration
from ..io.files import atomically
from ..io.maps import colourise, write_depth_png, write_pfm
from ..io.meshes import TexturedMesh, save_mesh
from ..types import Bounds, DepthMap, Image, SparsePoints

if TYPE_CHECKING:
    import trimesh


@dataclass
class Reconstruction:
    """A textured mesh in the caller's frame and units, with all that led to it.

    vertices : (V, 3) float64. faces : (F, 3) uint32, counter-clockwise from outside. uv : (V, 2) float32, origin
    bottom-left. texture : (h, w, 3) uint8. depths, confidences : a `DepthMap` a view (filtered), None where a view was left
    out. face_views : (F,) int32, the photograph of each face, -1 where none sees it. cameras : the undistorted, possibly
    reduced cameras of the depth maps. report : figures that JSON can hold.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    texture: Image
    depths: Sequence[DepthMap | None]
    cameras: Calibration
    sparse: SparsePoints
    bounds: Bounds
    face_views: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The mesh with its texture as trimesh knows it."""
        import trimesh

        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=PillowImage.fromarray(self.texture), metallicFactor=0.0, roughnessFactor=1.0
        )
        visual = trimesh.visual.TextureVisuals(uv=self.uv, material=material)
        return trimesh.Trimesh(self.vertices, self.faces, visual=visual, process=False)

    @property
    def warnings(self) -> list[str]:
        """What went less well than it should."""
        return list(self.report.get("warnings", []))

    @property
    def textured(self) -> TexturedMesh:
        """The mesh as `mvcore.io.meshes` writes it."""
        voxel = self.report.get("volume", {}).get("voxel")
        if voxel is None:  # a mesh of another source: its edges tell how fine it is
            edges = self.vertices[self.faces] - self.vertices[np.roll(self.faces, 1, 1)] if len(self.faces) else np.ones((1, 3))
            voxel = float(np.median(np.linalg.norm(edges, axis=-1)))
        return TexturedMesh(self.vertices, self.faces, self.uv, self.texture, float(voxel))

    def save(self, path: str | Path) -> None:
        """Write ``.glb`` (texture inside), ``.obj`` (+ .mtl, .png) or ``.ply`` (vertex colours); complete or not at all.

        Coordinates are the caller's, to a hundredth of a voxel and better. Where GLB's float32 cannot hold them, its vertices are relative
        to the translation of their node, which the file's ``extras`` and ``report["glb_offset"]`` repeat.

        Raises
        ------
        InvalidInputError
            Another suffix.
        """
        offset = save_mesh(path, self.textured)
        if offset is not None:
            self.report["glb_offset"] = offset.tolist()

    def vertex_colours(self) -> NDArray[np.uint8]:
        """Texture colour of each vertex, (V, 3) uint8."""
        return self.textured.vertex_colours()

    def save_depth(self, folder: str | Path, format: str = "pfm") -> None:
        """Write each view's filtered depth as ``pfm``, ``png`` (16 bit, scale beside it) or ``npz``, and a coloured picture."""
        require(format in ("pfm", "png", "npz"), "format", "pfm, png or npz", repr(format))
        folder = Path(folder)
        for n, view in enumerate(self.depths):
            if view is None:
                continue
            name = f"view{n:03d}"
            if format == "pfm":
                write_pfm(folder / f"{name}.pfm", view.depth)
                write_pfm(folder / f"{name}_confidence.pfm", view.confidence)
            elif format == "png":
                write_depth_png(folder / f"{name}.png", view.depth)
            else:
                atomically(folder / f"{name}.npz", lambda p, v=view: np.savez_compressed(p, depth=v.depth, confidence=v.confidence))
            picture = _core.encode_png(colourise(view.depth))
            atomically(folder / f"{name}_picture.png", lambda p, d=picture: p.write_bytes(d) and None)

    def save_report(self, path: str | Path) -> None:
        """Write the report as JSON."""
        text = json.dumps(self.report, indent=1, default=_plain) + "\n"
        atomically(Path(path), lambda p: p.write_text(text, encoding="utf-8") and None)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise InvalidInputError(f"report: expected plain values, got {type(value).__name__}")
