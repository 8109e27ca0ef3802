"""Surface tracking: displacements of control points in every training frame, fitted to its photographs.

Networks that learn all frames of a swinging, patterned skirt at once settle on the wrong stripe, because the cloth
moves by many pixels and the pattern repeats within few. From one solved frame to the next the displacement is small.

**Unknowns.** `d_t`, (K, 3) metres for frame t: displacements, along the axes of the T-pose, of K control points that a
`ControlCage` interpolates to all vertices before skinning. The Gaussians and the poses are fixed.

**Order.** Frames are solved one after the other, outwards from the reference frame (or from the first frame). Each one
starts from its nearest solved neighbour (`track.TrackTask`).

**Loss** of one frame, mean over control points where a sum is written (`TrackTask.loss`):

    L(d) = L_rec(render(d), photographs)                     photometric: L1, D-SSIM, opacity
         + smoothness  * mean |(d - s)_i - (d - s)_j|^2      first-order (membrane) smoothness about the shape s
         + strain_weight * mean strain^2                     of edges of clothes against their lengths along the cloth
         + prior_weight * mean (d - a)^T W (d - a)           Gaussian prior about the anchor a, in directions W
         + body_motion_weight * mean rho(|d|)                pseudo-Huber penalty, off the clothes and near the skin

**Predictions** (`cloth_prediction.ClothPrediction`) give the start and the anchor a; s is a on simulated clothes and 0,
skinning, elsewhere. Two predictors exist:
extrapolation of the last two frames at constant velocity, and simulated cloth plus the last frame's correction, which
decays exponentially. They are averaged with inverse mean squared errors over the last solved frames, for each garment.

**What photographs determine** (`track_uncertainty`). G = mean of J^T J over a point's pixels, J the derivative of the
rendered colours by the displacement: the structure tensor of the rendering. W = P (I + (G / c^2)^2)^-2 P is near 1
along the surface where G is small (along stripes, on plain cloth) and near 0 across stripes. After all frames are
solved, a Kalman filter with the information G / sigma^2 gives every control point an expected error in every frame.

**Solver and schedule.** Adam, from coarse to fine: a part of the steps on photographs halved twice, once and not at all
(`config.Level`), with a rate that falls exponentially within a level. An optional backward pass from the last frames to
the first measures drift.

**Afterwards** (`joint`) corrections of the clothes in all frames learn at once, together with the Gaussians.
"""
