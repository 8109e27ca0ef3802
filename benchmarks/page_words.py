"""What parts of the page docs/benchmarks.md rest on, where several share the words."""

from __future__ import annotations

WOMAN = (
    "Synthetic capture `woman_casual`: 14 cameras of 384x640 and 60 frames; 12 cameras and 48 frames are trained on, "
    "2 cameras and 12 frames are held out. All inputs are exact: parameters, cameras, labels and normal maps are the "
    "true ones. The preset `cpu` is a lean one: student and teacher learn from photographs and from a tracked surface."
)
EVERY_FRAME = (
    " Measured on every held-out frame of every held-out camera: 96 images carry the novel views, 24 the novel poses. "
    "The capture does not say what its inputs are, so that the stored words on them are `not known`. "
)
TALKING = (
    "Synthetic capture of `smplxpp synth --motion talking --frames 400`: 8 cameras of 384x640 and 480x480, one of them "
    "held out, 320 frames at 10 a second for training and the last 80 held out, half-loose shirt over tight trousers; "
    "exact inputs. Every fourth training frame was trained on and followed, 80 in all. "
)
MOTION_CODES = (
    "Vertexwise distances of the template's parts in mm, P2S where it is written, of the held-out frames; in lists one "
    "number for each block of training frames that was left out. Predictors learn the followed surface, rows that say "
    "so the true one. Seconds of CPU, measuring included. One seed; fields learned in 300 steps at 2e-3 on the talking "
    "person, where half of them died at 5e-3 (nothing but zeros), and in 400 steps at 5e-3 on the woman."
)
FOLLOWED = (
    "The long skirt of `woman_casual` followed by the tracking of `cpu` from her exact poses, with simulated cloth to "
    "foresee it. Vertexwise: mm to where the same points truly are, mean and 95th percentile. `psnr`: the reference "
    "fit's Gaussians in held-out cameras. The machine was busy: seconds a frame are of the wall, and upper bounds. "
)
PERSON = (
    "The embedded person (`data/fixtures/person`): 8 cameras of 256x320 and 240x240, 16 frames; one camera and 3 "
    "frames are held out. All inputs are exact, as above. Preset `demo`, 22k Gaussians, lean as `cpu` is. No "
    "perceptual distance was measured; the surface of a single held-out frame is known."
)
TRACKED_INPUTS = (
    "**Nothing here is exact**: body parameters as a tracker gives them, estimated labels, normals estimated or none, "
    "as the words below say."
)
DISTILLATION = (
    "The paper's own distillation, in which the student learns from the teacher's images, with L_non to the teacher "
    "and with L_sem, is behind the figures of `paper-small` alone; the preset `paper` was never trained by us."
)
RECIPE = (
    "No surface is followed and no cloth simulated. The machine was shared: minutes are upper bounds. The perceptual "
    "distance is ST-LPIPS, which is not LPIPS."
)
REGISTRATION = (
    "A synthetic capture as trackers give it (`smplxpp capture degrade`): keypoints with 3 px of noise (an image 640 "
    "high), 5 % outliers and 10 % missing, parameters 1.5 degrees a joint and 8 mm off, label maps with 5 % of wrong "
    "pixels, scans of training frames where the capture has them. Errors of the naked body against the exact "
    "parameters; `one scan, symmetric` attracts all of the scan and the body to each other. "
)
DETECTION = (
    "Keypoints by MediaPipe 0.10.21 in the photographs of the training cameras (synthetic people on black), within the "
    "boxes of the true masks; points with a confidence of 0.5. Errors include what MediaPipe and the body call by one "
    "name and mean differently (hips, ears, toes: one to three centimetres). `registered`: the body fitted to these "
    "keypoints, with the true masks and without, from nothing else: no scan, no label map, no fit to start from. "
)
MASKS = (
    "Intersection over union with the true mask. The people are put before made rooms with noise, a shadow on the "
    "floor and an exposure 4 % below the plates'; three plates a camera, or one. No real photographs. "
)
RECONSTRUCTION = (
    "Photographs, cameras and masks of frame 0 alone; the truth is looked at in measuring. P2S in mm from the "
    "reconstruction to the true outer surface, air under the skirt included; completeness in mm from what two of the "
    "cameras see of the truth. Estimated masks: every other one grown, the rest shrunk by 2 pixels, one of the "
    "background, one shifted by 12 % of the image. Seconds were taken on a machine with six times as much work as it "
    "has cores; CPU seconds are the measure. "
)
