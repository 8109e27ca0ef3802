"""Refinement of poses on photographs: damped Gauss-Newton through the rasteriser, all frames together.

**Unknowns.** For every frame the rotations of the root, the body joints and the jaw (fingers on request), translation
and expression (`variables.Variables`): P numbers, as steps `R_j <- exp(d_j) R_j`. Nuisance variables are one colour for
each Gaussian, one depth for each label's Gaussians, and, on request, six numbers for each training camera
(`nuisance.AppearanceUpdate`, `nuisance.CameraCorrections`). The body's shape is fixed.

**Objective**, minimised over all F frames x_t with registered starts x_t^0:

    sum_t sum_p (k / 2) s^2 q_p / (q_p + s^2)               photographs: q_p = |colour difference|^2
                                                            + alpha (opacity - mask)^2 at pixel p,
                                                            robust kernel of Geman and McClure (`photometric`)
    + sum_t |(x_t - x_t^0) / sigma|^2 / 2                   Gaussian prior about the start (`solve.with_prior`)
    + sum_t 2 log(1 + |a_t|^2 / (2 tau)^2)                  accelerations a_t = x_{t+1} - 2 x_t + x_{t-1} under
                                                            Student's t, joint by joint (`solve.smoothness`)

k makes one full-size pixel count as `1 / pixels_per_error` of an observation with standard deviation `pixel_sigma`,
because the errors of neighbouring pixels are correlated.

**Weights of the surface.** The residual of a vertex acts on the pose with its rigidity f in [0, 1] (`posing.rigidity`):
1 on body, hair and shoes, falling with the distance from the skin on clothes. Loose cloth is drawn but does not pull.

**Linearisation.** The rasteriser's backward pass gives the gradient. The Gauss-Newton matrix is `sum_i f_i J_i^T M_i
J_i` over Gaussians i, J_i the derivative of a centre by the unknowns (`variables.CentreJacobian`) and M_i the structure
tensor of the rendering: the picture is assumed to move with its surface.

**Solver.** Levenberg-Marquardt with one damping for each frame, all frames in one banded system, because accelerations
couple a frame with two before and two after it (`solve.solve`). Robust kernels are handled by iteratively reweighted
least squares. A frame whose loss grew is reset and damped more (`align.Alignment`).

**Schedule.** The reference frame alone first, for its colours; then all frames, on photographs halved three times,
twice, once and not at all (`config.RefineConfig`). Each pass renders all views of all frames once, then poses, colours,
depths and cameras take one step each. Frames whose photographs fit the start better, with the final colours, keep the
start.
"""
