"""Check template and recipe before a training starts, and log once what the losses leave out."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from avatar.training.loose_clothes import loose_names, why_none
from avatar.training.recipe import Recipe
from avatar.training.scene import TrainScene, normal_maps
from smplxpp.capture import Capture
from smplxpp.core import InputError, require_known

log = logging.getLogger(__name__)


def check_training(scene: TrainScene, recipe: Recipe, steps: Sequence[str], *, pose_known: bool) -> None:
    """Refuse what a template cannot have before any work is done, and warn of loose clothes that cannot be simulated.

    Args:
        scene: what is trained on.
        recipe: what is trained.
        steps: names of the steps, of `STEPS`.
        pose_known: whether the pose of the scan that the template was built from is known.

    Raises:
        InputError: blend shapes for a body without expressions, or names of parts that the template does not have.
    """
    if "compensate" in steps and not scene.template.body.num_expressions:
        raise InputError(
            "template",
            expected="a body with expressions, which drive the head's blend shapes",
            received="none",
            remedy="build the template on the open body or on SMPL-X, or stop with --until bake",
        )
    if recipe.cloth is None:
        return
    # Wrong names are refused now; parts that cannot be simulated only cost a warning.
    if "cloth" in steps and recipe.cloth.parts:
        require_known("loose parts", recipe.cloth.parts, loose_names(scene.template))
    if recipe.follows and {"teacher", "cloth"} & set(steps):
        why = why_none(scene.template, recipe.cloth, pose_known=pose_known, followed=True, fps=scene.capture.fps)
        if why is not None:
            log.warning("loose clothes: %s", why)


def note_missing_normals(capture: Capture, recipe: Recipe, steps: Sequence[str]) -> None:
    """Log once where the loss has no normal term although the recipe asks for one."""
    # Compare the number of training views with a normal map with that of all training views.
    trainings = [getattr(recipe.preset, name) for name in ("teacher", "bake", "compensate") if name in steps]
    there, views = normal_maps(capture)
    if there == views or not any(training.weights.normal for training in trainings):
        return
    if there:
        log.info("%d of %d training views have a normal map: the loss has no normal term in the others", there, views)
    elif recipe.follows and any(training.surface_normals for training in trainings):
        log.info("capture %s has no normal maps: those of followed clothes stand for them", capture.name)
    else:
        log.info("capture %s has no normal maps: the loss has no normal term", capture.name)
