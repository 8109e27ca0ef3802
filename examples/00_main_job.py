"""The main job in ten lines: a capture becomes a template, a student and a picture of it in a pose it has not seen.

The digits are those of `smplxpp build` and `smplxpp train`. python examples/00_main_job.py --share 1
"""

import argparse
import tempfile
from pathlib import Path

from PIL import Image

import avatar
import smplxpp

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"


def main(out: Path, share: float) -> None:
    capture = smplxpp.open_capture(PERSON)
    built = smplxpp.build_template(capture=capture)
    config = avatar.TrainConfig(iterations_share=share)
    student = avatar.train(built.template, built.capture, out / "training", preset="demo", config=config)
    size = student.export(out / "me.avatar")["bytes"]["total"]
    frame, name = capture.splits.novel_pose_frames[0], capture.splits.novel_view_cameras[0]
    image = avatar.render(student, built.capture.params(frame), capture.cameras[name])
    Image.fromarray(image).save(out / "new_pose.png")
    print(f"{len(student.gaussians())} Gaussians, {size / 1e6:.1f} MB; written {out}/me.avatar and new_pose.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--share", type=float, default=0.1, help="of the iterations of the preset demo")
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    options = parser.parse_args()
    main(options.out or Path(tempfile.mkdtemp(prefix="smplxpp_")), options.share)
