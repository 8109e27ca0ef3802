"""`smplxpp view` and `smplxpp label`: windows on a run in the browser, to look at it or to correct its labels."""

from __future__ import annotations

import time
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from pipelines.commands.options import LARGEST_PORT, Lighting, OptionalFloat, OptionalPath, require_avatar
from pipelines.commands.templates import load_run_template
from smplxpp.core.errors import require_between

if TYPE_CHECKING:
    from pipelines.viewer.window import LabelWindow


@dataclass(frozen=True)
class Label:
    """Options of `smplxpp label`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote, or began."""
    port: int = 8080
    """Port to listen at; the next free one where it is taken."""
    host: str = "127.0.0.1"
    """Address to listen at. 0.0.0.0 lets every machine of the network in that has the token of the printed address."""
    no_browser: bool = False
    """Open no browser, print the address alone."""
    json: bool = False
    """Print what was written at the end as JSON; the address goes to the log."""

    def run(self) -> dict:
        """Serve the window until Ctrl-C, then write unsaved changes."""
        from pipelines.viewer.run_scene import open_session
        from pipelines.viewer.window import open_window

        require_between("option port", self.port, 1, LARGEST_PORT)
        # Unsaved corrections are written on Ctrl-C too, since they are manual work.
        window = open_window(open_session(self.run_folder), self.run_folder, host=self.host, port=self.port)
        console = Console(stderr=self.json)
        console.print(f"{window.address}  (Ctrl-C ends it)", highlight=False)
        try:
            if not self.no_browser:
                webbrowser.open_new_tab(window.address)
            wait()
        except KeyboardInterrupt:
            pass
        finally:
            written = leave(window)
        if written:
            console.print(f"written, because it was not saved: {', '.join(written)}", highlight=False)
        return {"run": str(self.run_folder), "written": written}


def wait() -> None:
    """Wait until Ctrl-C is pressed."""
    while True:
        time.sleep(3600)


def leave(window: LabelWindow) -> list[str]:
    """Close a window after saving; return the names of the files that had unsaved changes."""
    with window.lock:
        written = window.session.save(window.run) if window.session.changed else []
    window.close()
    return written


@dataclass(frozen=True)
class View:
    """Options of `smplxpp view`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote; a training in it may be running."""
    capture: OptionalPath = None
    """Capture whose photographs and frames are shown; by default the one that the run was made from."""
    params: OptionalPath = None
    """Motion to go through, in any layout that `smplxpp params convert` reads; by default the capture's frames."""
    fps: OptionalFloat = None
    """Frames a second of --params, for a file that states none or a wrong rate (default: as it says)."""
    lighting: Annotated[Lighting, tyro.conf.arg(name="")] = field(default_factory=Lighting)
    """The light that the Gaussians are shown in."""
    port: int = 8080
    """Port to listen at, on this machine alone; the next free one where it is taken."""
    no_browser: bool = False
    """Open no browser, print the address alone."""
    json: bool = False
    """Print what was shown at the end as JSON; the address goes to the log."""

    def run(self) -> dict:
        """Serve the window until Ctrl-C."""
        from pipelines.viewer.run_session import open_run
        from pipelines.viewer.run_window import open_run_window

        require_between("option port", self.port, 1, LARGEST_PORT)
        require_avatar("the viewer of a run")
        # Parameters and light are read before the window opens, so that errors appear in the terminal.
        template = load_run_template(self.run_folder)
        session = open_run(
            self.run_folder,
            template,
            capture=self.capture,
            params=self.params,
            fps=self.fps,
            relighting=self.lighting.relighting(),
        )
        window = open_run_window(session, port=self.port)
        Console(stderr=self.json).print(f"{window.address}  (Ctrl-C ends it)", highlight=False)
        try:
            if not self.no_browser:
                webbrowser.open_new_tab(window.address)
            wait()
        except KeyboardInterrupt:
            pass
        finally:
            window.close()
        return {
            "run": str(self.run_folder),
            "frames": len(session.motion.numbers),
            "gaussians": None if session.source is None else session.source.words,
        }
