"""What importing costs, and which package may import which: docs/architecture.md, held by reading the sources."""

from __future__ import annotations

import ast
import graphlib
import importlib
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

import avatar
import smplxpp
from pipelines.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("smplxpp", "avatar", "pipelines")
TOP = {"build", "people", "synth", "figures", "footage"}
"""Rooms above the stages, which nothing below imports: stages in order, procedural people, captures, pictures."""
SHARED = {"core", "native", "raster", "skinning", "body", "template", "cloth", "data"}
STAGES = {
    "capture",
    "segment",
    "clean",
    "transfer",
    "assemble",
    "metrics",
    "export",
    "register",
    "reconstruct",
    "detect",
    "texture",
}
# Rooms from low to high: an import goes down, never up and never to a room of the same floor.
FLOORS: dict[str, tuple[set[str], ...]] = {
    "avatar": (
        {"gaussians", "reconstruct", "runtime", "speech"},
        {"formats"},
        {"rig"},
        {"data"},
        {"rendering"},
        {"losses"},
        {"metrics", "models"},
        {"export", "driving"},
        {"training", "conversation"},
        {"baselines"},
        {"evaluation"},
    ),
    "pipelines": (
        {"runs"},
        {"stages"},
        {"report"},
        {"ablation"},
        {"batch"},
        {"web"},
        {"viewer"},
        {"commands"},
        {"cli"},
    ),
}
# Rooms that reach even less than what lies below them.
NARROW = {
    "avatar.evaluation": {"training", "conversation", "baselines"},
    "pipelines.batch": {"stages", "report", "ablation"},
    "pipelines.viewer": {"report", "ablation"},
    "pipelines.web": {"runs", "stages", "report", "ablation", "viewer"},
}


@dataclass(frozen=True)
class Source:
    """What the tests ask of a source file, read once for all of them.

    Attributes:
        imports: (module, name taken from it or "") of each import, wherever it stands in the file.
        executed: those that are not for type checkers alone.
        calls: (dotted name of what is called, whether it is an attribute); "" stands for what has no name.
        allow_pickle: whether each argument of that name is the constant False.
    """

    imports: list[tuple[str, str]]
    executed: list[tuple[str, str]]
    calls: set[tuple[str, bool]]
    allow_pickle: list[bool]


@cache
def source(path: Path) -> Source:
    """Return what the tests ask of a source file."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found = Source([], [], set(), [])
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), True)]
    while waiting:
        node, executed = waiting.pop()
        imported = []
        if isinstance(node, ast.Import):
            imported = [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            imported = [(module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Call):
            found.calls.add((dotted(node.func), isinstance(node.func, ast.Attribute)))
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            found.allow_pickle.append(isinstance(node.value, ast.Constant) and node.value.value is False)
        found.imports.extend(imported)
        if executed:
            found.executed.extend(imported)
        checked = isinstance(node, ast.If) and dotted(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
        unseen = set(map(id, node.body)) if checked else set()
        waiting += [(child, executed and id(child) not in unseen) for child in ast.iter_child_nodes(node)]
    return found


def dotted(node: ast.AST) -> str:
    """Return `a.b.c` for a chain of attributes, whose first word is "" where it is no name."""
    words = []
    while isinstance(node, ast.Attribute):
        words.append(node.attr)
        node = node.value
    return ".".join([node.id if isinstance(node, ast.Name) else "", *reversed(words)])


def imported_modules(path: Path) -> set[str]:
    """Dotted names that a source file imports, wherever in the file."""
    return {whole for module, name in source(path).imports for whole in (module, f"{module}.{name}".rstrip("."))}


def room(module: str) -> str:
    """Return the room of a module: `render` of `avatar.rendering.cpu`, "" of the package itself."""
    return ".".join(module.split(".")[1:2])


def modules_of(package: str) -> dict[str, Path]:
    """Return the files of a package by the names of their modules."""
    named = {}
    for path in sources(package):
        parts = path.relative_to(ROOT).with_suffix("").parts
        named[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return named


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


def test_importing_is_light():
    """One process imports one after the other, because each costs a second alone; the first with more is at fault."""
    modules = ["smplxpp", "smplxpp.metrics", "smplxpp.body", "smplxpp.transfer"]
    modules += ["avatar", "avatar.training", "avatar.rendering", "pipelines.cli"]
    heavy = ("torch", "trimesh", "PIL", "anny", "pygltflib")
    code = (
        f"import importlib, sys\nfor name in {modules}:\n    importlib.import_module(name)\n"
        f"    print(name, *[m for m in {heavy} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert done.stdout.split("\n")[:-1] == modules


def test_the_runtime_needs_no_torch():
    """Nor does it pull in anything of the trainer; the shipped wheel of a player has neither."""
    code = (
        "import sys, avatar.runtime; print([m for m in sys.modules if m in ('torch', 'safetensors', 'PIL')"
        " or (m.startswith('avatar.') and not m.startswith('avatar.runtime'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert done.stdout.strip() == "[]"


def test_commands_and_reports_start_without_torch():
    """A plain install has no torch: `smplxpp build` there, and the report that it writes, must not import it."""
    code = """
import importlib, pkgutil, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "safetensors", "threadpoolctl"):
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Missing())
import pipelines.commands, smplxpp.figures, pipelines.report, pipelines.stages.build
for package in (pipelines.commands, smplxpp.figures, pipelines.report):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr


def test_every_public_name_resolves():
    assert set(smplxpp.__all__) <= set(dir(smplxpp))
    assert all(getattr(smplxpp, name) is not None for name in smplxpp.__all__)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = smplxpp.nonsense


@pytest.mark.parametrize("name", sorted({room(module) for module in modules_of("avatar")} - {""}))
def test_rooms_of_avatar_export_names_that_resolve_and_name_no_module(name):
    exported = importlib.import_module(f"avatar.{name}")
    modules = {path.stem for path in (ROOT / "avatar" / name).iterdir()}
    assert exported.__all__
    assert not modules & set(getattr(exported, "_EXPORTS", ()))  # a module that is imported would hide the name
    assert all(getattr(exported, one) is not None for one in exported.__all__)
    assert all(getattr(avatar, one) is not None for one in avatar.__all__)
    assert not {path.name for path in (ROOT / "avatar").iterdir()} & set(avatar.__all__)


def test_every_room_is_a_stage_or_shared():
    rooms = {path.parent.name for path in (ROOT / "smplxpp").glob("*/__init__.py")} | {"data"}
    assert rooms == STAGES | SHARED | TOP


@pytest.mark.parametrize(("package", "above"), [("smplxpp", {"avatar", "pipelines"}), ("avatar", {"pipelines"})])
def test_imports_go_one_way(package, above):
    assert violations(package, above) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_do_not_import_tests_or_benchmarks(package):
    assert violations(package, {"tests", "benchmarks", "examples"}) == []


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_stages_do_not_import_each_other(stage):
    assert violations(f"smplxpp/{stage}", {f"smplxpp.{other}" for other in STAGES - {stage}}) == []


def test_nothing_of_the_package_imports_its_top_rooms():
    """The package exports their names lazily, by text."""
    for room in sorted(STAGES | SHARED - {"data"}):
        assert violations(f"smplxpp/{room}", {f"smplxpp.{top}" for top in TOP}) == []


@pytest.mark.parametrize(
    ("room", "reaches"),
    [
        ("core", set()),
        ("native", {"core"}),
        ("raster", {"core", "native"}),
        ("skinning", {"core"}),
        ("body", {"core", "skinning"}),
        ("template", {"core", "native", "raster", "skinning", "body"}),
        ("cloth", {"core", "native", "skinning", "body", "template"}),
    ],
)
def test_shared_rooms_reach_little(room, reaches):
    others = (STAGES | SHARED | TOP) - {room} - reaches - {"data"}
    assert violations(f"smplxpp/{room}", {f"smplxpp.{other}" for other in others}) == []


def imports_between_rooms(package: str) -> list[tuple[str, str, str]]:
    """Return (file, its room, room that it imports) for all imports of other rooms of a package."""
    found = []
    for module, path in modules_of(package).items():
        names = {name for name in imported_modules(path) if name.startswith(f"{package}.")}
        others = {room(name) for name in names} - {room(module)}
        found += [(str(path.relative_to(ROOT)), room(module), other) for other in sorted(others) if room(module)]
    return found


@pytest.mark.parametrize("package", FLOORS)
def test_every_room_has_a_floor(package):
    assert {room(module) for module in modules_of(package)} - {""} == set().union(*FLOORS[package])


@pytest.mark.parametrize("package", FLOORS)
def test_imports_go_down_from_floor_to_floor(package):
    floor = {name: number for number, names in enumerate(FLOORS[package]) for name in names}
    upward = [
        (path, other)
        for path, own, other in imports_between_rooms(package)
        if floor[other] >= floor[own] or other in NARROW.get(f"{package}.{own}", ())
    ]
    assert upward == []


def test_commands_are_found_in_their_room():
    assert all(module in modules_of("pipelines") for module, _, _ in COMMANDS.values())
    assert {room(module) for module, _, _ in COMMANDS.values()} == {"commands"}


def test_no_modules_import_each_other_in_a_circle():
    modules = {name: path for package in PACKAGES for name, path in modules_of(package).items()}
    graph: dict[str, set[str]] = {}
    for module, path in modules.items():
        # `from a.b import c` imports the module a.b.c where there is one, else a name of a.b.
        pairs = ((f"{base}.{name}", base) for base, name in source(path).executed)
        names = {whole if whole in modules else base for whole, base in pairs}
        graph[module] = {name for name in names if name in modules} - {module}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_torch_stays_in_the_body_room():
    for package in ("smplxpp", "pipelines"):
        found = [
            v for v in violations(package, {"torch"}) if not v.startswith(("smplxpp/body/", "pipelines/ablation/"))
        ]
        assert found == []


# What opens files of others without looking at what they ask for -> where it may stand.
DOORS: dict[str, set[str]] = {
    "np.load": set(),
    "np.memmap": set(),
    "np.fromfile": set(),
    "json.load": set(),
    "json.loads": {"smplxpp/core/files/json_file.py"},
    "pickle.load": set(),
    "pickle.loads": set(),
    "Image.open": {"smplxpp/core/files/image_file.py"},
    "zipfile.ZipFile": {
        *("smplxpp/core/files/array_file.py", "smplxpp/core/files/package_file.py"),
    },
    "safe_open": {"avatar/gaussians/tensor_file.py"},
    "load_file": set(),  # of safetensors
    "torch.load": {"avatar/losses/perceptual_weights.py"},  # weights of a metric, tensors alone
}


def test_files_are_opened_by_their_doors():
    """Sizes, depths and types of what a file holds are looked at in one place a format."""
    found: dict[str, set[str]] = {call: set() for call in DOORS}
    for package in PACKAGES:
        for path in sources(package):
            for name, _ in source(path).calls:
                words = name.split(".")
                for call in {words[-1], ".".join(words[-2:])} & DOORS.keys():
                    found[call].add(path.relative_to(ROOT).as_posix())
    assert {call: files - DOORS[call] for call, files in found.items() if files - DOORS[call]} == {}


# What reads a file whole or opens it -> where it may stand: files of others go through `smplxpp.core.files.paths`,
# which refuses pipes and devices and bounds the size.
READS: dict[str, set[str]] = {
    "read_bytes": {"smplxpp/core/files/paths.py", "pipelines/stages/build_config.py"},
    "read_text": {  # the system's, and our own sources
        *("smplxpp/native/__init__.py", "avatar/rendering/memory.py"),
        *("pipelines/report/builder.py", "pipelines/runs/code.py", "pipelines/batch/hold.py"),
    },
    "open": {
        *("smplxpp/core/files/array_file.py", "smplxpp/core/files/safe_pickle.py", "smplxpp/core/files/image_file.py"),
        *("smplxpp/core/files/package_file.py", "smplxpp/core/files/atomic.py"),
        *("smplxpp/capture/readers/colmap.py", "smplxpp/capture/readers/neus2.py", "pipelines/runs/code.py"),
        *("smplxpp/capture/writers.py", "smplxpp/core/params.py", "avatar/formats/ply.py"),  # written
        *("pipelines/batch/hold.py", "pipelines/batch/process.py"),  # a lock, logs
        *("avatar/training/engine/metrics_log.py", "pipelines/runs/folders.py", "pipelines/commands/terminal.py"),
    },
}


def test_files_are_read_where_pipes_and_sizes_are_looked_at():
    found: dict[str, set[str]] = {name: set() for name in READS}
    for package in PACKAGES:
        for path in sources(package):
            for whole, is_attribute in source(path).calls:
                name = whole.split(".")[-1]
                if name in READS and (is_attribute or name == "open"):
                    found[name].add(path.relative_to(ROOT).as_posix())
    assert {name: files - READS[name] for name, files in found.items() if files - READS[name]} == {}


def test_plain_pickle_is_never_loaded():
    unpickles = {"pickle.load", "pickle.loads", "pickle.Unpickler"}
    for package in PACKAGES:
        for path in sources(package):
            assert not {name for name, _ in source(path).calls} & unpickles, path
            assert all(source(path).allow_pickle), path


# Modules of under 60 lines with one user, and why each stands alone; all others join the module that uses them.
SMALL_WITH_A_REASON = {
    "avatar.export.posed": "needs torch, which formats does not",
    "smplxpp.capture.readers.thuman4": "one reader of a data set a file",
    "smplxpp.export.by_suffix": "keeps the writers of formats out of the light room of templates",
}
SMALL_MODULE = 60


def test_small_modules_have_a_second_user_or_a_reason():
    """A module is used by an import or by its dotted name, as in lazy exports and in the table of commands."""
    modules = {name: path for package in PACKAGES for name, path in modules_of(package).items()}
    texts = {name: path.read_text(encoding="utf-8") for name, path in modules.items()}
    small = {name for name, path in modules.items() if len(texts[name].splitlines()) < SMALL_MODULE}
    alone = []
    for name in sorted(small):
        if modules[name].name == "__init__.py":
            continue
        package, _, own = name.rpartition(".")
        users = {
            other
            for other, text in texts.items()
            if other != name and (f"{name}" in text or (f"from {package} import" in text and own in text))
        }
        if len(users) < 2:
            alone.append(name)
    assert set(alone) <= SMALL_WITH_A_REASON.keys(), "join these modules with their users, or give a reason"
    assert all(name in modules for name in SMALL_WITH_A_REASON), "reasons of modules that are gone"
