"""One self-contained HTML page of a reconstructed clip: the mesh under a time slider, the depth maps, the report."""

from __future__ import annotations

import base64
import json
import zipfile
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..errors import ReconstructionError
from ..io.files import atomically
from ..mesh.surface import Surface, decimate
from ..video.writer import read_index

MOST_FACES = 60_000
"""Of a mesh in the page."""
PAGE_FACES = 2_000_000
"""Of all meshes in the page."""


def write_page(folder: str | Path, page: str | Path | None = None) -> Path:
    """Write the page of a folder that `mvcore video` filled; by default ``view.html`` in it.

    Meshes are decimated for the page and coloured by vertex; the GLB files beside it stay as they are.

    Raises
    ------
    FileNotFoundError, FormatError
        The folder has no index, or a file of it is missing.
    """
    folder = Path(folder)
    index = read_index(folder)
    page = Path(page) if page is not None else folder / "view.html"
    count = max(1, sum(len(i["files"]) for i in index["instants"]))
    limit = max(2_000, min(MOST_FACES, PAGE_FACES // count))
    instants = []
    for instant in index["instants"]:
        pictures = {name: _inline(folder / path, "image/jpeg") for name, path in instant["depth"].items()}
        meshes = [_reduced(folder / name, limit) for name in instant["files"]]
        instants.append(
            {"number": instant["instant"], "time": instant["time"], "meshes": meshes, "depth": pictures, "report": instant["report"]}
        )
    data: dict[str, Any] = {"instants": instants, "warnings": index["warnings"]}
    if "rigid" in index:
        data["model"] = _reduced(folder / index["rigid"]["model"], MOST_FACES)
        data["poses"] = index["rigid"]["poses"]
    # "</" must not end the script that holds the data.
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    template = Template(files("mvcore").joinpath("viewer/page.html").read_text(encoding="utf-8"))
    html = template.substitute(library=_library(), data=text, title=folder.resolve().name)
    atomically(page, lambda p: p.write_text(html, encoding="utf-8") and None)
    return page


def _inline(path: Path, kind: str) -> str:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: named in the index, but missing")
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _reduced(path: Path, limit: int) -> dict[str, Any]:
    """A GLB's mesh with at most about ``limit`` faces: base64 of its float32 positions, uint32 faces and uint8 colours."""
    import trimesh

    if not path.is_file():
        raise FileNotFoundError(f"{path}: named in the index, but missing")
    mesh = trimesh.load(path, process=False, force="mesh")
    colours = _colours(mesh)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.uint32)
    if len(faces) > limit:
        # Charts share no vertices: joined, or the decimation would tear the mesh along every seam.
        merged = trimesh.Trimesh(vertices, faces, process=False)
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        small = decimate(Surface(np.asarray(merged.vertices, np.float64), np.asarray(merged.faces, np.uint32)), limit)
        from .. import _core

        _, number = _core.nearest(np.ascontiguousarray(small.vertices), np.ascontiguousarray(vertices))
        vertices, faces, colours = small.vertices, small.faces, colours[number]

    def packed(array: Any, kind: str) -> str:
        return base64.b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()

    return {"vertices": packed(vertices, "<f4"), "faces": packed(faces, "<u4"), "colours": packed(colours[:, :3], "u1")}


def _colours(mesh: Any) -> Any:
    """(V, 3) uint8 from the texture at each vertex."""
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    h, w = image.shape[:2]
    x = np.clip(np.rint(mesh.visual.uv[:, 0] * w - 0.5).astype(int), 0, w - 1)
    y = np.clip(np.rint((1 - mesh.visual.uv[:, 1]) * h - 0.5).astype(int), 0, h - 1)
    return image[y, x]


def _library() -> str:
    """three.js with its controls, from the viewer that trimesh bundles."""
    with files("trimesh").joinpath("resources/templates/viewer.zip").open("rb") as file, zipfile.ZipFile(file) as archive:
        text = archive.read("viewer.html.template").decode("utf-8")
    start, end = text.find("<script>"), text.find("var camera,controls,scene")
    if start < 0 or end < start:
        raise ReconstructionError(
            "the installed trimesh has no three.js viewer that can be taken over: expected trimesh 4.2 or a later 4.x"
        )
    return text[start + len("<script>") : end]
