"""The architecture's arrows: a folder imports only folders above it in the list."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "python" / "mvcore"
ORDER = [
    "errors",
    "types",
    "config",
    "geometry",
    "io",
    "sparse",
    "network",
    "depth",
    "silhouettes",
    "volume",
    "mesh",
    "pipeline",
    "video",
    "viewer",
    "evaluation",
    "nurbs",
    "cli",
]


def imports(path: Path) -> set[str]:
    """Top-level modules of mvcore that a file imports when it is loaded or run."""
    folder = list(path.relative_to(PACKAGE).parts[:-1])
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = folder[: len(folder) - node.level + 1] + (node.module.split(".") if node.module else [])
            found |= {base[0]} if base else {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            assert not any(n.split(".")[0] == "mvcore" for n in names), f"{path}: absolute import of mvcore"
    return found - {"_core"}


def files(layer: str) -> list[Path]:
    return sorted((PACKAGE / layer).rglob("*.py")) or [PACKAGE / f"{layer}.py"]


def test_every_module_has_a_place():
    names = {p.stem for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert names - {"__init__"} == set(ORDER)


@pytest.mark.parametrize("layer", ORDER)
def test_a_folder_imports_only_folders_above_it(layer):
    allowed = {*ORDER[: ORDER.index(layer) + 1]}
    for file in files(layer):
        assert imports(file) <= allowed, f"{file.relative_to(PACKAGE)} imports {imports(file) - allowed}"


def test_kernels_do_not_import_each_other():
    source = PACKAGE.parents[1] / "rust" / "mvcore" / "src"
    nouns = {"error", "interrupt", "memory", "raster", "grid", "mesh", "candidates"}
    below = {
        "slanted": {"patch"},
        "sweep": {"patch"},
        "isosurface": {"cube"},
        "shade": {"rasterize"},
        "fuse": {"smooth", "hull"},
        "atlas": {"pack", "level", "palette"},
    }
    for file in source.glob("*.rs"):
        used = set(re.findall(r"^use crate::(\w+)", file.read_text(), re.MULTILINE))
        assert used <= nouns | below.get(file.stem, set()), file.name
    for file in (source / "nurbs").glob("*.rs"):
        assert set(re.findall(r"^use crate::(\w+)", file.read_text(), re.MULTILINE)) <= {"error", "memory"}, file.name


def test_only_the_network_and_differentiable_nurbs_import_torch():
    for file in PACKAGE.rglob("*.py"):
        names = {a.name for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Import) for a in n.names}
        place = file.relative_to(PACKAGE)
        assert "torch" not in names or place.parts[0] == "network" or place.as_posix() == "nurbs/torch.py", file


def test_import_is_light():
    code = "import sys, mvcore; print([m for m in ('torch', 'cv2', 'trimesh', 'typer') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_functions_are_short():
    """A function that wants to be longer is two ideas; the docstring counts."""
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                assert lines <= 60, f"{file.relative_to(PACKAGE)}: {node.name} has {lines} lines"
