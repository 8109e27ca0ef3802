"""Register a person who turns before one camera that stands still: `register_turntable`."""

from smplxpp.register.turntable.fit import TurntableConfig, TurntableFit, register_turntable

__all__ = ["TurntableConfig", "TurntableFit", "register_turntable"]
