"""What importing costs, and which package may import which: docs/architecture.md, held by reading the sources."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import smplxpp

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("smplxpp", "avatar", "pipelines")
SHARED = {"core", "native", "raster", "skinning", "body", "template", "data"}
STAGES = {"capture", "segment", "clean", "transfer", "assemble", "metrics", "export"}


def imported_modules(path: Path) -> set[str]:
    """Dotted names that a source file imports, wherever in the file."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def sources(folder: str) -> list[Path]:
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files, folder
    return files


def violations(folder: str, forbidden: set[str]) -> list[str]:
    """Imports in a folder of a forbidden package or anything in it."""
    return [
        f"{path.relative_to(ROOT)}: {module}"
        for path in sources(folder)
        for module in sorted(imported_modules(path))
        if any(module == name or module.startswith(f"{name}.") for name in forbidden)
    ]


@pytest.mark.parametrize(
    "module", ["smplxpp", "smplxpp.metrics", "smplxpp.body", "smplxpp.transfer", "avatar", "pipelines.cli"]
)
def test_importing_is_light(module):
    heavy = ("torch", "trimesh", "PIL", "anny", "pygltflib")
    code = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_resolves():
    assert set(smplxpp.__all__) <= set(dir(smplxpp))
    assert all(getattr(smplxpp, name) is not None for name in smplxpp.__all__)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = smplxpp.nonsense


def test_every_room_is_a_stage_or_shared():
    rooms = {path.parent.name for path in (ROOT / "smplxpp").glob("*/__init__.py")} | {"data"}
    assert rooms == STAGES | SHARED


@pytest.mark.parametrize(("package", "above"), [("smplxpp", {"avatar", "pipelines"}), ("avatar", {"pipelines"})])
def test_imports_go_one_way(package, above):
    assert violations(package, above) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_do_not_import_tests_or_benchmarks(package):
    assert violations(package, {"tests", "benchmarks", "examples"}) == []


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_stages_do_not_import_each_other(stage):
    assert violations(f"smplxpp/{stage}", {f"smplxpp.{other}" for other in STAGES - {stage}}) == []


@pytest.mark.parametrize(
    ("room", "reaches"),
    [
        ("core", set()),
        ("native", set()),
        ("raster", {"core", "native"}),
        ("skinning", {"core"}),
        ("body", {"core", "skinning"}),
        ("template", {"core", "skinning", "body"}),
    ],
)
def test_shared_rooms_reach_little(room, reaches):
    allowed = {room} | reaches
    assert violations(f"smplxpp/{room}", {f"smplxpp.{other}" for other in (STAGES | SHARED) - allowed - {"data"}}) == []


def test_torch_stays_in_the_body_room():
    for package in ("smplxpp", "pipelines"):
        found = [
            v for v in violations(package, {"torch"}) if not v.startswith(("smplxpp/body/", "pipelines/ablation/"))
        ]
        assert found == []


def test_plain_pickle_is_never_loaded():
    unpickles = {"pickle.load", "pickle.loads", "pickle.Unpickler"}
    for package in PACKAGES:
        for path in sources(package):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
            assert not calls & unpickles, path
            for node in ast.walk(tree):
                if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                    assert isinstance(node.value, ast.Constant) and node.value.value is False, path
