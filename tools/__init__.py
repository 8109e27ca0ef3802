"""Makers of what the project ships: open body, fixture, demo, pictures. Not part of the installed package."""
