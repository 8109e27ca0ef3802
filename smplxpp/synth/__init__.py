"""Make captures of a synthetic person: performances, clothes in motion, soft light, scans, the errors of trackers.

`make_capture` writes a capture with its truth; `degrade_capture` adds to any exact capture what trackers and parsers
would give. The names are loaded when they are first used.

Example:
    >>> from pathlib import Path
    >>> from smplxpp.synth import SynthConfig, make_capture
    >>> person = Path("data/fixtures/person/geometry/topology.npz")
    >>> make_capture(Path("anna"), person, SynthConfig(cameras=8, frames=40, seed=3))  # doctest: +SKIP
"""

from __future__ import annotations

from smplxpp.core.lazy import lazy_exports

_EXPORTS: dict[str, str] = {
    "DegradeConfig": "smplxpp.synth.degrade",
    "Degraded": "smplxpp.synth.degrade",
    "DetectorConfig": "smplxpp.synth.tracker",
    "Performance": "smplxpp.synth.motion",
    "SimulationConfig": "smplxpp.synth.simulate",
    "SynthConfig": "smplxpp.synth.config",
    "Talking": "smplxpp.synth.talking",
    "Turntable": "smplxpp.synth.motion",
    "add_tracked_inputs": "smplxpp.synth.write_capture",
    "degrade_capture": "smplxpp.synth.degrade",
    "detector_keypoints": "smplxpp.synth.tracker",
    "estimated_labels": "smplxpp.synth.tracker",
    "make_capture": "smplxpp.synth.write_capture",
    "tracker_noise": "smplxpp.synth.tracker",
}

__all__ = [*_EXPORTS]

__getattr__, __dir__ = lazy_exports("smplxpp.synth", _EXPORTS)
