"""Valid small inputs of every format, built by the formats' own writers or by hand."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import mvcore
import numpy as np
import OpenEXR
import other_tools
import trimesh
from conftest import rig, write_scene
from mvcore.io.formats.colmap import rotation_to_quaternion
from mvcore.io.formats.write import save_calibration
from mvcore.io.maps import write_pfm
from mvcore.nurbs.obj import save_obj
from mvcore.pipeline.store import Store
from PIL import Image

COUNT = 3
KEY = "ab" * 20
"""Of an entry of the store."""
IMAGES = ("png", "jpg", "bmp", "tif", "webp", "deep png", "deep tif", "exr", "ppm")
VIDEOS = ("mp4", "mkv", "avi", "mts")


def scenes(folder: Path) -> dict[str, Path]:
    """A folder a camera format."""
    cameras = rig(COUNT, (32, 24))
    images = [np.full((24, 32, 3), 40 * n, np.uint8) for n in range(COUNT)]
    out = {"native": write_scene(folder / "native", cameras, images)}
    scene = mvcore.load(out["native"])
    for name, build in BUILDERS.items():
        (folder / name / "images").mkdir(parents=True)
        for n, image in enumerate(images):
            cv2.imwrite(str(folder / name / f"{n}.png"), image)
            cv2.imwrite(str(folder / name / "images" / f"{n:03d}.png"), image)
        build(folder / name, scene)
        out[name] = folder / name
    return out | _scenes_of_tools(folder)


def _tools() -> dict[str, Callable[[Path], object]]:
    """What writes a data set of each of the tools in `other_tools`."""
    poses = other_tools.views()
    writers = {name: lambda at, write=write: write(at, poses) for name, write in other_tools.WRITERS.items()}
    writers |= {f"ROS {model}": lambda at, model=model: other_tools.write_ros(at, model) for model in other_tools.ROS_LENSES}
    writers |= {"KITTI": other_tools.write_kitti, "Middlebury stereo": other_tools.write_middlebury_stereo}
    motion = lambda r, t: {"R": r, "T": t.tolist()}  # noqa: E731
    names = (("M1", "D1", "M2", "D2"), ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"))
    for storages, keys in ((["intrinsics.yml", "extrinsics.yml"], names[0]), (["stereo.xml"], names[1]), (["stereo.json"], names[0])):
        writers[f"stereo {storages[0]}"] = lambda at, files=storages, keys=keys: _stereo_pair(at, poses, files, keys, motion)
    return writers


TOOLS = _tools()


def _scenes_of_tools(folder: Path) -> dict[str, Path]:
    out = {}
    for name, write in TOOLS.items():
        (folder / name).mkdir()
        write(folder / name)
        out[name] = folder / name / "office0" if name == "Replica" else folder / name
    return out


def _stereo_pair(folder: Path, poses, files, keys, motion) -> None:
    other_tools.storage_pair(folder, poses, files, keys, motion)
    other_tools.pictures(folder, ["left.png", "right.png"])


def _colmap_text(folder: Path, scene) -> None:
    save_calibration(folder / "sparse", scene, "colmap")
    (folder / "sparse" / "points3D.txt").write_text("1 0.1 0.2 0.3 9 9 9 0.5 1 0 2 1\n")


def _colmap_binary(folder: Path, scene) -> None:
    cameras, images = struct.pack("<Q", len(scene.calib)), struct.pack("<Q", len(scene.calib))
    for n, c in enumerate(scene.calib):
        cameras += struct.pack("<IiQQ5d", n, 2, c.width, c.height, c.K[0, 0], c.K[0, 2], c.K[1, 2], 0.1, 0.0)[:-8]
        images += struct.pack("<I7dI", n, *rotation_to_quaternion(c.R), *c.t, n) + f"{n}.png".encode() + b"\0"
        images += struct.pack("<Q", 1) + struct.pack("<ddQ", 1.5, 2.5, 1)
    point = struct.pack("<QQ3d3Bd", 1, 1, 0.1, 0.2, 0.3, 9, 9, 9, 0.5) + struct.pack("<QII", 1, 0, 0)
    for name, data in (("cameras", cameras), ("images", images), ("points3D", point)):
        (folder / f"{name}.bin").write_bytes(data)


def _mvsnet(folder: Path, scene) -> None:
    save_calibration(folder / "out", scene, "mvsnet")
    for part in (folder / "out").iterdir():
        part.rename(folder / part.name)
    for n in range(COUNT):
        (folder / "images" / f"{n:03d}.png").rename(folder / "images" / f"{n:08d}.png")


def _nerf(folder: Path, scene) -> None:
    frames = []
    for n, c in enumerate(scene.calib):
        pose = np.linalg.inv(np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{n}.png", "transform_matrix": pose.tolist()})
    c = scene.calib[0]
    lens = {"fl_x": c.K[0, 0], "fl_y": c.K[1, 1], "cx": c.K[0, 2], "cy": c.K[1, 2], "w": 32, "h": 24, "k1": 0.1, "p1": 0.0}
    (folder / "transforms.json").write_text(json.dumps(lens | {"aabb_scale": 1, "frames": frames}))


def _idr(folder: Path, scene) -> None:
    matrices = {f"world_mat_{n}": np.vstack([c.projection, [0, 0, 0, 1]]) for n, c in enumerate(scene.calib)}
    np.savez_compressed(folder / "cameras_sphere.npz", **matrices, scale_mat_0=np.eye(4))


def _middlebury(folder: Path, scene) -> None:
    rows = [f"{n}.png " + " ".join(f"{v:.9g}" for v in [*c.K.ravel(), *c.R.ravel(), *c.t]) for n, c in enumerate(scene.calib)]
    (folder / "x_par.txt").write_text("\n".join([str(len(rows)), *rows, ""]))
    (folder / "README.txt").write_text("box\n(-1 -2 -3)\n(1.5 2 3e-1)\n")


def _strecha(folder: Path, scene) -> None:
    for n, c in enumerate(scene.calib):
        text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in [*c.K, [0, 0, 0], *c.R.T, c.center])
        (folder / f"{n}.png.camera").write_text(f"{text}\n{c.width} {c.height}\n")


def _qualisys(folder: Path, scene) -> None:
    parts = []
    names = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    for n, c in enumerate(scene.calib):
        r = np.diag([1.0, -1, -1]) @ c.R
        turn = " ".join(f'r{i + 1}{j + 1}="{r[i, j]:.9g}"' for i in range(3) for j in range(3))
        place = " ".join(f'{a}="{v:.9g}"' for a, v in zip("xyz", c.center))
        k = [f'{name}="{v * 64:.9g}"' for name, v in zip(names, c.K[[0, 1, 0, 1], [0, 1, 2, 2]])]
        view = f'<fov_video left="0" top="0" right="{c.width - 1}" bottom="{c.height - 1}"/>'
        parts.append(f'<camera serial="{n}">{view}<transform {turn} {place}/><intrinsic {" ".join(k)} radialDistortion1="0.1"/></camera>')
    (folder / "a.qca.txt").write_text("<?xml version='1.0'?>\n<calibration><cameras>" + "\n".join(parts) + "</cameras></calibration>")


def _storage(path: Path, values: dict) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        if isinstance(value, list):
            file.startWriteStruct(key, cv2.FileNode_SEQ)
            for item in value:
                file.write("", item)
            file.endWriteStruct()
        else:
            file.write(key, value)
    file.release()


def _easymocap(folder: Path, scene) -> None:
    inside: dict = {"names": [str(n) for n in range(len(scene.calib))]}
    outside: dict = {}
    for n, c in enumerate(scene.calib):
        inside |= {f"K_{n}": c.K, f"dist_{n}": np.array([[0.1, 0, 0, 0, 0]]), f"H_{n}": c.height, f"W_{n}": c.width}
        outside |= {f"R_{n}": cv2.Rodrigues(c.R)[0], f"Rot_{n}": c.R, f"T_{n}": c.t.reshape(3, 1)}
    _storage(folder / "intri.yml", inside)
    _storage(folder / "extri.yml", outside)


def _kalibr(folder: Path, scene) -> None:
    text, before = "", np.eye(4)
    for n, c in enumerate(scene.calib):
        pose = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])
        rows = (pose @ np.linalg.inv(before)).tolist()
        text += f"cam{n}:\n  camera_model: pinhole\n  distortion_model: equidistant\n  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n"
        text += f"  intrinsics: {[*map(float, c.K[[0, 1, 0, 1], [0, 1, 2, 2]])]}\n  resolution: [{c.width}, {c.height}]\n"
        text += "  T_cn_cnm1:\n" + "".join(f"  - {row}\n" for row in rows) if n else ""
        before = pose
        (folder / f"{n}.png").rename(folder / f"cam{n}.png")
    (folder / "camchain.yaml").write_text(text)


def _opencv(folder: Path, scene) -> None:
    for n, (c, kind) in enumerate(zip(scene.calib, ("yml", "xml", "yml"))):
        values = {
            "camera_matrix": c.K,
            "distortion_coefficients": np.zeros((1, 5)),
            "rvec": cv2.Rodrigues(c.R)[0],
            "tvec": c.t.reshape(3, 1),
        }
        _storage(folder / f"{n}.{kind}", values | {"image_width": c.width, "image_height": c.height, "image": f"{n}.png"})


def _stereo(folder: Path, scene) -> None:
    one = {"M1": scene.calib[0].K, "D1": np.zeros((1, 5)), "M2": scene.calib[1].K, "D2": np.zeros((1, 5))}
    pose = {"R": scene.calib[1].R, "T": scene.calib[1].t.reshape(3, 1), "image_width": 32, "image_height": 24}
    _storage(folder / "stereo.yml", one | pose)
    for n, name in enumerate(("left", "right")):
        (folder / f"{n}.png").rename(folder / f"{name}.png")


def _pictures(folder: Path, out: dict[str, Path]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    for suffix in ("png", "jpg", "bmp", "tif", "webp", "ppm"):
        out[suffix] = folder / f"image.{suffix}"
        cv2.imwrite(str(out[suffix]), image)
    for suffix in ("png", "tif"):
        out[f"deep {suffix}"] = folder / suffix / f"deep.{suffix}"
        out[f"deep {suffix}"].parent.mkdir()
        cv2.imwrite(str(out[f"deep {suffix}"]), image.astype(np.uint16) * 16)
    out["exr"] = folder / "image.exr"
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": image.astype(np.float32)}) as file:
        file.write(str(out["exr"]))


def _video(path: Path, codec: str) -> None:
    with av.open(str(path), "w", format="mpegts" if path.suffix == ".mts" else None) as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for n in range(6):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 40 * n, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def files(folder: Path) -> dict[str, Path]:
    """A file a reader that takes one."""
    folder.mkdir()
    out = {}
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(np.zeros((len(box.vertices), 2)), image=Image.new("RGB", (4, 4)))
    for suffix in ("glb", "ply", "stl", "off", "obj"):
        out[suffix] = folder / f"mesh.{suffix}"
        trimesh.creation.box().export(out[suffix]) if suffix != "glb" else box.export(out[suffix])
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    out["binary ply"] = folder / "binary.ply"
    out["binary ply"].write_bytes(trimesh.creation.box().export(file_type="ply"))
    out["ply"].write_bytes(trimesh.creation.box().export(file_type="ply", encoding="ascii"))
    _pictures(folder, out)
    for suffix in VIDEOS:
        out[suffix] = folder / f"clip.{suffix}"
        _video(out[suffix], "mpeg2video" if suffix == "mts" else "mpeg4")
    out["settings"] = folder / "settings.toml"
    out["settings"].write_text('device = "cpu"\n[depth]\nsources = 4\nmax_angle = 40.5\n[volume]\nmax_memory = 100000000\n')
    out["pfm"] = folder / "map.pfm"
    write_pfm(out["pfm"], image[..., 0].astype(np.float32))
    out["nurbs"] = folder / "nurbs.obj"
    knots = np.array([0, 0, 0, 0, 1, 1, 1, 1.0])
    net = np.random.default_rng(1).random((4, 4, 3))
    save_obj(out["nurbs"], [mvcore.nurbs.Surface(net, knots, knots, np.ones((4, 4))), mvcore.nurbs.Curve(net[0], knots)])
    store = Store(folder / "store")
    store.save(KEY, {"a": np.arange(6.0), "b": np.zeros((2, 2), np.uint8)}, {"x": 1})
    out["store"] = store.path(KEY)
    out["index"] = folder / "clip" / "index.json"
    out["index"].parent.mkdir()
    box.export(folder / "clip" / "a.glb")
    cv2.imwrite(str(folder / "clip" / "a.jpg"), image)
    report = {"mesh": {"faces": 12}, "warnings": ["w"]}
    instant = {"instant": 0, "time": 0.5, "files": ["a.glb"], "depth": {"cam": "a.jpg"}, "report": report}
    rigid = {"model": "a.glb", "poses": [np.eye(4).tolist(), None]}
    index = {"format": "mvcore sequence", "version": 1, "warnings": ["v"], "instants": [instant], "rigid": rigid}
    out["index"].write_text(json.dumps(index))
    return out


BUILDERS = {
    "colmap_text": _colmap_text,
    "colmap_binary": _colmap_binary,
    "mvsnet": _mvsnet,
    "nerf": _nerf,
    "idr": _idr,
    "middlebury": _middlebury,
    "strecha": _strecha,
    "qualisys": _qualisys,
    "easymocap": _easymocap,
    "kalibr": _kalibr,
    "opencv": _opencv,
    "stereo": _stereo,
}
"""The formats that came first, but for our own."""
