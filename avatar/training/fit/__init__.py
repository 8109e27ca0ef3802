"""One frame's photographs turn a posed template into Gaussians."""
