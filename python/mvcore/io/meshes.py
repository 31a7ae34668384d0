"""Textured meshes as files: GLB, OBJ and PLY, which lose nothing however far the world's origin is.

OBJ and PLY hold the caller's coordinates. GLB stores float32: where that would round vertices by more than a hundredth of a voxel,
they are relative to an offset, which is the translation of their node, repeated in the ``extras`` of the node and of the file.
"""

from __future__ import annotations

import io
import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from .. import _core
from ..errors import FormatError, require
from ..types import Image
from .files import atomically, staged

Float = NDArray[np.float64]

FORMATS = (".glb", ".obj", ".ply")
ROUNDING = 0.01
"""Share of a voxel by which GLB's float32 may round a vertex."""
DIGITS = 9
"""Significant digits of OBJ coordinates, counted from the mesh's size on: 1e-9 of it."""


@dataclass(frozen=True)
class TexturedMesh:
    """vertices (V, 3) float64; faces (F, 3) uint32, counter-clockwise from outside; uv (V, 2) float32, origin bottom-left; texture
    (h, w, 3) uint8; ``voxel`` in world units is the detail that rounding is measured against."""

    vertices: Float
    faces: NDArray[np.uint32]
    uv: NDArray[np.float32]
    texture: Image
    voxel: float

    def vertex_colours(self) -> NDArray[np.uint8]:
        """Texture colour of each vertex, (V, 3) uint8."""
        h, w = self.texture.shape[:2]
        x = np.clip(np.rint(self.uv[:, 0] * w - 0.5).astype(int), 0, w - 1)
        y = np.clip(np.rint((1 - self.uv[:, 1]) * h - 0.5).astype(int), 0, h - 1)
        return self.texture[y, x]


def check_mesh_name(path: str | Path, argument: str = "path") -> Path:
    """A path that names a mesh format.

    Raises
    ------
    InvalidInputError
        Another suffix.
    """
    path = Path(path)
    require(path.suffix.lower() in FORMATS, argument, f"a name ending in {', '.join(FORMATS)}", repr(str(path)))
    return path


def save_mesh(path: str | Path, mesh: TexturedMesh) -> Float | None:
    """Write ``.glb`` (texture inside), ``.obj`` (+ .mtl, .png) or ``.ply`` (vertex colours); complete or not at all.

    Returns
    -------
    (3,) float64 or None
        The offset of a GLB's vertices, where they have one.

    Raises
    ------
    InvalidInputError
        Another suffix.
    """
    path = check_mesh_name(path)
    if path.suffix.lower() == ".obj":
        _save_obj(path, mesh)
        return None
    offset = glb_offset(mesh.vertices, mesh.voxel) if path.suffix.lower() == ".glb" else None
    data = ply_bytes(mesh) if path.suffix.lower() == ".ply" else glb_bytes(mesh, offset)
    atomically(path, lambda p: p.write_bytes(data) and None)
    return offset


def glb_offset(vertices: Float, voxel: float) -> Float | None:
    """What to subtract from vertices so that float32 holds them: None where it does without.

    The offset is the middle of the mesh, rounded so that float32 holds it too: readers that keep matrices in float32 lose nothing of it.
    """
    if not len(vertices):
        return None
    farthest = float(np.abs(vertices).max())
    if float(np.spacing(np.float32(farthest))) / 2 <= ROUNDING * voxel:
        return None
    low, high = vertices.min(0), vertices.max(0)
    return ((low + high) / 2).astype(np.float32).astype(np.float64)


def glb_bytes(mesh: TexturedMesh, offset: Float | None = None) -> bytes:
    """A binary glTF 2.0 file whose vertices are relative to ``offset``, the translation of their node."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    image = PillowImage.fromarray(mesh.texture)
    encoded = _core.encode_png(np.ascontiguousarray(mesh.texture))
    # trimesh has Pillow encode the image, which takes longer than all the rest of the export for a tenth less bytes.
    image.save = lambda file, format: file.write(encoded)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    visual = trimesh.visual.TextureVisuals(uv=mesh.uv, material=material)
    vertices = mesh.vertices if offset is None else mesh.vertices - offset

    def finish(tree: dict[str, Any]) -> None:
        tree.setdefault("extensionsUsed", []).append("KHR_materials_unlit")
        for material in tree.get("materials", []):
            material.setdefault("extensions", {})["KHR_materials_unlit"] = {}
        if offset is not None:
            _moved(tree, offset)

    return export_glb(trimesh.Trimesh(vertices, mesh.faces, visual=visual, process=False).scene(), tree_postprocessor=finish)


def _moved(tree: dict[str, Any], offset: Float) -> None:
    """The nodes of meshes, moved by an offset that ``extras`` repeat."""
    for node in tree["nodes"]:
        if "mesh" in node:
            node["translation"] = offset.tolist()
            node.setdefault("extras", {})["offset"] = offset.tolist()
    tree["asset"].setdefault("extras", {})["offset"] = offset.tolist()


def ply_bytes(mesh: TexturedMesh) -> bytes:
    """A binary PLY file with double coordinates and vertex colours."""
    vertices = np.zeros(len(mesh.vertices), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = mesh.vertices, mesh.vertex_colours() if len(mesh.vertices) else 0
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    head = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"),
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"),
    ]
    return "\n".join(head).encode() + vertices.tobytes() + faces.tobytes()


def _save_obj(path: Path, mesh: TexturedMesh) -> None:
    stem = path.stem
    text = io.StringIO()
    text.write(f"mtllib {stem}.mtl\nusemtl photo\n")
    np.savetxt(text, mesh.vertices, " ".join(["v", *[f"%.{_digits(mesh.vertices)}g"] * 3]))
    np.savetxt(text, mesh.uv, "vt %.7g %.7g")
    number = mesh.faces.astype(np.int64) + 1
    np.savetxt(text, np.repeat(number, 2, axis=1), "f %d/%d %d/%d %d/%d")
    parts = {
        f"{stem}.png": _core.encode_png(np.ascontiguousarray(mesh.texture)),
        f"{stem}.mtl": f"newmtl photo\nKa 1 1 1\nKd 1 1 1\nillum 0\nmap_Kd {stem}.png\n".encode(),
        f"{stem}.obj": text.getvalue().encode(),
    }
    with staged(path) as folder:
        for name, data in parts.items():
            (folder / name).write_bytes(data)
        for name in parts:  # the OBJ last: once it is there, all it names is there
            os.replace(folder / name, path.parent / name)


def _digits(vertices: Float) -> int:
    """Significant digits that hold coordinates to 1e-9 of the mesh's size; float64 has no more than 17."""
    if not len(vertices):
        return DIGITS
    size = float(np.ptp(vertices, axis=0).max()) or float(np.abs(vertices).max()) or 1.0
    return min(17, DIGITS + max(0, int(np.ceil(np.log10(np.abs(vertices).max() / size + 1e-300)))))


def _quaternion(rotation: Float) -> Float:
    """(x, y, z, w) of a rotation matrix."""
    vector = cv2.Rodrigues(np.ascontiguousarray(rotation))[0].ravel()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.zeros(3)
    return np.append(axis * np.sin(angle / 2), np.cos(angle / 2))


def _glb_parts(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON tree and the binary body, padded to four bytes."""
    if len(glb) < 20 or struct.unpack_from("<4sI", glb) != (b"glTF", 2):
        raise FormatError("glb: expected a binary glTF 2.0 file")
    (size,) = struct.unpack_from("<I", glb, 12)
    body = glb[20 + size + 8 :]
    return json.loads(glb[20 : 20 + size]), body + b"\0" * (-len(body) % 4)


def animated(glb: bytes, times: Float, poses: Float) -> bytes:
    """A GLB whose scene moves along ``poses`` (T, 4, 4), in the world, at ``times`` (T,) seconds, as a glTF 2.0 animation.

    A mesh with an offset turns about it: below one still node that carries the offset, motions are small numbers.

    Raises
    ------
    FormatError
        Not a binary glTF file.
    """
    tree, body = _glb_parts(glb)
    offset = np.array(tree.get("asset", {}).get("extras", {}).get("offset", [0.0, 0.0, 0.0]), np.float64)
    turns = np.stack([_quaternion(p[:3, :3]) for p in poses])
    for k in range(1, len(turns)):  # the short way round
        if turns[k] @ turns[k - 1] < 0:
            turns[k] = -turns[k]
    shifts = poses[:, :3, 3] + poses[:, :3, :3] @ offset - offset
    accessors = []
    for values, kind in ((times - times[0], "SCALAR"), (shifts, "VEC3"), (turns, "VEC4")):
        data = np.ascontiguousarray(values, "<f4")
        tree.setdefault("bufferViews", []).append({"buffer": 0, "byteOffset": len(body), "byteLength": data.nbytes})
        accessor = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5126, "count": len(data), "type": kind}
        if kind == "SCALAR":  # the standard asks for the range of times
            accessor |= {"min": [float(data.min())], "max": [float(data.max())]}
        tree.setdefault("accessors", []).append(accessor)
        accessors.append(len(tree["accessors"]) - 1)
        body += data.tobytes()
    node = _moving_node(tree, offset)
    samplers = [{"input": accessors[0], "output": a, "interpolation": "LINEAR"} for a in accessors[1:]]
    channels = [{"sampler": n, "target": {"node": node, "path": path}} for n, path in enumerate(("translation", "rotation"))]
    tree["animations"] = [{"name": "trajectory", "samplers": samplers, "channels": channels}]
    tree["buffers"][0]["byteLength"] = len(body)
    return _glb(tree, body)


def _moving_node(tree: dict[str, Any], offset: Float) -> int:
    """A node around all that the scene shows, below the offset if there is one; returns its number."""
    scene = tree["scenes"][tree.get("scene", 0)]
    tree["nodes"].append({"name": "target", "children": scene["nodes"]})
    node = len(tree["nodes"]) - 1
    scene["nodes"] = [node]
    if offset.any():
        for part in tree["nodes"]:
            if "offset" in part.get("extras", {}):
                del part["translation"], part["extras"]
        tree["nodes"].append({"name": "offset", "children": [node], "translation": offset.tolist(), "extras": {"offset": offset.tolist()}})
        scene["nodes"] = [node + 1]
    return node


def _glb(tree: dict[str, Any], body: bytes) -> bytes:
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
