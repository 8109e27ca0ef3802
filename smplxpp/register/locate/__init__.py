"""Find the body in a bare surface, from nothing else: pose, shape, facing and place."""

from smplxpp.register.locate.config import LocateConfig
from smplxpp.register.locate.locate import Labeller, locate_body
from smplxpp.register.locate.located import Candidate, LocatedBody

__all__ = ["Candidate", "Labeller", "LocateConfig", "LocatedBody", "locate_body"]
