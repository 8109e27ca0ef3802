"""Digest the inputs of a stage: its code with all imports and native kernels, its files, its libraries.

Comments, docstrings and the layout of a file change no digest, and neither does code that the stage never imports.
"""

from __future__ import annotations

import ast
import hashlib
import json
import platform
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.util import cache_from_source, find_spec
from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_object, as_text, read_json
from smplxpp.core.files.paths import regular_file

PACKAGES = ("smplxpp", "avatar", "pipelines")
NATIVE = "smplxpp.native"
GEOMETRY = ("numpy", "scipy", "libigl", "fast-simplification")
"""Libraries whose versions decide the result of a geometric stage."""
TRAINING = (*GEOMETRY, "torch")
"""Libraries whose versions decide the result of a training."""
_BLOCKS = ("body", "orelse", "handlers", "finalbody", "cases")
"""Fields of the syntax tree that hold statements."""
_COMMENTS = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_EXPORT = re.compile(r"SMPLXPP_EXPORT[^;{(]*?(\w+)\(")


@dataclass(frozen=True)
class _Module:
    """Digest of a source file's statements, the modules that it imports, and the native functions that it names."""

    digest: str
    imports: tuple[str, ...]
    names: frozenset[str]


def code_of(*modules: str) -> dict[str, str]:
    """Return hex digests by name of modules, of all their imports in `PACKAGES`, and of the native folders they call.

    Imports anywhere in a file count, also those within functions, except those under `TYPE_CHECKING`.

    Raises:
        ModuleNotFoundError: no such module.
    """
    # Follow imports breadth first. A native folder counts where a module mentions one of its exported functions.
    found: dict[str, str] = {}
    kernels: set[str] = set()
    waiting = [part for module in modules for part in _with_packages(module)]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        module = _module(name)
        found[name] = module.digest
        waiting += module.imports
        kernels |= {folder for symbol, folder in _exports().items() if symbol in module.names}
    _keep_digests()
    for folder in sorted(kernels | ({"common"} if kernels else set())):
        found[f"{NATIVE}/{folder}"] = _native_digest(folder)
    return dict(sorted(found.items()))


@cache
def _module(name: str) -> _Module:
    path = _source(name)
    if path is None:
        raise ModuleNotFoundError(f"no source of module {name}")
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    text = path.read_text(encoding="utf-8")
    # What follows from this text alone is looked up by the text; which of the imported names are modules is looked up
    # each time.
    key = hashlib.sha256("\0".join([package, text, *_exports()]).encode()).hexdigest()
    known = _digests()
    if key not in known:
        known[key] = _parsed(text, package)
        _UNKEPT.append(key)
    digest, imported, names = known[key]
    found = (part for module in _modules_of(imported) for part in _with_packages(module))
    return _Module(digest, tuple(dict.fromkeys(found)), frozenset(names))


_Parsed = tuple[str, list[tuple[str, list[str]]], list[str]]
"""Digest of a text, its imports (module, names taken from it), and the native functions that it names."""
_UNKEPT: list[str] = []
"""Keys of `_digests` that the file does not have."""


def _parsed(text: str, package: str) -> _Parsed:
    tree = ast.parse(text)
    imported = list(_imported(tree, package))
    # Write the tree out once and look for names in the text, because a walk over all nodes costs as much again.
    _drop_strings(tree)
    dumped = ast.dump(tree, annotate_fields=False)
    names = [symbol for symbol in _exports() if f", '{symbol}', Load())" in dumped]
    return hashlib.sha256(dumped.encode()).hexdigest()[:16], imported, names


def _digests_file() -> Path:
    """Return the file beside this module's bytecode that spares each process two seconds of parsing all sources."""
    return Path(cache_from_source(__file__)).with_suffix(".json")


@cache
def _digests() -> dict[str, _Parsed]:
    """Return what is known of texts by their key; empty where no process has kept it yet, or the file is damaged."""
    try:
        content = as_object(read_json(_digests_file()), subject="digests")
        return {
            key: (as_text(digest, subject=key), [(base, list(names)) for base, names in pairs], list(symbols))
            for key, (digest, pairs, symbols) in content.items()
        }
    except (InputError, TypeError, ValueError):
        return {}


def _keep_digests() -> None:
    """Write what is known of the texts that this process has met, so that the file does not grow with each edit."""
    if not _UNKEPT or sys.dont_write_bytecode:
        return
    _UNKEPT.clear()
    with suppress(OSError, InputError):  # installed in a folder without write access
        _digests_file().parent.mkdir(exist_ok=True)
        atomic_write_text(_digests_file(), json.dumps(_digests(), separators=(",", ":")))


def _drop_strings(tree: ast.Module) -> None:
    """Drop string statements, which include docstrings, because they do nothing."""
    for node in _statements(tree):
        for field in _BLOCKS:
            block = getattr(node, field, None)
            if isinstance(block, list):
                block[:] = [one for one in block if not _is_string(one)]


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _imported(tree: ast.Module, package: str) -> Iterable[tuple[str, list[str]]]:
    """Yield the modules of `PACKAGES` that a file imports, with the names that it takes from them."""
    for node in _statements(tree, executed=True):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names if alias.name.split(".")[0] in PACKAGES)
        elif isinstance(node, ast.ImportFrom):
            parent = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parent, *([node.module] if node.module else [])])
            if base.split(".")[0] in PACKAGES:
                yield base, [alias.name for alias in node.names]


def _modules_of(imported: Iterable[tuple[str, list[str]]]) -> Iterable[str]:
    """Yield the modules of imports, and those of the names that are modules themselves."""
    for base, names in imported:
        yield base
        yield from (f"{base}.{name}" for name in names if _source(f"{base}.{name}") is not None)


def _statements(tree: ast.Module, *, executed: bool = False) -> Iterable[ast.AST]:
    """Yield a module and all statements in it, or only those that are executed: not those under `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        skipped = executed and isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for field in ("orelse",) if skipped else _BLOCKS:
            waiting += getattr(node, field, ())


def _with_packages(module: str) -> list[str]:
    """Return a module's packages and the module, because importing it runs the packages first."""
    parts = module.split(".")
    return [".".join(parts[: k + 1]) for k in range(len(parts))]


@cache
def _source(module: str) -> Path | None:
    """Return the file of a module of `PACKAGES` without importing more than its top package."""
    top, *rest = module.split(".")
    base = _root(top).joinpath(*rest)
    candidates = (base / "__init__.py", base.with_suffix(".py")) if rest else (base / "__init__.py",)
    return next((path for path in candidates if path.is_file()), None)


@cache
def _root(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"no package {package}")
    return Path(spec.origin).parent


@cache
def _exports() -> dict[str, str]:
    """Return the folder of the native sources by the name of each exported function."""
    root = _root("smplxpp") / "native"
    return {
        name: path.parent.name
        for path in sorted(root.glob("*/*.cpp"))
        for name in _EXPORT.findall(path.read_text(encoding="utf-8"))
    }


@cache
def _native_digest(folder: str) -> str:
    """Return the digest of a folder of native sources without comments and white space."""
    digest = hashlib.sha256()
    root = _root("smplxpp") / "native" / folder
    for path in sorted([*root.glob("*.cpp"), *root.glob("*.hpp")]):
        digest.update(path.name.encode())
        digest.update("".join(_COMMENTS.sub("", path.read_text(encoding="utf-8")).split()).encode())
    return digest.hexdigest()[:16]


def sha256_file(path: str | Path) -> str:
    """Return the hex SHA-256 of a regular file's content.

    Raises:
        InputError: the file is missing, not a regular file, or unreadable.
    """
    try:
        with open(regular_file(path), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"file {path}", expected="a readable file", received=error.strerror or str(error)) from None


def versions(libraries: Iterable[str] = GEOMETRY) -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute the result."""
    return {"python": platform.python_version(), **{name: _version(name) for name in libraries}}


@cache  # because every stage asks, and reads the metadata of five packages
def _version(library: str) -> str:
    return version(library)
