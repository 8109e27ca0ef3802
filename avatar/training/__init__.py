"""Optimisation: from a template and photographs to Gaussians, a teacher and a student."""
