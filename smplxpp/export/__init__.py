"""Export: a template as GLB and OBJ."""

from smplxpp.export.gltf import write_glb
from smplxpp.export.obj import write_obj

__all__ = ["write_glb", "write_obj"]
