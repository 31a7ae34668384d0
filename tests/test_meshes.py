"""Mesh files: coordinates of any size survive, in all formats."""

import json
import struct

import numpy as np
import pytest
import trimesh
from mvcore import InvalidInputError
from mvcore.io.meshes import TexturedMesh, animated, glb_offset, save_mesh

UTM = np.array([512_345.678, 5_412_345.678, 431.5])
ECEF = np.array([4_177_123.4, 855_123.4, 4_727_123.4])
PLANET = np.array([1e7, -1e7, 1e7])


def mesh_at(offset, size=1.0) -> TexturedMesh:
    """A sphere of a thousand edges a side or so, with a texture."""
    ball = trimesh.creation.icosphere(3)
    rng = np.random.default_rng(0)
    uv = rng.uniform(size=(len(ball.vertices), 2)).astype(np.float32)
    texture = rng.integers(0, 255, (16, 16, 3), np.uint8)
    return TexturedMesh(ball.vertices * size + offset, np.asarray(ball.faces, np.uint32), uv, texture, 0.002 * size)


def read(path):
    loaded = trimesh.load(path, force="mesh", process=False)
    return np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
@pytest.mark.parametrize("offset", [np.zeros(3), UTM, ECEF, PLANET])
@pytest.mark.parametrize("size", [1.0, 300.0])
def test_meshes_come_back_as_they_were(tmp_path, suffix, offset, size):
    mesh = mesh_at(offset, size)
    save_mesh(tmp_path / f"a{suffix}", mesh)
    vertices, faces = read(tmp_path / f"a{suffix}")
    order = np.arange(len(vertices))
    if suffix == ".obj":  # trimesh splits vertices by texture coordinates
        order = np.array([int(np.linalg.norm(mesh.vertices - v, axis=1).argmin()) for v in vertices])
    assert np.abs(vertices - mesh.vertices[order]).max() <= 1e-6 * size
    assert np.array_equal(order[faces], mesh.faces)


def glb_tree(path):
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size])


def test_only_where_float32_would_round_is_there_an_offset(tmp_path):
    assert save_mesh(tmp_path / "near.glb", mesh_at([3.0, 2.0, 1.0])) is None
    assert "extras" not in glb_tree(tmp_path / "near.glb")["asset"]
    offset = save_mesh(tmp_path / "far.glb", mesh_at(UTM))
    tree = glb_tree(tmp_path / "far.glb")
    assert np.abs(offset - UTM).max() < 1
    assert np.array_equal(offset, offset.astype(np.float32))
    (node,) = [n for n in tree["nodes"] if "mesh" in n]
    assert node["translation"] == node["extras"]["offset"] == tree["asset"]["extras"]["offset"] == offset.tolist()
    assert "matrix" not in node
    position = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert np.abs([position["min"], position["max"]]).max() < 2
    # The rule: half the spacing of float32 at the farthest coordinate against a hundredth of a voxel.
    vertices = np.array([[2.0**20 + 1, 0, 0]])
    spacing = 2.0**-3
    assert glb_offset(vertices, spacing / 2 * 101) is None
    assert glb_offset(vertices, spacing / 2 * 99) is not None
    assert glb_offset(np.zeros((0, 3)), 1.0) is None


def test_an_empty_mesh_is_a_file(tmp_path):
    empty = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32), np.zeros((0, 2), np.float32), np.zeros((4, 4, 3), np.uint8), 1.0)
    for suffix in (".obj", ".ply"):
        save_mesh(tmp_path / f"a{suffix}", empty)
        assert (tmp_path / f"a{suffix}").stat().st_size > 0
    with pytest.raises(InvalidInputError, match=r"path: expected a name ending in \.glb, \.obj, \.ply, got"):
        save_mesh(tmp_path / "a.stl", empty)


def test_ply_has_colours_and_doubles(tmp_path):
    mesh = mesh_at(UTM)
    save_mesh(tmp_path / "a.ply", mesh)
    assert b"property double x" in (tmp_path / "a.ply").read_bytes()[:300]
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.array_equal(loaded.visual.vertex_colors[:, :3], mesh.vertex_colours())
    assert np.array_equal(np.asarray(loaded.vertices, np.float64), mesh.vertices)


@pytest.mark.parametrize("offset", [np.zeros(3), UTM])
def test_animated_meshes_move_about_their_own_place(tmp_path, offset):
    """Node by node as a viewer composes it: the mesh at the second pose is the mesh moved in the world."""
    mesh = mesh_at(offset)
    save_mesh(tmp_path / "a.glb", mesh)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], offset + 0.3)
    turn[:3, 3] += [0.5, 0.25, -1.0]
    data = animated((tmp_path / "a.glb").read_bytes(), np.array([0.0, 1.0]), np.stack([np.eye(4), turn]))
    (tmp_path / "m.glb").write_bytes(data)
    tree = glb_tree(tmp_path / "m.glb")
    (size,) = struct.unpack_from("<I", data, 12)
    body = data[28 + size :]

    def values(n, width):
        view = tree["bufferViews"][tree["accessors"][n]["bufferView"]]
        return np.frombuffer(body, "<f4", 2 * width, view["byteOffset"]).reshape(2, width).astype(float)

    shift, rotation = (s["output"] for s in tree["animations"][0]["samplers"])
    x, y, z, w = values(rotation, 4)[1]
    matrix = trimesh.transformations.quaternion_matrix([w, x, y, z])
    matrix[:3, 3] = values(shift, 3)[1]
    node = tree["animations"][0]["channels"][0]["target"]["node"]
    (above,) = [n for n in tree["nodes"] if node in n.get("children", [])] or [{}]
    outer = np.array(above.get("translation", [0, 0, 0]), float)
    inner = np.array(next(n for n in tree["nodes"] if "mesh" in n).get("translation", [0, 0, 0]), float)
    local = mesh.vertices - outer - inner
    moved = local @ matrix[:3, :3].T + matrix[:3, 3] + outer
    assert np.abs(moved - trimesh.transform_points(mesh.vertices, turn)).max() < 1e-6
