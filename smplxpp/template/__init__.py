"""The personalised clothed body: the naked body and its parts as one skinned mesh, and its file."""

from smplxpp.template.template import Template

__all__ = ["Template"]
