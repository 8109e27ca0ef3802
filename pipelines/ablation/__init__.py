"""Variants of the system trained on one capture and measured by one protocol."""
