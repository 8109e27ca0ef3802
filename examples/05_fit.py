"""One frame's photographs become textured Gaussians on a template: what `smplxpp fit` does, in Python.

Without --template it builds the template first.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import avatar
import smplxpp

PERSON = Path(__file__).parents[1] / "data" / "fixtures" / "person"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--template", type=Path, help="smplxpp.npz of the embedded person, of `smplxpp build`")
    parser.add_argument("--out", type=Path, help="folder of the result; by default a new temporary one")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp(prefix="smplxpp_"))

    capture = smplxpp.open_capture(PERSON)
    splits = capture.splits
    if options.template:
        template = smplxpp.Template.load(options.template)
    else:
        template = smplxpp.build_template(capture=capture).template
    train, held_out = (
        avatar.read_views(capture, 0, names) for names in (splits.train_cameras, splits.novel_view_cameras)
    )
    scene = avatar.FitScene(template, template.pose(capture.params(0))[0], train, held_out)

    # A third of the default's Gaussians and a tenth of its steps: seconds instead of minutes.
    config = avatar.FitConfig(sampling=avatar.SamplingConfig(count=50_000), iterations=60, evaluations=3)
    result = avatar.fit_gaussians(scene, config, out)
    avatar.write_splat_ply(out / "splats.ply", result.splats)
    for view in held_out:
        pair = np.concatenate([view.photograph(scene.background), result.images[view.name]], axis=1)
        Image.fromarray(pair).save(out / f"{view.name}.png")
    mean = avatar.mean_quality({view.name: result.quality[view.name] for view in held_out})
    print(f"held out: PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.4f}\nwritten {out}/splats.ply and pictures")


if __name__ == "__main__":
    main()
