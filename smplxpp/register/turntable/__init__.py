"""Register a person who turns before one camera that stands still: `register_turntable`."""

from smplxpp.register.turntable.fit import LEAST_FRAMES, TurntableConfig, TurntableFit, register_turntable
from smplxpp.register.turntable.level import leveled, turn_notes

__all__ = ["LEAST_FRAMES", "TurntableConfig", "TurntableFit", "leveled", "register_turntable", "turn_notes"]
