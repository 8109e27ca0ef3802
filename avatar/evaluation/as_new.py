"""An avatar that is shown training frames as if they were new."""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor, nn

from avatar.data.sequence import AvatarSequence
from avatar.rig.posed import AvatarModel, PosedAvatar
from avatar.rig.rig import Pose, Rig


class AsNew(nn.Module):
    """An avatar that shows every frame as it shows new poses, as it does online: without a frame's code.

    Args:
        model: that shows them; its loose clothes are simulated where its own would be in new poses.
    """

    rig: Rig

    def __init__(self, model: AvatarModel) -> None:
        super().__init__()
        self.model, self.rig = model, model.rig

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar without the code of a frame."""
        return self.model(pose.without_code(), camera_centers)


def new_pose(sequence: AvatarSequence, frame: int) -> Pose:
    """Return the pose of any frame as whoever plays it live has it, its clothes simulated."""
    if frame not in sequence.train_frames:
        return sequence.pose(frame)
    return replace(sequence.as_new_pose(frame), known=None)
