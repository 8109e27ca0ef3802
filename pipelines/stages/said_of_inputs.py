"""What a run's inputs are by the declarations of its capture and by the stages that made them."""

from __future__ import annotations

from pathlib import Path

from avatar.evaluation.input_protocol import EXACT, MIXED, NOT_KNOWN, TRACKED
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import BuildInputs
from pipelines.stages.register_config import load_register
from pipelines.stages.segment import label_source
from smplxpp.capture import Capture
from smplxpp.capture.declared import LABEL_WORDS, DeclaredInputs
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import lies_in, same_place

MADE_BY = {REGISTERED_PARAMS: "registered", REFINED_PARAMS: "refined"}
"""Parameters that a run makes, and by what."""


class SaidOfInputs(DeclaredInputs):
    """The declarations of a capture, and what follows from them for the inputs of a run that reads it."""

    def parameters(self, run: Path, path: Path | None) -> tuple[str, str]:
        """Return the word for parameters in a file or folder, and the stage of the run that made them ("": none)."""
        for file, stage in MADE_BY.items():
            if path is not None and same_place(path, run / file):
                return self._made_from(run), stage
        return self.given_parameters(path), ""

    def labels(self, build: BuildInputs) -> str:
        """The word for the labels that a template was built with; what the body told is an estimate."""
        sources = list(build.label_maps.values()) or [build.labels or build.scan]
        if (build.reconstructs or all(path.exists() for path in sources)) and _told_by_body(build):
            return LABEL_WORDS[TRACKED]
        if not all(path.exists() and lies_in(path, self.root) for path in sources):
            return NOT_KNOWN
        if build.label_maps:
            return self.of_views("labels", next(iter(build.label_maps.values())).parent.parent.name)
        word = self._word("labels", "labels", "labels")
        return "true" if word == NOT_KNOWN and any(one.scan_labels for one in self._named(EXACT)) else word

    def _made_from(self, run: Path) -> str:
        """The word for parameters that a run made, by what they began with: keypoints alone, or a fit."""
        began = self.own_parameters()
        registration = load_register(run)
        if registration is not None:
            began = (registration.params or began) if registration.start else None
        else:
            given = (read_manifest(run / REFINE_STAGE) or {}).get("numbers", {}).get("given")
            began = began if given is None else self.root / "params" / str(given).partition(" ")[0]
        if began is None:
            return TRACKED
        word = self.given_parameters(began)
        return MIXED if word == EXACT else word


def folder_of_maps(capture: Capture, kind: str) -> str | None:
    """Name of the folder with the maps of a kind."""
    series = next(iter(capture.recording.files.get(kind, {}).values()), None)
    return None if series is None else series.folder.parent.name


def _told_by_body(build: BuildInputs) -> bool:
    """Whether the body in the scan told its labels; a scan that cannot be read any more does not say it."""
    try:
        return label_source(build) == "body"
    except InputError:
        return False
