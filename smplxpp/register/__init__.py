"""Register a body to keypoints, landmarks, masks, label maps and scans, over all frames.

**Unknowns.** Of each frame: a rotation vector for every free joint in its parent's frame, the translation, and the
expression if points of the face are observed. Of all frames together: the shape (betas).

**Residuals.** `register` minimises a sum of squares, each residual divided by its standard deviation:

    E = sum_frames ( E_keypoints + E_landmarks      reprojection errors in pixels, distances in metres
                   + E_masks + E_scans              signed distances to contours and scans in metres
                   + E_pose + E_limits + E_face     Gaussian prior, joint limits, expression
                   + E_initial )                    an initial fit, as far as its own noise says
      + E_shape + E_smooth                          betas; accelerations of joints and translation

Observations have the robust kernel of Geman and McClure, `r^2 / (1 + (r / c)^2)`; the initial fit and the accelerations
have the Cauchy kernel. `keypoint_term`, `landmark_term`, `silhouette_term`, `scan_term` and `priors` state each term
with its weights and cutoffs.

Only skin attracts the body. Cloth is kept at a gap, the median distance observed at a place of the body over views and
frames, with a weight that falls with the spread of these distances (`clothing.Gaps`). The gaps are estimated again
after every step, so that the registration alternates between the body and what it wears.

**Solver.** Damped Gauss-Newton with iteratively reweighted least squares. All Jacobians are closed forms
(`kinematics`). Smoothness couples neighbouring frames only, so that the normal equations are banded, and the shared
shape is eliminated by its Schur complement (`normal_equations`). Steps are limited to 0.35 rad and 0.25 m.

**Schedule** (`fit`). 1. Triangulate the keypoints, estimate each camera's pixel noise, mend or drop faulty views
(`triangulate`). 2. Start at the initial fit, or align the T-pose rigidly to the points of the trunk (`start`). 3. Fit
keypoints and landmarks with the priors, with kernels that narrow from 40 standard deviations to one. 4. Find bare skin
by labels (`clothing`). 5. Fit everything, with cutoffs of the surfaces that fall to 0.4 of their reach. More frames
than a window holds are solved in overlapping windows, after the shape was solved on frames spread over the sequence.

**Confidence.** The confidence of a joint in a frame is `1 / (1 + (s / 20 mm)^2)`, with s the standard deviation of its
position by the inverse of the frame's normal matrix, other frames held.

`locate` finds the body in a bare scan, from nothing else; `follow` tracks it from one frame without keypoints.
"""

from smplxpp.register.clothing import bare_of_scan
from smplxpp.register.fit import register
from smplxpp.register.follow import follow, lost_frames
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import LandmarkModel, read_landmarks, write_landmarks
from smplxpp.register.observations import BodyFit, Observations, RegisterConfig, ScanObservation, ViewMap
from smplxpp.register.triangulate import Triangulation, TriangulationConfig, triangulate

__all__ = [
    "BodyFit",
    "BodyState",
    "Kinematics",
    "LandmarkModel",
    "Observations",
    "RegisterConfig",
    "ScanObservation",
    "Triangulation",
    "TriangulationConfig",
    "ViewMap",
    "bare_of_scan",
    "follow",
    "lost_frames",
    "read_landmarks",
    "register",
    "triangulate",
    "write_landmarks",
]
