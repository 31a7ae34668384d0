"""Files of other tools' formats with the pixels where their own equations put known points.

Each ``write_*`` makes a folder of its format and returns where `POINTS` are in our pixels (centres at integers).
"""

import json

import cv2
import numpy as np
from conftest import look_at

SIZE = (64, 48)
F = 60.0
MIDDLE = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
POINTS = np.random.default_rng(5).uniform(-0.45, 0.45, (40, 3))
OPENGL = np.diag([1.0, -1, -1])


def views():
    """Rotation world to camera and centre of four cameras."""
    angles = (0.0, 0.5, 1.1, 1.8)
    return [(c.R, c.center) for c in (look_at((2 * np.cos(a), 2 * np.sin(a), 0.4), (0, 0, 0), SIZE, F) for a in angles)]


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


def text_of(values):
    return " ".join(f"{float(v):.17g}" for v in np.ravel(values))


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


AHEAD = POINTS + np.array([0, 0, 3.0])
"""In front of a first camera that is the world."""
ROS_LENSES = {"plumb_bob": [-0.1, 0.03, 0.002, -0.001, 0.01], "equidistant": [0.05, 0.01, 0.0, 0.001], "rational_polynomial": [0.0] * 8}


def write_ros(folder, model="plumb_bob"):
    """Two files of camera_info; the points are `AHEAD`, in the rectified axes of the first camera."""
    d = ROS_LENSES[model]
    turn = cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]  # from each camera's axes to the rectified ones
    k, p, out = np.array([[F, 0, 31], [0, F + 1, 23], [0, 0, 1]]), np.array([[50.0, 0, 30], [0, 50, 22], [0, 0, 1]]), []
    for name, shift in (("left", 0.0), ("right", -0.3)):
        projection = p @ np.column_stack([np.eye(3), [shift, 0, 0]])
        block = lambda m: f"\n  rows: {len(m)}\n  cols: {len(m[0])}\n  data: [{', '.join(map(repr, np.ravel(m).tolist()))}]"  # noqa: E731
        text = f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: {name}\ncamera_matrix:{block(k)}\n"
        text += f"distortion_model: {model}\ndistortion_coefficients:{block([d])}\n"
        text += f"rectification_matrix:{block(turn)}\nprojection_matrix:{block(projection)}\n"
        (folder / f"{name}.yaml").write_text(text)
        q = (AHEAD + np.array([shift, 0, 0])) @ turn  # R^T on column vectors
        x = q[:, :2] / q[:, 2:]
        x = equidistant(x, *d) if model == "equidistant" else brown(x, *d[:2], d[4], *d[2:4])
        out.append(x * [F, F + 1] + [31, 23])
    pictures(folder, ["left.png", "right.png"])
    return out


def write_kitti(folder, with_poses=True):
    """calib.txt of a sequence of odometry, with two frames."""
    k, shifts = np.array([[F, 0, 31.0], [0, F, 23], [0, 0, 1]]), [np.zeros(3), np.array([-0.3, 0, 0])]
    lines = [f"P{n}: {text_of(k @ np.column_stack([np.eye(3), b]))}" for n, b in enumerate(shifts * 2)]
    poses = [np.eye(4)[:3], np.column_stack([cv2.Rodrigues(np.array([0.0, 0.1, 0]))[0], [0.05, 0, 0.2]])]
    out = []
    for pose in poses:
        for b in shifts:
            q = (AHEAD - pose[:, 3]) @ pose[:, :3] + b
            out.append(q[:, :2] / q[:, 2:] * F + [31, 23])
    (folder / "calib.txt").write_text("\n".join(lines) + "\nTr: " + text_of(np.eye(3, 4)) + "\n")
    for n in range(4):
        pictures(folder / f"image_{n}", ["000000.png", "000001.png"])
    if with_poses:
        (folder / "poses.txt").write_text("\n".join(text_of(p) for p in poses) + "\n")
    return out


def write_middlebury_stereo(folder):
    """calib.txt of a pair; the points are 1000 times `AHEAD`."""
    text = f"cam0=[{F} 0 31; 0 {F} 23; 0 0 1]\ncam1=[{F} 0 35.5; 0 {F} 23; 0 0 1]\ndoffs=4.5\nbaseline=300\n"
    (folder / "calib.txt").write_text(text + f"width={SIZE[0]}\nheight={SIZE[1]}\nndisp=64\nisint=0\n")
    pictures(folder, ["im0.png", "im1.png"])
    left = AHEAD[:, :2] / AHEAD[:, 2:] * F + np.array([31, 23])
    disparity = F * 300 / (1000 * AHEAD[:, 2]) - 4.5  # the format's own equation: Z = baseline f / (d + doffs)
    return [left, left - np.column_stack([disparity, 0 * disparity])]
