"""Make captures of photographs and videos: keypoints of their images, and a person who turns before one camera.

`detect_keypoints` looks at the images of a capture; `make_turntable_capture` makes a capture, camera and poses with it.
The names are loaded when they are first used.

Example:
    >>> from pathlib import Path
    >>> from smplxpp.footage import TurntableCaptureConfig, make_turntable_capture
    >>> made = make_turntable_capture(Path("turn.mp4"), Path("anna"), TurntableCaptureConfig())  # doctest: +SKIP
"""

from __future__ import annotations

from smplxpp.core.lazy import lazy_exports

_EXPORTS: dict[str, str] = {
    "DetectedCamera": "smplxpp.footage.keypoints",
    "TurntableCapture": "smplxpp.footage.turntable",
    "TurntableCaptureConfig": "smplxpp.footage.turntable",
    "detect_keypoints": "smplxpp.footage.keypoints",
    "detection_notes": "smplxpp.footage.keypoints",
    "detection_sheet": "smplxpp.footage.keypoints",
    "make_turntable_capture": "smplxpp.footage.turntable",
}

__all__ = [*_EXPORTS]

__getattr__, __dir__ = lazy_exports("smplxpp.footage", _EXPORTS)
