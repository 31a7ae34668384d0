"""Files of other tools, written here from their formats' equations: their own projection and that of the cameras read agree."""

import json
import random
import shutil

import cv2
import mvcore
import numpy as np
import pytest
from conftest import look_at
from mvcore import FormatError, InvalidInputError, MvcoreError
from mvcore.io.formats import lens

SIZE = (64, 48)
F = 60.0
MIDDLE = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
POINTS = np.random.default_rng(5).uniform(-0.45, 0.45, (40, 3))
OPENGL = np.diag([1.0, -1, -1])
EXACT = 1e-6  # pixels, the tolerance


@pytest.fixture
def rig():
    """Rotation world to camera and centre of four cameras."""
    return [(c.R, c.center) for c in (look_at((2 * np.cos(a), 2 * np.sin(a), 0.4), (0, 0, 0), SIZE, F) for a in (0.0, 0.5, 1.1, 1.8))]


def pictures(folder, names, size=SIZE):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.zeros((size[1], size[0], 3), np.uint8))


def normal(r, c):
    """x / z and y / z of the points, in OpenCV's axes."""
    q = (POINTS - c) @ r.T
    return q[:, :2] / q[:, 2:]


def brown(p, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0, k4=0.0):
    """Brown's model with OpenCV's p1 and p2."""
    x, y = p.T
    s = x * x + y * y
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3 + k4 * s**4
    return np.column_stack([x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y])


def equidistant(p, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    r = np.linalg.norm(p, axis=1, keepdims=True)
    a = np.arctan(r)
    return p / r * a * (1 + k1 * a**2 + k2 * a**4 + k3 * a**6 + k4 * a**8)


def seen(camera, points):
    """Where a camera sees points, distortion included, by OpenCV."""
    points, r = points.reshape(-1, 1, 3), cv2.Rodrigues(camera.R)[0]
    k = np.array(camera.K)
    k[0, 1] = 0
    if camera.fisheye:
        x = cv2.fisheye.projectPoints(points, r, camera.t, k, camera.distortion)[0]
    else:
        x = cv2.projectPoints(points, r, camera.t, k, camera.distortion if camera.distortion.size else None)[0]
    x = x.reshape(-1, 2)
    return x + np.column_stack([camera.K[0, 1] * (x[:, 1] - k[1, 2]) / k[1, 1], np.zeros(len(x))])


def check(scene, expected, points=POINTS, tolerance=EXACT):
    assert len(scene) == len(expected)
    for camera, pixels in zip(scene.calib, expected):
        assert np.abs(seen(camera, points) - pixels).max() < tolerance


def text_of(values):
    return " ".join(f"{float(v):.17g}" for v in np.ravel(values))


# Each writer makes a folder of its format and returns where the points are in our pixels (centres at integers).


def write_calib_toml(folder, rig):
    lines, out = [], []
    for n, (r, c) in enumerate(rig):
        fisheye = n == 3
        d = [0.1, -0.05, 0.01, 0.002] if fisheye else [-0.2, 0.05, 0.001, -0.002, 0.01][: 4 + n % 2]
        lines.append(f'[cam_{n}]  # a comment\nname = "cam {n}"\nsize = [{SIZE[0]}, {float(SIZE[1])},]\nfisheye = {str(fisheye).lower()}')
        lines.append(f"matrix = [[{F}, 0, 31.0], [0.0, {F + 1}, 23.0], [0, 0, 1]]\ndistortions = {d}")
        lines.append(f"rotation = {cv2.Rodrigues(r)[0].ravel().tolist()}\ntranslation = {(-r @ c).tolist()}\n")
        k1, k2, p1, p2, k3 = (*d, 0.0)[:5]
        x = equidistant(normal(r, c), *d) if fisheye else brown(normal(r, c), k1, k2, k3, p1, p2)
        out.append(x * [F, F + 1] + [31, 23])
    pictures(folder / "images", [f"cam {n}.png" for n in range(len(rig))])
    (folder / "Calib.toml").write_text("\n".join(lines) + '\n[metadata]\nadjusted = false\nunits = "m"\n')
    return out


def write_metashape(folder, rig):
    turn, shift, scale = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0], np.array([5e5, 4e6, 100.0]), 2.5
    cameras, out = [], []
    for n, (r, c) in enumerate(rig):
        pose = np.eye(4)  # camera to chunk, so that the chunk's transform leads to the rig
        pose[:3, :3], pose[:3, 3] = turn.T @ r.T, turn.T @ (c - shift) / scale
        cameras.append(f'<camera id="{n}" sensor_id="{n % 2}" label="my photo {n}"><transform>{text_of(pose)}</transform></camera>')
        x, y = normal(r, c).T
        if n % 2:
            x, y = equidistant(normal(r, c), 0.05, -0.02, 0.01, 0.003).T
        else:
            s, (k1, k2, k3, p1, p2) = x * x + y * y, (-0.15, 0.04, 0.01, 0.002, -0.001)
            radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
            x, y = x * radial + p1 * (s + 2 * x * x) + 2 * p2 * x * y, y * radial + p2 * (s + 2 * y * y) + 2 * p1 * x * y
        f, b1, b2 = F, 1.5, 0.75
        u, v = SIZE[0] * 0.5 + 1.25 + x * f + x * b1 + y * b2, SIZE[1] * 0.5 - 2.5 + y * f
        out.append(np.column_stack([u, v]) - 0.5)
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    common = f"<f>{F}</f><cx>1.25</cx><cy>-2.5</cy><b1>1.5</b1><b2>0.75</b2>"
    frame = f"{common}<k1>-0.15</k1><k2>0.04</k2><k3>0.01</k3><p1>0.002</p1><p2>-0.001</p2>"
    fish = f"{common}<k1>0.05</k1><k2>-0.02</k2><k3>0.01</k3><k4>0.003</k4>"
    sensors = "".join(
        f'<sensor id="{n}" label="s" type="{kind}">{size}<calibration type="{kind}" class="initial"><f>1</f></calibration>'
        f'<calibration type="{kind}" class="adjusted">{size}{body}</calibration></sensor>'
        for n, (kind, body) in enumerate((("frame", frame), ("fisheye", fish)))
    )
    transform = f'<transform><rotation locked="true">{text_of(turn)}</rotation><translation>{text_of(shift)}</translation>'
    transform += f"<scale>{scale}</scale></transform>"
    lost = '<camera id="90" sensor_id="0" label="lost"/>'
    xml = '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
    xml += f"<sensors>{sensors}</sensors>"
    xml += f'<cameras><group id="0">{"".join(cameras[:2])}</group>{"".join(cameras[2:])}{lost}</cameras>{transform}</chunk></document>'
    pictures(folder / "photos", [f"my photo {n}.png" for n in range(len(rig))])
    (folder / "cameras.xml").write_text(xml)
    return out


def write_realitycapture(folder, rig):
    rows, out = ["#cameras 4", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"], []
    for n, (r, c) in enumerate(rig):
        m = r.T @ OPENGL  # camera to world, y up: Rz(-heading) Rx(pitch) Ry(roll)
        pitch, heading, roll = np.arcsin(m[2, 1]), np.arctan2(m[0, 1], m[1, 1]), np.arctan2(-m[2, 0], m[2, 2])
        d = [-0.1, 0.03, 0.01, 0.02 * (n == 2), 0.001, -0.002]
        rows.append(f"img {n}.png,{text_of([*c, *np.degrees([heading, pitch, roll]), 30, 0.01, -0.02, *d]).replace(' ', ',')}")
        x = brown(normal(r, c), *d[:3], d[4], d[5], k4=d[3])
        f = 30 / 36 * max(SIZE)
        out.append(x * f + [SIZE[0] / 2 + 0.01 * max(SIZE), SIZE[1] / 2 - 0.02 * max(SIZE)] - 0.5)
    pictures(folder, [f"img {n}.png" for n in range(len(rig))])
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n")
    return out


def write_bundler(folder, rig):
    lines, out = ["# Bundle file v0.3", f"{len(rig) + 1} 0"], []
    for n, (r, c) in enumerate(rig):
        own = OPENGL @ r
        lines += [f"{F} {-0.1 - 0.01 * n} 0.02", *(text_of(row) for row in own), text_of(-own @ c)]
        p = (POINTS - c) @ own.T
        p = -p[:, :2] / p[:, 2:]
        s = (p**2).sum(1, keepdims=True)
        p = F * (1 + (-0.1 - 0.01 * n) * s + 0.02 * s**2) * p  # from the image's middle, y up
        out.append(p * [1, -1] + MIDDLE)
    lines += ["0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]
    names = [f"./a b {n}.jpg" for n in range(len(rig))]
    pictures(folder, names)
    (folder / "list.txt").write_text("\n".join(f"{n} 0 {F}" for n in names) + "\n./lost.jpg\n")
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    return out


def write_nvm(folder, rig):
    lines, out = ["NVM_V3 ", "", str(len(rig))], []
    for n, (r, c) in enumerate(rig):
        w, x, y, z = quaternion_of(r)
        k = (-0.15, 0.0, 0.08, -0.05)[n]
        lines.append(f"C:\\photos\\a{n}.png {F} {text_of([w, x, y, z, *c, k])} 0")
        p = normal(r, c)
        target, m = np.linalg.norm(p, axis=1), np.linalg.norm(p, axis=1)
        for _ in range(60):  # the measured radius m with (1 + k m²) m = the undistorted one
            m = m - (m * (1 + k * m * m) - target) / (1 + 3 * k * m * m)
        out.append(p * (m / target)[:, None] * F + MIDDLE)
    pictures(folder / "photos", [f"a{n}.png" for n in range(len(rig))])
    (folder / "scene.nvm").write_text("\n".join([*lines, "", "0", ""]))
    return out


def quaternion_of(r):
    v = cv2.Rodrigues(r)[0].ravel()
    a = np.linalg.norm(v)
    return np.array([np.cos(a / 2), *(np.sin(a / 2) * v / max(a, 1e-300))])


def write_meshroom(folder, rig, version=(1, 2, 8)):
    d = {"radial3": [-0.1, 0.03, 0.01], "brown": [-0.1, 0.03, 0.01, 0.002, -0.001], "fisheye4": [0.05, 0.01, 0.0, 0.001], "pinhole": []}
    views, cameras, poses, out = [], [], [], []
    for n, ((r, c), kind) in enumerate(zip(rig, d)):
        strings = [f"{v:.17g}" for v in d[kind]]
        camera = {"intrinsicId": str(n), "width": str(SIZE[0]), "height": str(SIZE[1]), "type": kind, "distortionParams": strings or ""}
        fx, fy = F, F * 1.02
        if version < (1, 2, 0):
            fy, camera["pxFocalLength"] = fx, str(fx)
        elif version < (1, 2, 2):
            camera["pxFocalLength"] = [str(fx), str(fy)]
        else:
            ratio = fy / fx if version >= (1, 2, 5) else fx / fy
            camera |= {"focalLength": f"{fx * 36 / SIZE[0]:.17g}", "sensorWidth": "36", "sensorHeight": "24", "pixelRatio": f"{ratio:.17g}"}
        offset = [1.5, -0.75] if version >= (1, 2, 1) else [SIZE[0] / 2 + 1.5, SIZE[1] / 2 - 0.75]
        camera["principalPoint"] = [str(v) for v in offset]
        cameras.append(camera)
        views.append({"viewId": str(100 + n), "poseId": str(100 + n), "intrinsicId": str(n), "path": f"/home/me/shots/v{n}.png"})
        transform = {"rotation": [f"{v:.17g}" for v in r.T.ravel()], "center": [f"{v:.17g}" for v in c]}
        poses.append({"poseId": str(100 + n), "pose": {"transform": transform, "locked": "0"}})
        x = normal(r, c)
        x = equidistant(x, *d[kind]) if kind == "fisheye4" else brown(x, *d[kind][:3], *d[kind][3:])
        out.append(x * [fx, fy] + [SIZE[0] / 2 + 1.5, SIZE[1] / 2 - 0.75])
    views.append({"viewId": "7", "poseId": "7", "intrinsicId": "0", "path": "lost.png"})
    pictures(folder / "images", [f"v{n}.png" for n in range(len(rig))])
    data = {"version": [str(v) for v in version], "featuresFolders": [], "views": views, "intrinsics": cameras, "poses": poses}
    (folder / "cameras.sfm").write_text(json.dumps(data, indent=1))
    return out


def write_openmvg(folder, rig):
    first = {0: "pinhole_brown_t2", 1: "pinhole_radial_k3", 2: "fisheye"}
    views, cameras, poses, out = [], [], [], []
    for n, (r, c) in enumerate(rig):
        kind = first[n % 3]
        data = {"width": SIZE[0], "height": SIZE[1], "focal_length": F, "principal_point": [32.5, 23.25]}
        d = {"disto_t2": [-0.1, 0.03, 0.01, 0.002, -0.001], "disto_k3": [-0.1, 0.03, 0.01], "fisheye": [0.05, 0.01, 0.0, 0.001]}
        key = ("disto_t2", "disto_k3", "fisheye")[n % 3]
        data = {"value0": data, key: d[key]} if n % 2 else data | {key: d[key]}
        pointer = {"polymorphic_id": n % 3 + 1, "ptr_wrapper": {"id": 2147483700 + n, "data": data}}
        if n < 3:
            pointer |= {"polymorphic_id": 0x80000000 + n + 1, "polymorphic_name": kind}
        cameras.append({"key": n, "value": pointer})
        view = {
            "local_path": "",
            "filename": f"v{n}.png",
            "width": SIZE[0],
            "height": SIZE[1],
            "id_view": n,
            "id_intrinsic": n,
            "id_pose": n,
        }
        views.append({"key": n, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483649 + n, "data": view}}})
        poses.append({"key": n, "value": {"rotation": r.tolist(), "center": c.tolist()}})
        x = normal(r, c)
        x = equidistant(x, *d["fisheye"]) if kind == "fisheye" else brown(x, *d[key][:3], *d[key][3:])
        out.append(x * F + [32.5, 23.25])
    pictures(folder / "shots", [f"v{n}.png" for n in range(len(rig))])
    data = {"sfm_data_version": "0.3", "root_path": "/home/me/shots", "views": views, "intrinsics": cameras, "extrinsics": poses}
    (folder / "sfm_data.json").write_text(json.dumps(data | {"structure": [], "control_points": []}))
    return out


def write_polycam(folder, rig):
    out = []
    (folder / "keyframes" / "corrected_cameras").mkdir(parents=True)
    for n, (r, c) in enumerate(rig):
        pose = np.column_stack([r.T @ OPENGL, c])
        frame = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
        frame |= {"fx": F, "fy": F + 1, "cx": 32.25, "cy": 23, "width": SIZE[0], "height": SIZE[1], "blur_score": 100.0, "timestamp": n}
        (folder / "keyframes" / "corrected_cameras" / f"{n + 8}.json").write_text(json.dumps(frame))
        out.append(normal(r, c) * [F, F + 1] + [32.25, 23] - 0.5)
    pictures(folder / "keyframes" / "corrected_images", [f"{n + 8}.jpg" for n in range(len(rig))])
    return out


def write_record3d(folder, rig):
    poses, out = [], []
    for r, c in rig:
        w, x, y, z = quaternion_of(r.T @ OPENGL)
        poses.append([x, y, z, w, *c])
        out.append(normal(r, c) * [F, F + 1] + [32.25, 23] - 0.5)
    k = [F, 0, 0, 0, F + 1, 0, 32.25, 23, 1]
    (folder / "metadata").write_text(json.dumps({"w": SIZE[0], "h": SIZE[1], "K": k, "poses": poses, "fps": 60, "dw": 192, "dh": 256}))
    pictures(folder / "EXR_RGBD" / "rgb", [f"{n}.jpg" for n in range(len(rig))])
    return out


def write_opensfm(folder, rig):
    kinds = {
        "perspective": {"k1": -0.1, "k2": 0.03},
        "brown": {"c_x": 0.01, "c_y": -0.02, "k1": -0.1, "k2": 0.03, "k3": 0.01, "p1": 0.002, "p2": -0.001},
        "fisheye": {"k1": 0.05, "k2": 0.01},
        "fisheye_opencv": {"c_x": 0.01, "c_y": -0.02, "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001},
    }
    cameras, shots, out = {}, {}, []
    for n, ((r, c), (kind, d)) in enumerate(zip(rig, kinds.items())):
        focal = {"focal": F / 64} if "c_x" not in d else {"focal_x": F / 64, "focal_y": (F + 1) / 64}
        cameras[f"v2 {kind}"] = {"projection_type": kind, "width": SIZE[0], "height": SIZE[1], **focal, **d}
        shots[f"shot {n}.jpg"] = {
            "rotation": cv2.Rodrigues(r)[0].ravel().tolist(),
            "translation": (-r @ c).tolist(),
            "camera": f"v2 {kind}",
        }
        x, v = normal(r, c), lambda k, d=d: d.get(k, 0.0)
        if "fisheye" in kind:
            x = equidistant(x, v("k1"), v("k2"), v("k3"), v("k4"))
        else:
            x = brown(x, v("k1"), v("k2"), v("k3"), v("p1"), v("p2"))
        fy = F + 1 if "c_x" in d else F
        out.append(x * [F, fy] + [31.5 + 64 * v("c_x"), 23.5 + 64 * v("c_y")])
    small = {"cameras": cameras, "shots": dict(list(shots.items())[:1])}
    (folder / "opensfm").mkdir()
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps([small, {"cameras": cameras, "shots": shots, "points": {}}]))
    pictures(folder / "images", shots)
    return out


def write_3dgs(folder, rig):
    views, out = [], []
    for n, (r, c) in enumerate(rig):
        view = {"id": n, "img_name": f"v{n}", "width": SIZE[0], "height": SIZE[1], "position": c.tolist(), "rotation": r.T.tolist()}
        views.append(view | {"fy": F + 1, "fx": F})
        out.append(normal(r, c) * [F, F + 1] + [31.5, 23.5])
    pictures(folder / "images", [f"v{n}.jpg" for n in range(len(rig))])
    (folder / "cameras.json").write_text(json.dumps(views))
    return out


def write_llff(folder, rig):
    rows, out = [], []
    for r, c in rig:
        right, down, forward = r
        matrix = np.column_stack([down, right, -forward, c, [SIZE[1], SIZE[0], F]])
        rows.append([*matrix.ravel(), 1.0, 4.0])
        out.append(normal(r, c) * F + [31.5, 23.5])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    pictures(folder / "images", [f"IMG_{n}.JPG" for n in (2, 9, 10, 11)], (128, 96))
    pictures(folder / "images_2", [f"IMG_{n}.png" for n in (2, 9, 10, 11)])
    return out


def write_scannet(folder, rig):
    (folder / "pose").mkdir()
    (folder / "intrinsic").mkdir()
    k = np.eye(4)
    k[:2, :3] = [[F, 0, 31.0], [0, F + 1, 23.0]]
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", k)
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", k)
    out = []
    for n, (r, c) in enumerate(rig):
        np.savetxt(folder / "pose" / f"{9 + n}.txt", np.vstack([np.column_stack([r.T, c]), [0, 0, 0, 1]]))
        out.append(normal(r, c) * [F, F + 1] + [31, 23])
    np.savetxt(folder / "pose" / "20.txt", np.full((4, 4), -np.inf))
    pictures(folder / "color", [f"{9 + n}.jpg" for n in range(len(rig))])
    pictures(folder / "depth", [f"{9 + n}.png" for n in range(len(rig))])
    return out


def write_replica(folder, rig):
    scene = folder / "office0"
    out = [normal(r, c) * [F, F + 1] + [31, 23] for r, c in rig]
    pictures(
        scene / "results", [f"{kind}{n:06d}.{suffix}" for kind, suffix in (("frame", "jpg"), ("depth", "png")) for n in range(len(rig))]
    )
    rows = [text_of(np.vstack([np.column_stack([r.T, c]), [0, 0, 0, 1]])) for r, c in rig]
    (scene / "traj.txt").write_text("\n".join(rows) + "\n")
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": F, "fy": F + 1, "cx": 31.0, "cy": 23.0, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return out


def write_tum(folder, rig):
    lines, listed, out = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"], ["# color images"], []
    for n, (r, c) in enumerate(rig):
        w, x, y, z = quaternion_of(r.T)
        lines += [f"{1000.0 + n:.4f} {text_of([*c, x, y, z, w])}", f"{1000.0 + n + 0.4:.4f} 9 9 9 0 0 0 1"]
        listed.append(f"{1000.01 + n:.6f} rgb/{1000.01 + n:.6f}.png")
        out.append(brown(normal(r, c), 0.26, -0.95, 1.16, -0.005, 0.003) * [F, F + 1] + [31, 23])
    listed.append("2000.0 rgb/2000.000000.png")
    pictures(folder / "rgb", [line.split("/")[1] for line in listed[1:]])
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    (folder / "rgb.txt").write_text("\n".join(listed) + "\n")
    (folder / "camera.txt").write_text(f"# fx fy cx cy k1 k2 p1 p2 k3\n{F} {F + 1} 31 23 0.26 -0.95 -0.005 0.003 1.16\n")
    return out


def write_panoptic(folder, rig):
    cameras, out = [], []
    for n, (r, c) in enumerate(rig):
        camera = {"name": f"00_{n:02d}", "type": "hd", "resolution": list(SIZE), "panel": 0, "node": n, "R": r.tolist()}
        camera |= {"t": (-r @ c).reshape(3, 1).tolist(), "K": [[F, 0, 31], [0, F + 1, 23], [0, 0, 1]]}
        cameras.append(camera | {"distCoef": [-0.1, 0.03, 0.002, -0.001, 0.01]})
        out.append(brown(normal(r, c), -0.1, 0.03, 0.01, 0.002, -0.001) * [F, F + 1] + [31, 23])
    cameras.append(cameras[0] | {"name": "01_01", "type": "vga"})
    (folder / "calibration_171204_pose1.json").write_text(json.dumps({"calibDataSource": "x", "cameras": cameras}))
    pictures(folder / "hdImgs", [f"00_{n:02d}/00_{n:02d}_00000100.jpg" for n in range(len(rig))])
    return out


def storage(path, **named):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in named.items():
        if isinstance(value, dict | list):
            file.startWriteStruct(name, cv2.FileNode_MAP if isinstance(value, dict) else cv2.FileNode_SEQ)
            for inner, v in value.items() if isinstance(value, dict) else [("", v) for v in value]:
                file.write(inner, v)
            file.endWriteStruct()
        else:
            file.write(name, value)
    file.release()


def write_mccalib(folder, rig):
    cameras, out = {}, []
    for n, (r, c) in enumerate(rig):
        pose = np.vstack([np.column_stack([r.T, c]), [0, 0, 0, 1]])
        d = np.array([[0.05, 0.01, 0.0, 0.001]] if n == 1 else [[-0.1, 0.03, 0.002, -0.001, 0.01]])
        camera = {
            "camera_matrix": np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]]),
            "distortion_vector": d,
            "distortion_type": int(n == 1),
        }
        camera |= {"camera_group": 0, "img_width": SIZE[0], "img_height": SIZE[1], "camera_pose_matrix": pose}
        cameras[f"camera_{n}"] = camera
        x = normal(r, c)
        x = equidistant(x, *d[0]) if n == 1 else brown(x, -0.1, 0.03, 0.01, 0.002, -0.001)
        out.append(x * [F, F + 1] + [31, 23])
    storage(folder / "calibrated_cameras_data.yml", nb_camera=len(rig), **cameras)
    pictures(folder / "images", [f"camera_{n}.png" for n in range(len(rig))])
    return out


WRITERS = {
    "aniposelib": write_calib_toml,
    "Metashape": write_metashape,
    "RealityCapture": write_realitycapture,
    "Bundler": write_bundler,
    "VisualSFM": write_nvm,
    "Meshroom": write_meshroom,
    "openMVG": write_openmvg,
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "OpenSfM": write_opensfm,
    "3D Gaussian": write_3dgs,
    "LLFF": write_llff,
    "ScanNet": write_scannet,
    "Replica": write_replica,
    "TUM": write_tum,
    "Panoptic": write_panoptic,
    "MC-Calib": write_mccalib,
}

NAMED = ("Metashape", "RealityCapture", "Bundler", "VisualSFM", "Meshroom", "openMVG", "OpenSfM")
"""Formats that name their images."""
SIZED = ("aniposelib", "Metashape", "Meshroom", "openMVG", "Polycam", "Record3D", "OpenSfM", "3D Gaussian", "Panoptic", "MC-Calib")
"""Formats that say their images' sizes."""
TEXTS = (".toml", ".xml", ".csv", ".txt", ".out", ".nvm", ".sfm", ".json", ".yml", "")
"""Suffixes of the files that hold calibrations."""


def calibrations(folder):
    return sorted(f for f in folder.rglob("*") if f.is_file() and f.suffix in TEXTS)


@pytest.mark.parametrize("name", WRITERS)
def test_cameras_project_as_the_format_says(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    scene = mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path)
    assert scene.format.startswith(name)
    check(scene, expected)
    assert all(f.is_file() for f in scene.frames)


@pytest.mark.parametrize("name", [n for n in WRITERS if n != "LLFF"])
def test_byte_order_marks_and_windows_line_ends_change_nothing(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    for file in calibrations(tmp_path):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    check(mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path), expected)


@pytest.mark.parametrize("name", ["aniposelib", "LLFF", *NAMED])
def test_images_in_a_folder_of_the_callers(tmp_path, rig, name):
    (tmp_path / "set").mkdir()
    expected = WRITERS[name](tmp_path / "set", rig)
    photos = [f for f in sorted((tmp_path / "set").rglob("*")) if f.suffix.lower() in (".png", ".jpg") and f.parent.name != "images"]
    photos = photos or sorted((tmp_path / "set" / "images").iterdir())
    for photo in photos:
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        shutil.move(photo, tmp_path / "elsewhere" / photo.name)
    shutil.rmtree(tmp_path / "set" / "images", ignore_errors=True)
    with pytest.raises((FormatError, FileNotFoundError)):
        mvcore.load(tmp_path / "set")
    check(mvcore.load(tmp_path / "set", images=tmp_path / "elsewhere"), expected)


@pytest.mark.parametrize("name", SIZED)
def test_cameras_alone_need_no_images(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    for image in [f for f in tmp_path.rglob("*") if f.suffix in (".png", ".jpg")]:
        image.unlink()
    check(mvcore.load(tmp_path, images=False), expected)


@pytest.mark.parametrize("name", [n for n in WRITERS if n not in ("Replica", "ScanNet", "Record3D")])
def test_a_calibration_file_stands_for_its_folder(tmp_path, rig, name):
    expected = WRITERS[name](tmp_path, rig)
    files = [f for f in [*calibrations(tmp_path), *tmp_path.glob("*.npy")] if f.name not in ("list.txt", "rgb.txt", "camera.txt")]
    check(mvcore.load(files[0]), expected)


@pytest.mark.parametrize("version", [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 5)])
def test_meshroom_versions(tmp_path, rig, version):
    expected = write_meshroom(tmp_path, rig, version)
    check(mvcore.load(tmp_path), expected)


def storage_pair(folder, rig, files, names, motion):
    """A stereo calibration as OpenCV's FileStorage, and where the points, in the first camera's frame, are seen."""
    (r0, c0), (r1, c1) = rig[:2]
    k1, k2 = np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]]), np.array([[F + 2, 0, 30], [0, F, 24.0], [0, 0, 1]])
    d1, d2 = np.array([[-0.1, 0.03, 0.002, -0.001, 0.01]]), np.array([[-0.05], [0.01], [0.0], [0.001]])
    storage(folder / files[0], **dict(zip(names, (k1, d1, k2, d2))), **(motion(r1 @ r0.T, r1 @ (c0 - c1)) if len(files) == 1 else {}))
    if len(files) == 2:
        storage(folder / files[1], **motion(r1 @ r0.T, r1 @ (c0 - c1)), R1=np.eye(3), P1=np.eye(3, 4), Q=np.eye(4))
    first = brown(normal(r0, c0), -0.1, 0.03, 0.01, 0.002, -0.001) * [F, F + 1] + [31, 23]
    second = brown(normal(r1, c1), -0.05, 0.01, 0, 0, 0.001) * [F + 2, F] + [30, 24]
    return [first, second], (POINTS - c0) @ r0.T


@pytest.mark.parametrize(
    ("files", "names", "motion"),
    [
        (["intrinsics.yml", "extrinsics.yml"], ("M1", "D1", "M2", "D2"), lambda r, t: {"R": r, "T": t.reshape(3, 1)}),
        (["stereo.yml"], ("K1", "D1", "K2", "D2"), lambda r, t: {"R": r, "T": t.tolist()}),
        (["stereo.xml"], ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"), lambda r, t: {"R": cv2.Rodrigues(r)[0], "T": t}),
        (["stereo.yaml"], ("K_left", "D_left", "K_right", "D_right"), lambda r, t: {"rotation_matrix": r, "translation_vector": t}),
        (["stereo.yml"], ("mtxL", "distL", "mtxR", "distR"), lambda r, t: {"Rot": r, "Trans": t}),
        (["a.yml", "b.yml"], ("camera_matrix_0", "dist_coeffs_0", "camera_matrix_1", "dist_coeffs_1"), lambda r, t: {"R": r, "T": t}),
    ],
)
def test_opencv_stereo_in_one_or_two_files(tmp_path, rig, files, names, motion):
    expected, points = storage_pair(tmp_path, rig, files, names, motion)
    pictures(tmp_path, ["left.png", "right.png"])
    for path in (tmp_path, tmp_path / files[0], tmp_path / files[-1]):
        check(mvcore.load(path), expected, points)


def test_a_stereo_calibration_without_its_motion_says_so(tmp_path, rig):
    storage_pair(tmp_path, rig, ["a.yml", "b.yml"], ("M1", "D1", "M2", "D2"), lambda r, t: {"R": r, "T": t})
    (tmp_path / "b.yml").unlink()
    with pytest.raises(FormatError, match=r"a\.yml.*R and T of the second camera missing"):
        mvcore.load(tmp_path, images=False)


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_ros_camera_info(tmp_path, rig, model):
    d = {"plumb_bob": [-0.1, 0.03, 0.002, -0.001, 0.01], "equidistant": [0.05, 0.01, 0.0, 0.001], "rational_polynomial": [0.0] * 8}[model]
    turn = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]  # from each camera's axes to the rectified ones
    k, p = np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]]), np.array([[50.0, 0, 30], [0, 50, 22], [0, 0, 1]])
    ahead, out = POINTS + np.array([0, 0, 3.0]), []
    for name, shift in (("left", 0.0), ("right", -0.3)):
        projection = p @ np.column_stack([np.eye(3), [shift, 0, 0]])
        block = lambda m: f"\n  rows: {len(m)}\n  cols: {len(m[0])}\n  data: [{', '.join(map(repr, np.ravel(m).tolist()))}]"  # noqa: E731
        text = (
            f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: {name}\ncamera_matrix:{block(k)}\ndistortion_model: {model}\n"
        )
        text += f"distortion_coefficients:{block([d])}\nrectification_matrix:{block(turn)}\nprojection_matrix:{block(projection)}\n"
        (tmp_path / f"{name}.yaml").write_text(text)
        q = (ahead + np.array([shift, 0, 0])) @ turn  # R^T on column vectors
        x = q[:, :2] / q[:, 2:]
        x = equidistant(x, *d) if model == "equidistant" else brown(x, *d[:2], d[4], *d[2:4])
        out.append(x * [F, F + 1] + [31, 23])
    pictures(tmp_path, ["left.png", "right.png"])
    check(mvcore.load(tmp_path), out, ahead)
    check(mvcore.load(tmp_path / "right.yaml"), out, ahead)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(FormatError, match="two or more cameras, got one"):
        mvcore.load(tmp_path)


def test_kitti(tmp_path):
    k, shifts = np.array([[F, 0, 31.0], [0, F, 23], [0, 0, 1]]), [np.zeros(3), np.array([-0.3, 0, 0])]
    lines = [f"P{n}: {text_of(k @ np.column_stack([np.eye(3), b]))}" for n, b in enumerate(shifts * 2)]
    poses = [np.eye(4)[:3], np.column_stack([cv2.Rodrigues(np.array([0.0, 0.1, 0]))[0], [0.05, 0, 0.2]])]
    ahead, out = POINTS + np.array([0, 0, 3.0]), []
    for pose in poses:
        for b in shifts:
            q = (ahead - pose[:, 3]) @ pose[:, :3] + b
            out.append(q[:, :2] / q[:, 2:] * F + [31, 23])
    (tmp_path / "calib.txt").write_text("\n".join(lines) + "\nTr: " + text_of(np.eye(3, 4)) + "\n")
    for n in range(4):
        pictures(tmp_path / f"image_{n}", ["000000.png", "000001.png"])
    alone = mvcore.load(tmp_path)
    check(alone, out[:2], ahead)
    assert alone.frames[0].parent.name == "image_2"  # colour
    assert "only the first of 2 frames" in alone.warnings[0]
    (tmp_path / "poses.txt").write_text("\n".join(text_of(p) for p in poses) + "\n")
    check(mvcore.load(tmp_path), out, ahead)


def test_middlebury_stereo(tmp_path):
    text = f"cam0=[{F} 0 31; 0 {F} 23; 0 0 1]\ncam1=[{F} 0 35.5; 0 {F} 23; 0 0 1]\ndoffs=4.5\nbaseline=300\n"
    (tmp_path / "calib.txt").write_text(text + f"width={SIZE[0]}\nheight={SIZE[1]}\nndisp=64\nisint=0\n")
    pictures(tmp_path, ["im0.png", "im1.png"])
    far = 1000 * (POINTS + np.array([0, 0, 3.0]))
    left = far[:, :2] / far[:, 2:] * F + np.array([31, 23])
    disparity = F * 300 / far[:, 2] - 4.5  # the format's own equation: Z = baseline f / (d + doffs)
    check(mvcore.load(tmp_path), [left, left - np.column_stack([disparity, 0 * disparity])], far)


def test_a_pycolmap_reconstruction(tmp_path, rig):
    pycolmap = pytest.importorskip("pycolmap")
    k, d = [[F, 0, 31], [0, F + 1, 23], [0, 0, 1]], [-0.1, 0.03, 0.002, 0.001]
    scene = mvcore.Scene(
        [tmp_path / "photos" / f"{n}.png" for n in range(len(rig))],
        mvcore.Calibration(tuple(mvcore.Camera(k, r, -r @ c, *SIZE, d) for r, c in rig)),
    )
    mvcore.save_calibration(tmp_path / "model", scene, "colmap")
    pictures(tmp_path / "photos", [f"{n}.png" for n in range(len(rig))])
    reconstruction = pycolmap.Reconstruction(str(tmp_path / "model"))
    read = mvcore.load(reconstruction, images=tmp_path / "photos")
    check(read, [seen(c, POINTS) for c in scene.calib])
    assert [f.name for f in read.frames] == [f"{n}.png" for n in range(len(rig))]
    with pytest.raises(InvalidInputError, match="images"):
        mvcore.load(reconstruction)
    assert len(mvcore.load(reconstruction, images=False)) == len(rig)


def test_colmap_comes_before_the_cameras_of_a_splatting_run(tmp_path, rig):
    expected = write_3dgs(tmp_path, rig)
    cameras = tuple(mvcore.Camera([[F, 0, 30], [0, F + 1, 22], [0, 0, 1]], r, -r @ c, *SIZE) for r, c in rig)
    scene = mvcore.Scene([tmp_path / "images" / f"v{n}.jpg" for n in range(len(rig))], mvcore.Calibration(cameras))
    mvcore.save_calibration(tmp_path / "sparse" / "0", scene, "colmap")
    read = mvcore.load(tmp_path)
    assert read.format == "COLMAP"
    assert read.calib[0].K[0, 2] == pytest.approx(30)
    check(mvcore.load(tmp_path / "cameras.json"), expected)


def test_what_each_reader_said(tmp_path, rig):
    write_3dgs(tmp_path, rig)
    (tmp_path / "cameras.json").write_text('[{"img_name": "a", "rotation": 1}]')
    (tmp_path / "scene.nvm").write_text("NVM_V3\n\nmany\n")
    with pytest.raises(FormatError, match=r"as VisualSFM .nvm: .*scene.nvm:3: .*; as 3D Gaussian .*\[0\].rotation: expected 3 x 3"):
        mvcore.load(tmp_path)
    expected = write_polycam(tmp_path, rig)
    scene = mvcore.load(tmp_path)
    check(scene, expected)
    assert "scene.nvm:3" in scene.warnings[0]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "Metashape",
            'type="frame" class="adjusted"',
            'type="spherical" class="adjusted"',
            r"sensor 's': the camera type 'spherical' cannot be read",
        ),
        ("Metashape", "<p1>0.002", "<p3>0.002</p3><p1>0.002", "p3 and p4"),
        ("Metashape", "<f>60.0</f>", "<f>60.0x</f>", r"<f>: expected a finite number, got '60.0x'"),
        ("Metashape", "<resolution ", '<resolution width="0" ', r"cameras.xml:\d+: "),
        ("Meshroom", '"brown"', '"3deanamorphic4"', "the camera model '3deanamorphic4' cannot be read"),
        ("Meshroom", '"poses"', '"positions"', "no poses"),
        ("Meshroom", '"36"', '"0"', "sensorWidth: expected a positive width"),
        ("openMVG", '"fisheye"}', '"spherical"}', "'spherical' cannot be read"),
        ("openMVG", '"extrinsics"', '"extras"', "no extrinsics"),
        ("OpenSfM", '"projection_type": "brown"', '"projection_type": "spherical"', "'spherical' cannot be read"),
        ("aniposelib", "fisheye = true", 'fisheye = "perhaps"\nx = [', "Calib.toml:"),
        ("aniposelib", "size = [64", "size = [1e400", "cam_0.size"),
        ("aniposelib", "matrix = [[60.0", "matrix = [[nan", "cam_0.matrix: NaN"),
        ("aniposelib", "rotation = [", "rotation = [1.0, ", "rotation of 3 or 9 numbers, got 4"),
        ("VisualSFM", "0.080000000000000002 0", "-3 0", "scene.nvm:6: the radial distortion -3 turns back"),
        ("VisualSFM", "60.0", "-60", r"scene.nvm:4: expected a positive focal length, got -60"),
        ("VisualSFM", "\n4\n", "\n5000000\n", "scene.nvm:3: expected a number of cameras"),
        ("Bundler", "\n5 0\n", "\n999999999 0\n", "bundle.out:2: expected a number of cameras"),
        ("Bundler", "-0.1 0.02", "-0.1 inf", "bundle.out:3: NaN or infinity"),
        ("RealityCapture", ",30,", ",30 mm,", "cameras.csv:3: f: expected a finite number, got '30 mm'"),
        ("Polycam", '"fx": 60.0', '"fx": null', "8.json: fx missing"),
        ("Polycam", '"width": 64', '"width": 99999999', "width: expected a size of 1"),
        ("Record3D", '"poses": [[', '"poses": [[5, ', r"metadata: poses\[0\]: expected 7 numbers, got 8"),
        ("Panoptic", '"resolution": [64', '"resolution": [-64', r"cameras\[0\].resolution: expected a size"),
        ("MC-Calib", "distortion_type: 0", "distortion_type: 7", "camera_0: the camera model '7' cannot be read"),
        ("TUM", "1000.0000 ", "1000.0000 x ", "groundtruth.txt:3: expected numbers, got 'x'"),
        ("Replica", " 1\n", " 1 2\n", "traj.txt:1: expected 16 numbers, got 17"),
        ("3D Gaussian", '"fx": 60.0', '"fx": "wide"', r"cameras.json: \[0\].fx: expected a finite number, got 'wide'"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, rig, name, old, new, message):
    WRITERS[name](tmp_path, rig)
    changed = False
    for file in calibrations(tmp_path):
        text = file.read_text()
        changed |= old in text
        file.write_text(text.replace(old, new))
    assert changed
    with pytest.raises(FormatError, match=message):
        mvcore.load(tmp_path / "office0" if name == "Replica" else tmp_path)


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_are_read_or_refused(tmp_path, rig, name):
    WRITERS[name](tmp_path, rig)
    root = tmp_path / "office0" if name == "Replica" else tmp_path
    rng = random.Random(name)
    files = [*calibrations(tmp_path), *tmp_path.glob("*.npy")]
    for _ in range(40):
        file = rng.choice(files)
        good = file.read_bytes()
        file.write_bytes(damaged(good, rng))
        said = str(tmp_path)
        try:
            mvcore.load(root)
        except (MvcoreError, OSError) as error:  # and nothing else is raised
            said = str(error)
        file.write_bytes(good)
        assert str(tmp_path) in said


def damaged(data, rng):
    """A file cut short, with bytes or numbers changed, or a piece repeated."""
    at, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    kind = rng.randrange(5)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes(rng.randrange(256) for _ in range(4)) + data[at + 4 :]
    if kind == 2:
        return data[:end] + data[at:end][:500] + data[end:]
    if kind == 3:
        return data[:at] + rng.choice([b"[" * 3000, b"{", b"nan", b"-1e999", b"9" * 5000, b'"', b"<a>", b"\x00", b"null"]) + data[at:]
    numbers = [n for n in range(len(data)) if data[n : n + 1].isdigit()]
    at = rng.choice(numbers) if numbers else at
    return data[:at] + rng.choice([b"1e308", b"-", b"e", b"NaN", b"0x", b"99999999999999999999"]) + data[at + 1 :]


def test_lens_models_are_fitted_or_refused():
    k = np.array([[F, 0, 31.5], [0, F, 23.5], [0, 0, 1]])
    corner = lens.corner_radius(k, *SIZE)
    values = lens.polynomial([-0.2, 0.05, -0.01, 0.004], 0.001, -0.002, F, corner)
    p = np.column_stack([np.linspace(0, 0.55, 50), np.linspace(0, 0.4, 50)])
    theirs = cv2.projectPoints(np.column_stack([p, np.ones(50)]), np.zeros(3), np.zeros(3), np.eye(3), np.array(values))[0].reshape(-1, 2)
    assert np.abs(theirs - brown(p, -0.2, 0.05, -0.01, 0.001, -0.002, k4=0.004)).max() * F < EXACT
    assert lens.polynomial([-2.0, 0, 0, 0.1], 0, 0, F, corner) is None  # turns back within the image
    assert lens.measured(-2.0, F, corner) is None
    assert lens.measured(0.0, F, corner) == []


def test_coefficients_named_k1_and_k2_make_no_stereo_pair(tmp_path, rig):
    for n, (r, c) in enumerate(rig):
        k = np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]])
        storage(
            tmp_path / f"{n}.yml", camera_matrix=k, rvec=cv2.Rodrigues(r)[0], tvec=-r @ c, image_width=64, image_height=48, k1=-0.1, k2=0.02
        )
    pictures(tmp_path, [f"{n}.png" for n in range(len(rig))])
    scene = mvcore.load(tmp_path)
    assert scene.format == "OpenCV FileStorage"
    assert not scene.warnings
    check(scene, [normal(r, c) * [F, F + 1] + [31, 23] for r, c in rig])


def test_a_file_of_one_format_is_not_said_to_be_another(tmp_path, rig):
    write_polycam(tmp_path, rig)
    assert not mvcore.load(tmp_path / "keyframes" / "corrected_cameras" / "8.json").warnings
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(FormatError, match=r"notes\.json: expected an object with a list 'views'"):
        mvcore.load(tmp_path / "notes.json")
