"""Textures of a template: its surface unwrapped, and what a scan or photographs show of it painted there."""
