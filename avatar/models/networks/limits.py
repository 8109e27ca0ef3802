"""Upper limits of network sizes: a file with larger ones is damaged and would exhaust the memory."""

from __future__ import annotations

MOST_LAYERS = 64
"""Layers of a network, bands of an encoding, steps along a skeleton: ten times what is useful."""
LARGEST_SIDE = 8192
"""Side of a map, pixels; eight times the paper's."""
LARGEST_NUMBER = 1 << 20
"""Width of a layer, or any other number in a configuration."""
