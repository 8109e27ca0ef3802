"""Data types in which the stages meet."""
