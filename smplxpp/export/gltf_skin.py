"""glTF joints, skin and per-vertex influences of a Template."""

from __future__ import annotations

import numpy as np
import pygltflib as gl

from smplxpp.core.skin_weights import SkinWeights
from smplxpp.core.template import Template
from smplxpp.export.gltf_buffer import GltfBuffer

# Two sets of four; engines read no more.
MAX_INFLUENCES = 8
_SET = 4


def add_skeleton(document: gl.GLTF2, buffer: GltfBuffer, template: Template) -> int:
    """Nodes 0..J-1 for the joints, each at its rest offset from its parent, and their skin; returns the skin's index.

    The joints' frames are the world's axes in the T-pose, so that an inverse bind matrix is a translation by -J.
    """
    joints, parents = template.joints, template.parents
    offsets = np.where(parents[:, None] < 0, joints, joints - joints[np.maximum(parents, 0)])
    for joint, name in enumerate(template.joint_names):
        children = np.flatnonzero(parents == joint).tolist()
        document.nodes.append(gl.Node(name=name, translation=offsets[joint].tolist(), children=children))
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    inverse_bind[:, :3, 3] = -joints
    document.skins.append(
        gl.Skin(
            name="skeleton",
            joints=list(range(len(joints))),
            skeleton=int(np.argmax(parents < 0)),
            inverseBindMatrices=buffer.add(inverse_bind),
        )
    )
    return len(document.skins) - 1


def influence_sets(weights: SkinWeights) -> list[tuple[np.ndarray, np.ndarray]]:
    """The `MAX_INFLUENCES` largest weights of N vertices in sets of four: (N, 4) joints, (N, 4) float32 weights.

    Each row of all sets together sums to 1 to float32's last bit; unused slots are joint 0 at weight 0.
    """
    # Through the dense form: joints that occur twice at a vertex become one.
    kept = SkinWeights.from_dense(weights.dense(), max_influences=MAX_INFLUENCES)
    width = -(-kept.joint_indices.shape[1] // _SET) * _SET
    missing = ((0, 0), (0, width - kept.joint_indices.shape[1]))
    values = np.pad(kept.joint_weights, missing).astype(np.float32)
    # Weights come largest first: that one takes the rounding.
    values[:, 0] = 1.0 - values[:, 1:].sum(axis=1, dtype=np.float64)
    joints = np.pad(kept.joint_indices, missing)
    joints = np.where(values > 0, joints, 0).astype(np.uint8 if weights.joint_count <= 256 else np.uint16)
    return [(joints[:, k : k + _SET], values[:, k : k + _SET]) for k in range(0, width, _SET)]
