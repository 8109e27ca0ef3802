"""A template that torch can pose, and what a posed avatar is."""
