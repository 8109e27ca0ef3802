"""The pages name what there is: modules and names in code, relative links, and headings that links point at."""

from __future__ import annotations

import ast
import importlib
import re
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("*.md"), *ROOT.glob(".github/*.md")])
PACKAGES = "smplxpp|avatar|pipelines|tools|benchmarks"
DOTTED = re.compile(rf"(?<![\w./-])(?:{PACKAGES})(?:\.[A-Za-z_]\w*)+(?![\w/])")
FILES = {".csv", ".gif", ".glb", ".gz", ".json", ".md", ".mp4", ".npy", ".npz", ".obj", ".ply", ".py", ".safetensors"}
HISTORY = "CHANGELOG.md"  # names what was, too


def code_of(text: str) -> Iterator[str]:
    """Fenced blocks, indented blocks and what stands between backticks."""
    yield from re.findall(r"^```.*?^```", text, re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    yield from re.findall(r"^ {4}.*$", prose, re.MULTILINE)
    yield from re.findall(r"`([^`]+)`", prose)


def dotted_names(page: Path) -> set[str]:
    """Names below our packages that a page's code has, files left out."""
    names = {name for code in code_of(page.read_text()) for name in DOTTED.findall(code)}
    return {name for name in names if Path(name).suffix not in FILES}


def imported_names(page: Path) -> Iterator[str]:
    """What the Python examples of a page import from our packages, as dotted names."""
    for block in re.findall(r"^ *```python\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(textwrap.dedent(block))):
            if isinstance(node, ast.ImportFrom) and re.fullmatch(rf"(?:{PACKAGES})(\..+)?", node.module or ""):
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or what one holds: a function, a class, a method, a field."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        module = ".".join(parts[:count])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name is None or not (module == error.name or module.startswith(error.name + ".")):
                raise
            continue
        for part in parts[count:]:
            if part in getattr(found, "__dataclass_fields__", ()):
                return True
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def anchors(page: Path) -> set[str]:
    """The headings of a page as GitHub makes link targets of them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != HISTORY], ids=lambda page: page.name)
def test_every_name_of_ours_exists(page):
    missing = sorted(name for name in {*dotted_names(page), *imported_names(page)} if not exists(name))
    assert not missing, f"{page.name} names what is not there: {', '.join(missing)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere(page):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(target)
    assert not broken, f"{page.name} has links that lead nowhere: {', '.join(broken)}"


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != HISTORY], ids=lambda page: page.name)
def test_every_page_and_file_in_backticks_exists(page):
    """`docs/training.md`, `tests/test_import.py`, `benchmarks/results/networks.json`: paths from the root."""
    paths = {
        name.rstrip("/")
        for code in re.findall(r"`([^`\n]+)`", page.read_text())
        for name in re.findall(r"^(?:docs|tests|benchmarks|examples|tools|smplxpp|avatar|pipelines)/[\w./-]+$", code)
    }
    # NAME and the like stand for a name that the reader chooses.
    missing = sorted(path for path in paths if not re.search(r"\b[A-Z]{4,}\b", path) and not (ROOT / path).exists())
    assert not missing, f"{page.name} names files that are not there: {', '.join(missing)}"


def test_messages_of_the_troubleshooting_page_are_those_of_the_code():
    """Parts between "..." and words that stand for names occur in the sources, strings that are cut in two joined."""
    sources = (
        " ".join(path.read_text().split())
        for package in ("smplxpp", "avatar", "pipelines")
        for path in (ROOT / package).rglob("*.py")
    )
    code = re.sub(r'"\s+f?"', "", " ".join(sources))
    rows = (ROOT / "docs" / "troubleshooting.md").read_text().split("## By message")[1].splitlines()
    messages = [one for row in rows if row.startswith("| `") for one in re.findall(r"`([^`]+)`", row.split("|")[1])]
    parts = {
        part.strip(" :")
        for one in messages
        for part in re.split(r"\.\.\.|\b[A-Z]{4,}\b|\b\d[\d.]*|\bto\b|expected ", one)
    }
    assert len(messages) > 15
    assert not [part for part in parts if part not in code]


def test_the_checks_find_what_is_wrong(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("See `smplxpp.no_such_room`, `avatar.gaussians.binding` and `RUN/smplxpp.npz`.\n")
    assert dotted_names(page) == {"smplxpp.no_such_room", "avatar.gaussians.binding"}
    assert not exists("smplxpp.no_such_room") and not exists("avatar.gaussians.binding.nothing")
    assert exists("avatar.gaussians.binding.BoundGaussians.face_index")


def test_the_version_is_the_same_in_every_file():
    """The package, the citation and the newest section of the changelog belong to one release."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    released = [
        name for name in re.findall(r"^## (.+)$", (ROOT / HISTORY).read_text(), re.MULTILINE) if name != "Unreleased"
    ]
    assert (cited[1], released[0]) == (project, project)


def test_locks_hold_the_pinned_versions_with_hashes():
    """What `make` installs is what was tested, by digest; torch, of which each index has builds of its own, apart."""
    pinned = dict(re.findall(r"(?m)^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text()))
    locked: dict[str, set[str]] = {}
    for path in sorted((ROOT / "locks").glob("*.lock")):
        text = path.read_text()
        entries = re.split(r"(?m)^(?=[a-z])", text)[1:]
        assert entries and all(re.search(r"--hash=sha256:[0-9a-f]{64}\b", entry) for entry in entries)
        assert "://" not in text  # no registry of its own
        for name, version in (re.match(r"([\w.-]+)==(\S+)", entry).groups() for entry in entries):
            locked.setdefault(name, set()).add(version)
    without = {"torch", "uv"}
    for name in pinned.keys() - without:
        assert locked[name.lower()] == {pinned[name]}, name
    assert not {"torch", "triton"} & locked.keys()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [one for group in project["dependency-groups"].values() for one in group]
    wanted += project["project"]["dependencies"]
    assert {re.match(r"[\w-]+", one)[0].lower() for one in wanted} <= locked.keys()
