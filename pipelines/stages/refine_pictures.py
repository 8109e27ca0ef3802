"""Pictures of a refinement: photograph, the start, what came out, and the error that is left."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.data.sequence import AvatarSequence
from avatar.data.views import read_view
from avatar.metrics.view_quality import eight_bit
from avatar.models.student import Student, StudentConfig
from avatar.rendering.avatar_view import render_view
from avatar.rig.posed import at_rest
from avatar.training.refinement.refine import Refinement
from pipelines.figures.comparison import write_tiles

SHOWN_FRAMES = 4
"""The frames with the largest loss after refinement."""


def write_pictures(folder: Path, sequence: AvatarSequence, found: Refinement) -> list[dict[str, str]]:
    """Write `pictures/CAM_FFFFFF.png` of the worst frames, seen by the camera that sees most of the person.

    Returns:
        File and title of each, the worst first.
    """
    avatar = Student(StudentConfig(field=None), sequence.rig, found.gaussians.to(device=sequence.device), ())
    out = []
    for row in np.argsort(-found.after, kind="stable")[:SHOWN_FRAMES]:
        frame = found.frames[row]
        names = [name for name in sequence.train_cameras if sequence.capture.file(name, frame) is not None]
        views = [read_view(sequence.capture, name, frame) for name in names]
        view = max(views, key=lambda one: np.count_nonzero(one.alpha.numpy()))
        rendered = []
        for params in (found.start, found.params):
            with at_rest(avatar):
                posed = avatar(sequence.rig.pose(params.frame(int(row))), view.position[None])
                rendered.append(eight_bit(render_view(posed, 0, view, sequence.background).image).numpy())
        file = f"pictures/{view.name}_{frame:06d}.png"
        write_tiles(folder / file, view.photograph(sequence.background.tolist()), rendered)
        out.append({"file": file, "title": f"frame {frame}, {view.name}"})
    return out
