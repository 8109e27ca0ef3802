"""The synthetic capture: performance, cloth dynamics (XPBD), soft light, files."""
