"""One self-contained HTML page of a reconstructed clip: the mesh under a time slider, the depth maps, the report."""

from __future__ import annotations

import base64
import json
import math
import zipfile
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ..errors import FormatError, ReconstructionError
from ..io.files import atomically
from ..io.limits import MOST_ARRAYS, inside, read_bytes
from ..io.mesh_files import load_mesh
from ..mesh.surface import Surface, decimate
from ..video.writer import INDEX, read_index

MOST_FACES = 60_000
"""Of a mesh in the page."""
PAGE_FACES = 2_000_000
"""Of all meshes in the page."""
UNTEXTURED = 160
"""Grey level of a mesh without a texture."""


def write_page(folder: str | Path, page: str | Path | None = None) -> Path:
    """Write the page of a folder that `mvcore video` filled; by default ``view.html`` in it.

    Meshes are decimated for the page and coloured by vertex; the GLB files beside it stay as they are.

    Raises
    ------
    FileNotFoundError, FormatError
        The folder has no index or a malformed one, a file of it is missing, or a name in it leads out of the folder.
    """
    folder = Path(folder)
    index = _checked(folder / INDEX, read_index(folder))
    page = Path(page) if page is not None else folder / "view.html"
    count = max(1, sum(len(i["files"]) for i in index["instants"]))
    limit = max(2_000, min(MOST_FACES, PAGE_FACES // count))
    instants = []
    for instant in index["instants"]:
        pictures = {name: _inline(_named(folder, path), "image/jpeg") for name, path in instant["depth"].items()}
        meshes = [_reduced(_named(folder, name), limit) for name in instant["files"]]
        instants.append(
            {"number": instant["instant"], "time": instant["time"], "meshes": meshes, "depth": pictures, "report": instant["report"]}
        )
    data: dict[str, Any] = {"instants": instants, "warnings": index["warnings"]}
    if "rigid" in index:
        data["model"] = _reduced(_named(folder, index["rigid"]["model"]), MOST_FACES)
        data["poses"] = index["rigid"]["poses"]
    # No text in the data may end the script that holds it, or open a comment in it.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    template = Template(files("mvcore.viewer").joinpath("page.html").read_text(encoding="utf-8"))
    html = template.substitute(library=_library(), data=text, title=escape(folder.resolve().name))
    atomically(page, lambda p: p.write_text(html, encoding="utf-8") and None)
    return page


def _checked(path: Path, index: dict[str, Any]) -> dict[str, Any]:
    """The index, if what the page takes of it has the right types."""

    def need(holds: bool, what: str) -> None:
        if not holds:
            raise FormatError(f"{path}: expected {what}")

    need(_texts(index.get("warnings")), "a list 'warnings' of texts")
    instants = index.get("instants")
    need(isinstance(instants, list) and bool(instants), "a list 'instants' of one or more")
    for n, instant in enumerate(instants or []):
        need(isinstance(instant, dict), f"an object instants[{n}]")
        report, depth = instant.get("report"), instant.get("depth")
        need(_number(instant.get("instant")), f"a number instants[{n}].instant")
        need(instant.get("time") is None or _number(instant["time"]), f"a number instants[{n}].time")
        instant.setdefault("time", None)
        need(_texts(instant.get("files")), f"a list instants[{n}].files of names")
        need(isinstance(depth, dict) and _texts(list(depth.values())), f"an object instants[{n}].depth of names")
        need(isinstance(report, dict) and _texts(report.get("warnings", [])), f"an object instants[{n}].report with texts 'warnings'")
        mesh = report.get("mesh", {"faces": 0})
        need(isinstance(mesh, dict) and _number(mesh.get("faces")), f"a number instants[{n}].report.mesh.faces")
    if (rigid := index.get("rigid")) is not None:
        need(isinstance(rigid, dict) and isinstance(rigid.get("model"), str), "a name 'rigid.model'")
        poses = rigid.get("poses")
        need(isinstance(poses, list) and all(p is None or _pose(p) for p in poses), "a list 'rigid.poses' of 4 x 4 numbers or null")
    else:
        index.pop("rigid", None)
    return index


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def _pose(value: Any) -> bool:
    rows = value if isinstance(value, list) else []
    return len(rows) == 4 and all(isinstance(r, list) and len(r) == 4 and all(map(_number, r)) for r in rows)


def _named(folder: Path, name: str) -> Path:
    """A file that the index names: one within the folder, or an error."""
    path = inside(folder, name, folder / INDEX)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: named in the index, but missing")
    return path


def _inline(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(read_bytes(path, MOST_ARRAYS)).decode()}"


def _reduced(path: Path, limit: int) -> dict[str, Any]:
    """A GLB's mesh with at most about ``limit`` faces: base64 of its float32 positions, uint32 faces and uint8 colours."""
    import trimesh

    mesh = load_mesh(path)
    colours = _colours(mesh)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.uint32)
    if len(faces) > limit:
        # Charts share no vertices: joined, or the decimation would tear the mesh along every seam.
        merged = trimesh.Trimesh(vertices, faces, process=False)
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        small = decimate(Surface(np.asarray(merged.vertices, np.float64), np.asarray(merged.faces, np.uint32)), max_faces=limit)
        from .. import _core

        _, number = _core.nearest(np.ascontiguousarray(small.vertices), np.ascontiguousarray(vertices))
        vertices, faces, colours = small.vertices, small.faces, colours[number]

    def packed(array: Any, kind: str) -> str:
        return base64.b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()

    return {"vertices": packed(vertices, "<f4"), "faces": packed(faces, "<u4"), "colours": packed(colours[:, :3], "u1")}


def _colours(mesh: Any) -> Any:
    """(V, 3) uint8 from the texture at each vertex."""
    uv = getattr(mesh.visual, "uv", None)
    texture = getattr(getattr(mesh.visual, "material", None), "baseColorTexture", None)
    if uv is None or texture is None or not np.isfinite(uv).all():
        return np.full((len(mesh.vertices), 3), UNTEXTURED, np.uint8)
    image = np.asarray(texture.convert("RGB"))
    h, w = image.shape[:2]
    x = np.clip(np.rint(uv[:, 0] * w - 0.5).astype(int), 0, w - 1)
    y = np.clip(np.rint((1 - uv[:, 1]) * h - 0.5).astype(int), 0, h - 1)
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
