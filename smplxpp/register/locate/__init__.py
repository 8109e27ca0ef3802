"""Find the body in a bare surface, from nothing else: pose, shape, facing and place.

1. *Starts*: library poses in all directions, scaled to the height of the surface, ranked by their distance (`starts`).
2. *ICP*: the best of every direction are refined by symmetric, robust ICP with pose and shape priors, with a reach that
   falls from step to step (`icp`).
3. *Limbs*: arms and legs of the best of both facings are searched on a grid of poses, which leaves local minima
   (`limbs`).
4. *Dressed fit*: candidates are fitted with one-sided residuals. Skin lies on the surface, cloth stands off by a gap of
   its region and an unknown offset that garment, limb and side share and that is eliminated (`cloth_offsets`,
   `dressed`).
5. *Second look*: limbs that the surface does not show there, or that a detector sees elsewhere, are searched again in
   the surface that the rest of the dressed body leaves (`second_look`); feet below the floor get heels (`heels`).
6. *Decision*: the candidate with the least misfit and pose cost wins, is fitted with its fingers, and gets a confidence
   from its margin over the other facing (`decision`); what is not one whole person is named (`persons`).

Every step minimises a weighted sum of squares by damped Gauss-Newton on the normal equations of `smplxpp.register`.
"""

from smplxpp.register.locate.locate import BodyNotFoundError, Candidate, Labeller, LocatedBody, locate_body
from smplxpp.register.locate.search import LocateConfig

__all__ = ["BodyNotFoundError", "Candidate", "Labeller", "LocateConfig", "LocatedBody", "locate_body"]
