"""The personalised clothed body: the naked body and its parts as one skinned mesh, and its file."""

from smplxpp.template.template import BODY_PART, Template

__all__ = ["BODY_PART", "Template"]
