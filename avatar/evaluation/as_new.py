"""Show training frames with an avatar as if their poses were new."""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor, nn

from avatar.data.sequence import AvatarSequence
from avatar.rig.rig import AvatarModel, Pose, PosedAvatar, Rig


class AsNew(nn.Module):
    """An avatar that draws every frame as a new pose, without the frame's code, as it does live.

    Args:
        model: the avatar; its loose clothes are simulated as they are in new poses.
    """

    rig: Rig

    def __init__(self, model: AvatarModel) -> None:
        super().__init__()
        self.model, self.rig = model, model.rig

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar without the code of a frame."""
        return self.model(pose.without_code(), camera_centers)


def new_pose(sequence: AvatarSequence, frame: int) -> Pose:
    """Return the pose of any frame as a live player has it: without a code, with simulated clothes."""
    if frame not in sequence.train_frames:
        return sequence.pose(frame)
    return replace(sequence.as_new_pose(frame), known=None)
