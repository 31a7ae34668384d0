"""What a reconstruction gives back, and how it is saved."""

from __future__ import annotations

import io
import json
import os
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
from ..io.files import atomically, staged
from ..io.maps import colourise, write_depth_png, write_pfm
from ..types import Bounds, DepthMap, Image, SparsePoints

if TYPE_CHECKING:
    import trimesh

FORMATS = (".glb", ".obj", ".ply")


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

    def save(self, path: str | Path) -> None:
        """Write ``.glb`` (texture inside), ``.obj`` (+ .mtl, .png) or ``.ply`` (vertex colours); complete or not at all.

        Raises
        ------
        InvalidInputError
            Another suffix.
        """
        path = Path(path)
        require(path.suffix.lower() in FORMATS, "path", f"a name ending in {', '.join(FORMATS)}", repr(str(path)))
        if path.suffix.lower() == ".obj":
            self._save_obj(path)
        else:
            data = self._glb() if path.suffix.lower() == ".glb" else self._ply()
            atomically(path, lambda p: p.write_bytes(data) and None)

    def _glb(self) -> bytes:
        from trimesh.exchange.gltf import export_glb

        def unlit(tree: dict[str, Any]) -> None:
            tree.setdefault("extensionsUsed", []).append("KHR_materials_unlit")
            for material in tree.get("materials", []):
                material.setdefault("extensions", {})["KHR_materials_unlit"] = {}

        mesh = self.mesh
        encoded = _core.encode_png(np.ascontiguousarray(self.texture))
        # trimesh has Pillow encode the image, which takes longer than all the rest of the export for a tenth less bytes.
        mesh.visual.material.baseColorTexture.save = lambda file, format: file.write(encoded)
        return export_glb(mesh.scene(), tree_postprocessor=unlit)

    def vertex_colours(self) -> NDArray[np.uint8]:
        """Texture colour of each vertex, (V, 3) uint8."""
        h, w = self.texture.shape[:2]
        x = np.clip(np.rint(self.uv[:, 0] * w - 0.5).astype(int), 0, w - 1)
        y = np.clip(np.rint((1 - self.uv[:, 1]) * h - 0.5).astype(int), 0, h - 1)
        return self.texture[y, x]

    def _ply(self) -> bytes:
        import trimesh

        mesh = trimesh.Trimesh(self.vertices, self.faces, vertex_colors=self.vertex_colours(), process=False)
        return mesh.export(file_type="ply")

    def _save_obj(self, path: Path) -> None:
        stem = path.stem
        text = io.StringIO()
        text.write(f"mtllib {stem}.mtl\nusemtl photo\n")
        np.savetxt(text, self.vertices, "v %.9g %.9g %.9g")
        np.savetxt(text, self.uv, "vt %.7g %.7g")
        number = self.faces.astype(np.int64) + 1
        np.savetxt(text, np.repeat(number, 2, axis=1), "f %d/%d %d/%d %d/%d")
        parts = {
            f"{stem}.png": _core.encode_png(np.ascontiguousarray(self.texture)),
            f"{stem}.mtl": f"newmtl photo\nKa 1 1 1\nKd 1 1 1\nillum 0\nmap_Kd {stem}.png\n".encode(),
            f"{stem}.obj": text.getvalue().encode(),
        }
        with staged(path) as folder:
            for name, data in parts.items():
                (folder / name).write_bytes(data)
            for name in parts:  # the OBJ last: once it is there, all it names is there
                os.replace(folder / name, path.parent / name)

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
