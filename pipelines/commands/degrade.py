"""`smplxpp capture degrade`: a capture as trackers give it, from one whose inputs are exact."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

from pipelines.commands.options import OptionalPath


@dataclass(frozen=True)
class CaptureDegradeCommand:
    """Options of the command."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of a capture in our layout whose parameters and label maps are exact."""
    out: Path
    """New folder to write."""
    seed: int = 0
    """Seed of all errors."""
    copy: bool = False
    """Copy the old capture's files; by default they are linked."""
    rig: int = 0
    """Cameras of a synthetic ring for the keypoints, where the capture has no cameras."""
    size: int = 640
    """Height in pixels of the ring's images."""
    body: OptionalPath = None
    """Body model file of the parameters; the open body by default."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Make the capture; returns what was made."""
        from pipelines.synth.degrade import DegradeConfig, degrade_capture
        from smplxpp.body import load_body

        config = DegradeConfig(seed=self.seed, copy=self.copy, rig=self.rig, size=self.size)
        body = None if self.body is None else load_body(self.body)
        made = degrade_capture(self.capture, self.out, config, body=body)
        if not self.json:
            console = Console()
            for words in made.left_out:
                console.print(f"[yellow]left out[/]  {escape(words)}", soft_wrap=True, highlight=False)
            labels = f"{100 * made.labels_wrong:.1f} % of the labels wrong"
            line = f"{made.out}: {made.frames} frames, keypoints of {made.cameras} cameras, {labels}"
            console.print(line, soft_wrap=True, highlight=False)
        return {**vars(made), "out": str(made.out)}
