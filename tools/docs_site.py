"""Prepare the documentation for MkDocs: the README as start page, files that pages link to, an API reference.

`mkdocs.yml` names this file as a hook. The pages of `docs/` also read well without the site, so their links are those
of the repository; here they become links within the site.
"""

from __future__ import annotations

import importlib
import inspect
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from griffe import Extension, Object
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {
    "smplxpp": (
        "core body capture build segment clean transfer skinning template export metrics register reconstruct "
        "cloth raster detect people synth footage figures"
    ).split(),
    "avatar": (
        "data gaussians rendering losses models training evaluation metrics runtime driving speech conversation "
        "export formats"
    ).split(),
}
"""Packages and their rooms in the order of the reference; a room's public names are its `__all__`."""
PAGES = {"index.md": "README.md", "contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
"""Pages of the site that lie outside `docs/`, by the file that each comes from."""
SOURCES = "source"  # folder of the site that holds copies of other files of the repository
_LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?(\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages from outside `docs/`, the API reference, and every file of the repository that a page links to."""
    for name, source in PAGES.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for name, text in api_pages():
        files.append(File.generated(config, name, content=text))
    linked = {target for page in files.documentation_pages() for target in outside_targets(page)}
    for target in sorted(linked):
        files.append(File.generated(config, f"{SOURCES}/{target}", abs_src_path=str(ROOT / target)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page's text with the repository's links turned into the site's."""
    folder = posixpath.dirname(page.file.src_uri)

    def moved(match: re.Match[str]) -> str:
        opened, target, anchor, closed = match.groups(default="")
        place = site_place(repository_path(page.file, target))
        return opened + posixpath.relpath(place, folder or ".") + anchor + closed

    return _LINK.sub(moved, markdown)


def outside_targets(file: File) -> Iterator[str]:
    """Yield the files of the repository to which a page links and which are no page or picture of the site."""
    for match in _LINK.finditer(file.content_string):
        path = repository_path(file, match[2])
        if site_place(path).startswith(SOURCES + "/") and (ROOT / path).is_file():
            yield path


def repository_path(file: File, target: str) -> str:
    """Return the path in the repository of what a page links to."""
    source = PAGES.get(file.src_uri, f"docs/{file.src_uri}")
    return posixpath.normpath(posixpath.join(posixpath.dirname(source), target))


def site_place(path: str) -> str:
    """Return the place in the site of a file of the repository."""
    for name, source in PAGES.items():
        if path == source:
            return name
    return path.removeprefix("docs/") if path.startswith("docs/") else f"{SOURCES}/{path}"


def api_pages() -> Iterator[tuple[str, str]]:
    """Yield name and text of the reference's pages: the rooms of each package, then the package itself.

    A name's text stands once, in the first room that exports it; other pages link to it.
    """
    known: set[str] = set()
    for package, rooms in ROOMS.items():
        for name in (*(f"{package}.{room}" for room in rooms), package):
            yield f"api/{name}.md", api_page(name, known)


def api_page(name: str, known: set[str]) -> str:
    """Return the page of a package: its docstring, its public names in a table, and the text of those that are new."""
    module = importlib.import_module(name)
    # An indented block becomes code where a blank line precedes it.
    lines = [f"# `{name}`", "", (inspect.getdoc(module) or "").replace("Example:\n", "\n"), ""]
    rows, texts = ["| name | |", "|---|---|"], []
    for public in module.__all__:
        value: Any = getattr(module, public)
        if inspect.ismodule(value):
            rows.append(f"| [`{public}`]({value.__name__}.md) | {first_line(value)} |")
        elif inspect.isclass(value) or inspect.isfunction(value):
            place = f"{value.__module__}.{value.__qualname__}"
            rows.append(f"| [`{public}`][{place}] | {first_line(value)} |")
            if place not in known:
                texts += [f"::: {place}", ""]
            known.add(place)
        else:
            rows.append(f"| `{public}` | `{short(value)}` |")
    return "\n".join([*lines, *rows, "", *texts])


def first_line(value: object) -> str:
    """Return the first sentence of a docstring, on one line."""
    return " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split()).replace("|", "\\|")


def short(value: object) -> str:
    """Return what a constant is, in at most 100 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the reference to the navigation, and let the docstrings of this checkout be read."""
    os.chdir(ROOT)
    assert config.nav is not None
    for package, rooms in ROOMS.items():
        pages = [f"api/{package}.md", *(f"api/{package}.{room}.md" for room in rooms)]
        config.nav.append({f"API: {package}": pages})
    return config


class ExamplesSection(Extension):
    """Let the sections `Example:` of docstrings be read as code; only `Examples:` is, in Google's style."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rename the section in one docstring."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"(?m)^( *)Example:$", r"\1Examples:", obj.docstring.value)
