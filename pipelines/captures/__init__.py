"""Captures checked and converted."""
