"""Benchmarks: each module prints its figures and stores them under `benchmarks/results/`."""
