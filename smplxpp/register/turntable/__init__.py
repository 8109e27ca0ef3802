"""Register a person who turns before one camera that stands still: `register_turntable`."""

from smplxpp.register.turntable.fit import TurntableConfig, TurntableFit, register_turntable
from smplxpp.register.turntable.level import leveled, turn_notes

__all__ = ["TurntableConfig", "TurntableFit", "leveled", "register_turntable", "turn_notes"]
