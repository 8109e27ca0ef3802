"""Optimisation: from a template and images to Gaussians."""
