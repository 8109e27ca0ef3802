"""Milliseconds, seconds and memory: kernels, stages, players."""
