"""`smplxpp label`: the live viewer, in which labels and landmarks of a run's scan are corrected by hand."""

from __future__ import annotations

import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from pipelines.commands.options import LARGEST_PORT
from smplxpp.core.validation import require_between

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
    """Address to listen at. 0.0.0.0 lets every machine of the network in, without a password."""
    no_browser: bool = False
    """Open no browser, print the address alone."""
    json: bool = False
    """Print what was written at the end as JSON; the address goes to the log."""

    def run(self) -> dict:
        """Serve the window until Ctrl-C, then write what was not saved."""
        from pipelines.viewer.run_scan import open_session
        from pipelines.viewer.window import open_window

        require_between("option port", self.port, 1, LARGEST_PORT)
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
            console.print(f"written, as it was not saved: {', '.join(written)}", highlight=False)
        return {"run": str(self.run_folder), "written": written}


def wait() -> None:
    """Wait for Ctrl-C."""
    while True:
        time.sleep(3600)


def leave(window: LabelWindow) -> list[str]:
    """End a window; returns the names of files that were written because something was not saved."""
    with window.lock:
        written = window.session.save(window.run) if window.session.changed else []
    window.close()
    return written
