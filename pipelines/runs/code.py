"""Digest the inputs of a stage: its code with all imports and native kernels, its files, its libraries.

Comments, docstrings and the layout of a file change no digest, and neither does code that the stage never imports.
"""

from __future__ import annotations

import ast
import hashlib
import platform
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from smplxpp.core.errors import InputError
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
    for folder in sorted(kernels | ({"common"} if kernels else set())):
        found[f"{NATIVE}/{folder}"] = _native_digest(folder)
    return dict(sorted(found.items()))


@cache
def _module(name: str) -> _Module:
    path = _source(name)
    if path is None:
        raise ModuleNotFoundError(f"no source of module {name}")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    imports = dict.fromkeys(part for module in _imported(tree, package) for part in _with_packages(module))
    # Write the tree out once and look for names in the text, because a walk over all nodes costs as much again.
    _drop_strings(tree)
    text = ast.dump(tree, annotate_fields=False)
    names = frozenset(symbol for symbol in _exports() if f", '{symbol}', Load())" in text)
    return _Module(hashlib.sha256(text.encode()).hexdigest()[:16], tuple(imports), names)


def _drop_strings(tree: ast.Module) -> None:
    """Drop string statements, which include docstrings, because they do nothing."""
    for node in _statements(tree):
        for field in _BLOCKS:
            block = getattr(node, field, None)
            if isinstance(block, list):
                block[:] = [one for one in block if not _is_string(one)]


def _is_string(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _imported(tree: ast.Module, package: str) -> Iterable[str]:
    """Yield the modules of `PACKAGES` that a file imports."""
    for node in _statements(tree, executed=True):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] in PACKAGES)
        elif isinstance(node, ast.ImportFrom):
            parent = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parent, *([node.module] if node.module else [])])
            if base.split(".")[0] in PACKAGES:
                yield base
                yield from (f"{base}.{a.name}" for a in node.names if _source(f"{base}.{a.name}") is not None)


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
    return {"python": platform.python_version(), **{name: version(name) for name in libraries}}
