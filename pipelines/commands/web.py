"""`smplxpp web`: a page that plays a trained student: a folder for any host, one file from disk, a server."""

from __future__ import annotations

import tempfile
import webbrowser
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from pipelines.commands.options import (
    LARGEST_PORT,
    MOST_AVATAR_BYTES,
    Exposure,
    Lighting,
    OptionalFloat,
    OptionalPath,
    OptionalText,
)
from pipelines.commands.templates import BUNDLE_SUFFIX, export_bundle
from smplxpp.core import InputError, require_between
from smplxpp.core.files import atomic_write_bytes, read_bytes

if TYPE_CHECKING:
    from avatar.runtime import AvatarBundle
    from pipelines.web.page import PageLight

PAGES = (".html", ".htm")
"""Suffixes of a page in one file."""


def live_lips(bundle: AvatarBundle) -> bytes | None:
    """Return what moves mouth and hands of a speaker in a page; None for a face whose mouth cannot speak."""
    from avatar.driving import person_of_bundle, stance_of
    from avatar.runtime.skeleton import skeleton_body
    from pipelines.web.page import lips_of

    try:
        face, body = person_of_bundle(bundle)
        return lips_of(face, stance_of(face, body, skeleton_body(bundle)))
    except InputError:
        return None


@dataclass(frozen=True)
class Web:
    """Options of `smplxpp web`."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|BUNDLE")]
    """Folder that `smplxpp train` wrote, or a file that `smplxpp export RUN --out NAME.avatar` wrote."""
    out: OptionalPath = None
    """Write a folder there that any static host serves."""
    single_file: OptionalPath = None
    """Write one HTML file there, with player and avatar in it, that opens from disk."""
    serve: bool = False
    """Serve the page to browsers until Ctrl-C."""
    port: int = 8090
    """Port to serve at; the next free one where it is taken."""
    exposure: Annotated[Exposure, tyro.conf.arg(name="")] = field(default_factory=Exposure)
    """Who may ask the server."""
    no_browser: bool = False
    """Open no browser, print the address alone."""
    params: OptionalPath = None
    """Motion of a run's avatar, any layout that `smplxpp params convert` reads; without it what training saw."""
    fps: OptionalFloat = None
    """Frames a second of --params, for a file that states none or a wrong rate (default: as it says)."""
    name: OptionalText = None
    """Name of a run's avatar; by default that of the run's folder."""
    licence: str = ""
    """Licence of a run's avatar, as the page is to say it."""
    lighting: Annotated[Lighting, tyro.conf.arg(name="")] = field(default_factory=Lighting)
    """The light that the page begins with."""
    json: bool = False
    """Print what was written as JSON."""

    def run(self) -> dict[str, Any]:
        """Write what was asked for, each file whole or not at all; then serve."""
        self._check()
        light = self._light()
        bundle, name, lips = self._bundle()
        from pipelines.web.page import PageContent, page_files, single_page, write_page_folder

        # The same content serves folder, single file and server.
        content = PageContent(name=name, light=light, lips=lips)
        console = Console(stderr=self.json)
        written: dict[str, int] = {}
        if self.out is not None:
            written |= {str(path): path.stat().st_size for path in write_page_folder(self.out, bundle, content)}
        if self.single_file is not None:
            page = single_page(bundle, content)
            atomic_write_bytes(self.single_file, page)
            written[str(self.single_file)] = len(page)
        for path, size in written.items():
            console.print(f"{path}: {size / 1e6:.2f} MB", markup=False, soft_wrap=True)
        if self.serve:
            self._serve(page_files(bundle, content), console)
        return {"written": written, "bundle_bytes": len(bundle)}

    def _check(self) -> None:
        require_between("option port", self.port, 1, LARGEST_PORT)
        self.exposure.access()
        # Check outputs before the bundle is made, which takes seconds.
        if self.out is None and self.single_file is None and not self.serve:
            raise InputError(
                "options out, single-file and serve",
                expected="one of them at least",
                received="none",
                remedy="`--single-file player.html` writes a page that opens from disk",
            )
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise InputError(f"output {self.out}", expected="a folder, or nothing yet", received="a file")
        if self.single_file is not None and self.single_file.suffix.lower() not in PAGES:
            raise InputError(
                f"output {self.single_file}",
                expected="a name that ends with .html",
                received=self.single_file.suffix or "no suffix",
            )

    def _light(self) -> PageLight | None:
        """The light that the page begins with; turned there, not here."""
        from pipelines.web.page import PageLight

        asked = self.lighting
        relighting = (asked if asked.environment is None else replace(asked, environment_turn=0.0)).relighting()
        if relighting is None or asked.environment is None:
            return None
        return PageLight(asked.environment.stem, relighting, asked.environment_turn)

    def _bundle(self) -> tuple[bytes, str, bytes | None]:
        """The bytes of the bundle, one that can be opened, the avatar's name, and how its lips move."""
        from avatar.runtime import load_bundle

        # A run is bundled first, into a temporary folder; a bundle is taken as it is.
        if self.source.is_dir():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"me{BUNDLE_SUFFIX}"
                export_bundle(
                    self.source,
                    path,
                    name=self.name,
                    licence=self.licence,
                    params=self.params,
                    exact=False,
                    fps=self.fps,
                )
                name = self.name or self.source.resolve().name
                return read_bytes(path, subject="avatar"), name, live_lips(load_bundle(path))
        # Name and licence are part of a finished bundle.
        given = [option for option in ("params", "fps", "name", "licence") if getattr(self, option)]
        if given:
            raise InputError(
                f"option {given[0]}",
                expected="a run",
                received=f"{self.source}, which says it already",
                remedy=f"give it to `smplxpp export RUN --out NAME{BUNDLE_SUFFIX}`",
            )
        data = read_bytes(self.source, subject="avatar", most=MOST_AVATAR_BYTES)
        bundle = load_bundle(self.source)
        return data, bundle.about.name, live_lips(bundle)

    def _serve(self, files: dict[str, bytes], console: Console) -> None:
        from pipelines.web.server import PageServer

        with PageServer(files, port=self.port, access=self.exposure.access()) as server:
            console.print(f"{server.address}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
            if not self.no_browser:
                webbrowser.open_new_tab(server.address)
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                pass
