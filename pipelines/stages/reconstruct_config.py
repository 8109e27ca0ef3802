"""What a reconstruction takes, and its record in the run."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path

from pipelines.runs.artefacts import values_of
from pipelines.runs.layout import RECONSTRUCT_FILE
from pipelines.runs.manifest import require_plain_fields
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text, read_json
from smplxpp.core.files.paths import absolute

log = logging.getLogger(__name__)
_PATHS = ("capture", "masks", "mesh")


@dataclass(frozen=True)
class ReconstructInputs:
    """Where a reconstruction takes its photographs from.

    Attributes:
        capture: folder of any known layout.
        frames: numbers; None: all that are trained on.
        hold_out: cameras that are not looked at, in the place of those that the capture holds out.
        masks: folder of masks, in the place of the capture's own.
        protocol: name of the capture's files that are read, None without one.
        refine: compare the photographs; False: the silhouettes alone.
        cell_mm: of the grid; None: by the photographs' resolution.
        mesh: another program's surface of the one frame, which is taken in the place of ours.
        dissent: views that may say of a point that it is outside.
    """

    capture: Path
    frames: tuple[int, ...] | None = None
    hold_out: tuple[str, ...] = ()
    masks: Path | None = None
    protocol: str | None = None
    refine: bool = True
    cell_mm: float | None = None
    dissent: int = 0
    mesh: Path | None = None


def save_reconstruct(run: Path, inputs: ReconstructInputs) -> None:
    """Write `reconstruct.json` into a run."""
    values = {key: str(absolute(value)) if isinstance(value, Path) else value for key, value in asdict(inputs).items()}
    atomic_write_text(run / RECONSTRUCT_FILE, json.dumps(values, indent=1) + "\n")


def load_reconstruct(run: Path) -> ReconstructInputs | None:
    """What `save_reconstruct` wrote; None where there is none, or none that this version can read, which is logged."""
    path = run / RECONSTRUCT_FILE
    if not path.exists():
        return None
    try:
        values = as_object(read_json(path), subject=f"file {path}")
        with values_of(path):
            require_plain_fields(ReconstructInputs, values, subject=RECONSTRUCT_FILE)
            frames = values["frames"]
            if frames is not None:
                frames = tuple(as_integer(one, subject="frames") for one in as_list(frames, subject="frames"))
            hold_out = tuple(
                as_text(name, subject="hold_out") for name in as_list(values["hold_out"], subject="hold_out")
            )
            paths = {key: Path(values[key]) for key in _PATHS if values[key] is not None}
            return ReconstructInputs(**{**values, **paths, "frames": frames, "hold_out": hold_out})
    except InputError as error:
        log.warning("%s counts as a run without a reconstruction: %s", run, error)
        return None
