"""Synthetic people and captures: performances, clothes in motion, soft light, scans, and procedural people."""
