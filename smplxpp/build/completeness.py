"""Check that scan, body and labels are of one whole person: missing parts, missing labels, mirror images."""

from __future__ import annotations

from typing import Any

import numpy as np

from smplxpp.build.config import BuildInputs
from smplxpp.build.limits import (
    ENDS_UNCOVERED,
    MIRRORED,
    MIRRORED_VIEWS,
    REGION_UNCOVERED,
    SKIN_PATCH,
    UNCOVERED,
    UNEXPLAINED,
)
from smplxpp.capture.cameras import read_lenses
from smplxpp.capture.views import ViewReader
from smplxpp.capture.window import Window
from smplxpp.core import BACKGROUND, SKIN, BodyParams, Camera, Check, InputError, TriangleMesh
from smplxpp.metrics import DirectedDistances, mirror_ratio, mirrored_by_views, point_to_surface
from smplxpp.metrics.comparison import MM
from smplxpp.metrics.completeness import ENDS, TRUNK_AND_LIMBS, body_regions, far_patches, uncovered_body
from smplxpp.template.template import Template

EXPLAINED = 15e-3
"""Metres from the template within which it explains the scan."""
OFF_BODY = 20e-3
"""Metres off the body from which skin looks like cloth."""
_SIDES_APART = 256
"""Pixels of a photograph's longer side at which left and right differ: in large areas, not in details."""
_LOOKS_DOWN = -0.5
"""Vertical component of a normal below which no scanner sees the surface."""


def completeness_checks(
    template: Template,
    params: BodyParams,
    scan: TriangleMesh,
    face_labels: np.ndarray,
    scan_to_template: DirectedDistances,
) -> tuple[list[Check], dict[str, Any]]:
    """Check what the scan lacks of the body, what the template lacks of the scan, and whether the scan is mirrored.

    Args:
        template: of the scan.
        params: of the scan's pose.
        scan: prepared.
        face_labels: (M,) of the scan.
        scan_to_template: from the scan's visible points.

    Returns:
        The checks, and their numbers by name.
    """
    figure = template.posed_body(params).frame(0)
    body = template.body.mesh(figure.vertices)
    # A vertex belongs to the region of the joint with its largest skin weight.
    names = np.array(body_regions(template.body.joint_names))
    region = names[template.body.weights.argmax(axis=1)]
    # Faces without a label count as bare too, because a garment whose label is missing is to be found among them.
    bare = np.isin(face_labels, (SKIN.id, BACKGROUND))
    # What of the body has no scan near it, by region.
    checks, numbers = _body_side(body, region, scan)
    # What of the scan has no template near it; surfaces that look down are left out, because scanners miss them.
    unexplained = (scan_to_template.distance > EXPLAINED) & (scan_to_template.samples.normals[:, 1] > _LOOKS_DOWN)
    # Samples are uniform in area, so that their mean estimates a share of the surface.
    share = float(unexplained.mean())
    checks.append(
        UNEXPLAINED.check(
            "share of the scan that the template does not explain",
            share,
            explanation=f"visible, not looking down, more than {EXPLAINED * MM:.0f} mm from it; high: a garment "
            "without its label, a thing beside the person, a wrong fit",
        )
    )
    # Skin that stands off the body: a garment without its label.
    # Largest first. A patch is a connected component of bare faces that are all farther than `OFF_BODY` from the
    # body.
    patches = far_patches(scan, bare, body, far=OFF_BODY)
    where = ""
    if patches:
        face = point_to_surface(np.array([patches[0].center]), body)[2]
        # Name the body's region under the patch by its nearest face's first corner.
        where = f"at the {region[body.faces[face[0], 0]]}; "
    # Square metres to square centimetres.
    largest = patches[0].area * 1e4 if patches else 0.0
    checks.append(
        SKIN_PATCH.check(
            "largest patch labelled skin that stands off the body",
            largest,
            explanation=f"{where}by more than {OFF_BODY * MM:.0f} mm; large: it looks like cloth or hair without its "
            "label, or the fit is off there",
        )
    )
    ratio = _mirror_ratio(body, sagittal_plane(template, figure.joints), scan, bare)
    checks.append(
        MIRRORED.check(
            "distance of the scan to the fit over that of its mirror image",
            ratio,
            explanation="above 1 the mirror image fits better: scan or parameters have left and right exchanged; a "
            "symmetric pose gives 1 and tells nothing",
        )
    )
    return checks, {**numbers, "scan_unexplained": share, "skin_patches_cm2": [p.area * 1e4 for p in patches[:5]]}


def _body_side(body: TriangleMesh, region: np.ndarray, scan: TriangleMesh) -> tuple[list[Check], dict[str, Any]]:
    uncovered = uncovered_body(body, scan)
    # A face takes the region of its first corner; faces across a border are too few to matter in a share of area.
    of_face = region[body.faces[:, 0]]
    shares = {name: uncovered.mean(of_face == name) for name in (*TRUNK_AND_LIMBS, *ENDS)}
    checks = [
        UNCOVERED.check(
            "share of the body that the scan neither shows nor covers",
            uncovered.mean(),
            explanation="of what is seen of the naked body; high: a part of the scan is missing, or it has holes",
        )
    ]
    for title, gate, among in (
        ("head, torso, arms and legs", REGION_UNCOVERED, TRUNK_AND_LIMBS),
        ("hands and feet", ENDS_UNCOVERED, ENDS),
    ):
        order = sorted(among, key=lambda name: -shares[name])
        # Name every region above the limit, and the worst one where all are within it.
        lost = [f"{name} {100 * shares[name]:.0f} %" for name in order if shares[name] > gate.warn] or [
            f"{order[0]} {100 * shares[order[0]]:.0f} %"
        ]
        checks.append(gate.check(f"the same, worst of {title}", shares[order[0]], explanation=", ".join(lost)))
    return checks, {"body_uncovered": {"all": uncovered.mean(), **shares}}


def sagittal_plane(template: Template, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point between the hips of posed joints (J, 3), and the direction from the right to the left one."""
    named = dict(zip(template.body.joint_names, joints, strict=True))
    left, right = named["left_hip"], named["right_hip"]
    return 0.5 * (left + right), left - right


def _mirror_ratio(
    body: TriangleMesh, plane: tuple[np.ndarray, np.ndarray], scan: TriangleMesh, bare: np.ndarray
) -> float:
    """The `mirror_ratio` of the scan's skin, or of the whole scan where less than a fiftieth of the faces is skin."""
    least_skin, most_points = 0.02, 5_000  # a sample is enough, the ratio is one number
    chosen = bare if bare.mean() > least_skin else np.ones_like(bare)
    used = np.unique(scan.faces[chosen])
    used = used[np.sort(np.random.default_rng(0).permutation(len(used))[:most_points])]
    return mirror_ratio(scan.vertices[used], body, center=plane[0], across=plane[1])


def photograph_checks(
    template: Template, params: BodyParams, scan: TriangleMesh, colors: np.ndarray, inputs: BuildInputs
) -> tuple[list[Check], dict[str, Any]]:
    """Check whether the reference frame's photographs show the scan or its mirror image.

    Args:
        template: of the scan.
        params: of the scan's pose.
        scan: prepared.
        colors: (N, 3) uint8 of the scan, all the same if it has none.
        inputs: they name photographs and cameras.

    Returns:
        The check where scan and photographs have colours, and its numbers.
    """
    # Without photographs, or with one colour for the whole scan, colours cannot tell an object from its mirror image.
    if not inputs.photographs or (colors == colors[0]).all():
        return [], {}
    views, notes = photograph_views(inputs, longer_side=_SIDES_APART)
    figure = template.posed_body(params).frame(0)
    center, across = sagittal_plane(template, figure.joints)
    body = template.body.mesh(figure.vertices)
    # Colours in [0, 1], as the photographs have them; the mirror image is taken across the body's sagittal plane.
    shown = [(camera, color / 255.0) for camera, color in views]
    share = mirrored_by_views(scan, colors / 255.0, shown, body=body, center=center, across=across)
    numbers = {"views": [camera.name for camera, _ in views], "unread": notes, "mirrored": share}
    if share is None:
        return [], numbers
    words = "0: the scan as it is, 1: its mirror image; high: scan or parameters have left and right exchanged; 0.5 "
    words += f"tells nothing; {len(views)} views" + (f", {len(notes)} cannot be read" if notes else "")
    check = MIRRORED_VIEWS.check("photographs between the scan and its mirror image", share, explanation=words)
    return [check], numbers


def photograph_views(inputs: BuildInputs, *, longer_side: int) -> tuple[list[tuple[Camera, np.ndarray]], list[str]]:
    """Return photographs (H, W, 3) uint8, no longer than a side, with their cameras; notes on those not to be read."""
    if inputs.cameras is None:
        return [], ["no camera file"]
    try:
        lenses = {camera.name: (camera, lens) for camera, lens in read_lenses(inputs.cameras)}
    except InputError as error:
        return [], [str(error)]
    views, notes = [], []
    for name, path in inputs.photographs.items():
        if name not in lenses:
            notes.append(f"camera {name}: not in {inputs.cameras.name}")
            continue
        camera, lens = lenses[name]
        try:
            # The window scales the intrinsics with the image, so that camera and pixels agree at the small size.
            window = Window.full(camera).resized(min(1.0, longer_side / max(camera.width, camera.height)))
            # The reader removes lens distortion, because the projection that follows is that of a pinhole.
            views.append((window.camera(camera), ViewReader(camera, window, lens).color(path)))
        except InputError as error:
            notes.append(f"camera {name}: {error}")
    return views, notes
