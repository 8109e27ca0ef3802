"""The parts of the page docs/benchmarks.md that show the rows of `smplxpp ablate`."""

from __future__ import annotations

from benchmarks.page_part import Part
from benchmarks.page_trainings import ablation_lines
from benchmarks.page_words import EVERY_FRAME, TALKING, TRACKED_INPUTS, WOMAN

_METRIC = "The perceptual distance is ST-LPIPS, which is not LPIPS."
_DEMO = (
    "Preset `demo`, 22k Gaussians, so that all rows take two hours of one core: what tells rows apart, not how good "
    "they get. "
)
_EMBEDDED = (
    "The embedded person (`data/fixtures/person`), preset `demo`, 22k Gaussians: 13 frames of 7 cameras are trained "
    "on. Thirteen images of one camera carry the novel views, three the novel poses, and the surface of a single "
    "held-out frame is known: differences of a tenth of a decibel say nothing. Minutes are of a shared machine. "
    f"{_METRIC}"
)
_EXACT = "All inputs are exact. "
_BEHIND = (
    "Every fourth frame is measured: 20 images carry the novel views, 20 the novel poses, of one camera, which sees "
    "her from behind as no training camera does. No surface was measured. Nothing of hers is simulated. "
)

WOMAN_EXACT = (
    Part(
        "ablation_woman_casual_every_frame",
        "Rows of the ablation on a synthetic woman, every held-out frame",
        WOMAN + EVERY_FRAME + _METRIC,
        ablation_lines,
    ),
)
ALL_ROWS = (
    Part(
        "ablation_person_demo_tracked",
        "Ablation on the embedded person, all rows: tracked inputs",
        f"{TRACKED_INPUTS} {_EMBEDDED}",
        ablation_lines,
    ),
    Part(
        "ablation_person_demo",
        "Ablation on the embedded person, all rows: exact inputs",
        _EXACT + _EMBEDDED,
        ablation_lines,
    ),
    Part(
        "ablation_woman_casual_demo_tracked",
        "Rows of the ablation on a synthetic woman, preset `demo`: tracked inputs",
        f"{TRACKED_INPUTS} The capture `woman_casual` after `smplxpp capture degrade`, registered and refined; 12 "
        f"cameras and 48 frames are trained on. {_DEMO}Every second frame is measured: 48 images carry the novel "
        f"views, 12 the novel poses. {_METRIC}",
        ablation_lines,
    ),
    Part(
        "ablation_talking_demo_tracked",
        "Rows of the ablation on forty seconds of talking, preset `demo`: tracked inputs",
        TALKING.replace("exact inputs", "inputs as trackers give them, registered and refined")
        + f"{_BEHIND}{_DEMO}{_METRIC}",
        ablation_lines,
    ),
    Part(
        "ablation_talking_demo",
        "Rows of the ablation on forty seconds of talking, preset `demo`: exact inputs",
        f"{TALKING}{_BEHIND}{_DEMO}{_METRIC}",
        ablation_lines,
    ),
)
TALKING_PERSON = (
    Part(
        "ablation_talking",
        "Forty seconds of talking: the student against trained skinning",
        TALKING + "Measured on every trained-on and every held-out frame of the held-out camera. The perceptual "
        "distance is ST-LPIPS, which is not LPIPS. No surface was measured.",
        ablation_lines,
    ),
    Part(
        "ablation_talking_tracked",
        "Forty seconds of talking, tracked: the student against trained skinning",
        TALKING.replace("exact inputs", "inputs as trackers give them, registered and refined") + "Measured as above.",
        ablation_lines,
    ),
)
