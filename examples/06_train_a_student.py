"""From a template and photographs to a student, and the student in a pose it has not seen: `smplxpp train`, in Python.

smplxpp build --capture data/fixtures/person --out RUN
python examples/06_train_a_student.py RUN --share 1
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import avatar
import smplxpp
from smplxpp.capture import open_capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of `smplxpp build --capture data/fixtures/person`")
    parser.add_argument("--share", type=float, default=0.1, help="of the steps of the preset demo")
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp(prefix="smplxpp_"))
    capture = open_capture(Path(__file__).parents[1] / "data" / "fixtures" / "person")
    template = smplxpp.Template.load(options.run / "60_assemble" / "smplxpp.npz")
    preset = avatar.training_preset("demo").shortened(options.share)
    sequence = avatar.AvatarSequence(capture, template)
    views = avatar.read_views(capture, 0, sequence.train_cameras)
    scene = avatar.FitScene(template, template.pose(capture.params(0))[0], views)
    fitted = avatar.fit_gaussians(scene, preset.fit, out / "fit").gaussians
    config = replace(preset.teacher, track=replace(preset.teacher.track, reference=0))  # the template is of frame 0
    teacher, _ = avatar.fit_teacher(sequence, fitted, preset.networks.teacher, config, avatar.Session(out / "teacher"))
    start = teacher.gaussians.snapshot()
    baked, _ = avatar.bake(
        sequence, start, preset.student(), preset.bake, avatar.Session(out / "bake"), teacher=teacher
    )
    shapes = replace(preset.blend_shapes, expression_size=sequence.rig.expression_size)
    student, _ = avatar.compensate(
        sequence, baked, shapes, preset.compensate, avatar.Session(out / "shapes"), teacher=teacher
    )
    size = avatar.save_avatar(
        out / "student.safetensors", student, compact=True
    )  # with the template, all a player needs
    player = avatar.load_avatar(out / "student.safetensors", avatar.Rig(template))
    frame = capture.splits.novel_pose_frames[0]
    (view,) = avatar.read_views(capture, frame, capture.splits.novel_view_cameras[:1])
    with torch.no_grad():
        posed = player(player.rig.pose(capture.params(frame)), view.position[None])
        drawn = avatar.render_view(posed, 0, view, torch.zeros(3)).image.clamp(0, 1)
    pair = np.hstack([view.photograph((0.0, 0.0, 0.0)), (255 * drawn).round().byte().numpy()])
    Image.fromarray(pair).save(out / "new_pose.png")
    print(f"{len(posed.bound)} Gaussians, {size / 1e6:.1f} MB; written {out}/student.safetensors and new_pose.png")


if __name__ == "__main__":
    main()
