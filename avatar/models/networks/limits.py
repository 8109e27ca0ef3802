"""Sizes that no network exceeds: a file that says to hold a larger one is wrong, and would take all memory."""

from __future__ import annotations

MOST_LAYERS = 64
"""Layers of a network, bands of an encoding, steps along a skeleton: an order of magnitude above any that is of use."""
LARGEST_SIDE = 8192
"""Pixels of a map's side; eight times the paper's."""
LARGEST_NUMBER = 1 << 20
"""What no width of a layer and no factor in a configuration exceeds."""
