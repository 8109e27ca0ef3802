"""The synthetic capture: performance, clothes in motion, soft light, files."""
