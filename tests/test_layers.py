"""The architecture's arrows: a module imports only what stands to its left."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "python" / "mvcore"
ORDER = [
    "errors",
    "files",
    "store",
    "cameras",
    "types",
    "config",
    "io",
    "sparse",
    "network",
    "depth",
    "volume",
    "carve",
    "standing",
    "target",
    "surface",
    "texture",
    "result",
    "metrics",
    "nurbs",
    "motion",
    "pipeline",
    "sequence",
    "schedule",
    "targets",
    "instants",
    "rigid",
    "chains",
    "video",
    "viewer",
    "cli",
]


def imports(path: Path) -> set[str]:
    """Names of mvcore's own modules that a file imports when it is loaded or run."""
    found = set()
    inner = path.parent != PACKAGE
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            if inner and node.level == 1:
                found.add(path.parent.name)
            else:
                found |= {node.module.split(".")[0]} if node.module else {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            assert not any(n.split(".")[0] == "mvcore" for n in names), f"{path}: absolute import of mvcore"
    return found - {"_core"}


def test_every_module_has_a_place():
    names = {p.stem for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert names - {"__init__"} == set(ORDER)


@pytest.mark.parametrize("layer", ORDER)
def test_a_layer_imports_only_what_stands_to_its_left(layer):
    files = list((PACKAGE / layer).glob("*.py")) or [PACKAGE / f"{layer}.py"]
    allowed = set(ORDER[: ORDER.index(layer)]) | ({layer} if len(files) > 1 else set())
    for file in files:
        assert imports(file) <= allowed, f"{file.name} imports {imports(file) - allowed}"


def test_kernels_do_not_import_each_other():
    source = PACKAGE.parents[1] / "rust" / "mvcore" / "src"
    nouns = {"error", "memory", "raster", "grid", "mesh"}
    below = {
        "slanted": {"patch"},
        "sweep": {"patch"},
        "isosurface": {"cube"},
        "shade": {"rasterize"},
        "fuse": {"smooth", "hull"},
        "atlas": {"pack", "level"},
    }
    for file in source.glob("*.rs"):
        used = set(re.findall(r"^use crate::(\w+)", file.read_text(), re.MULTILINE))
        assert used <= nouns | below.get(file.stem, set()), file.name
    for file in (source / "nurbs").glob("*.rs"):
        assert set(re.findall(r"^use crate::(\w+)", file.read_text(), re.MULTILINE)) <= {"error", "memory"}, file.name


def test_only_the_network_and_differentiable_nurbs_import_torch():
    for file in PACKAGE.rglob("*.py"):
        names = {a.name for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Import) for a in n.names}
        assert "torch" not in names or file.parent.name == "network" or file.name == "torch.py", file


def test_import_is_light():
    code = "import sys, mvcore; print([m for m in ('torch', 'cv2', 'trimesh', 'typer') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
