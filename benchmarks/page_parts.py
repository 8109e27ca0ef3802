"""What stands on the page docs/benchmarks.md, in what order, and what each part rests on."""

from __future__ import annotations

from benchmarks.page_part import Part
from benchmarks.page_parts_ablation import ALL_ROWS, TALKING_PERSON, WOMAN_EXACT
from benchmarks.page_parts_played import PLAYED
from benchmarks.page_tables import reconstruction_lines, registration_lines
from benchmarks.page_trainings import build_lines, training_lines
from benchmarks.page_words import (
    DETECTION,
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
    Part(
        "darning",
        "Armpits that nobody saw",
        "Shirts and a jacket of synthetic people in their authored T-pose, and driven by their authored weights with "
        "arms overhead; `person_dots` is `smplxpp synth --skirt-pattern dots --frames 30 --seed 3`. Distances in mm, "
        "mean and 95th percentile: of all points of the true garment, of those whose nearest face is a patch, and "
        "back. The width of 8 cm up to which a hole is closed was chosen on these four.",
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
    *WOMAN_EXACT,
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
    *ALL_ROWS,
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
    *TALKING_PERSON,
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
        "plain cloth, and of stripes along them, slide where photographs do not show it.",
    ),
    Part(
        "followed_surface_start_every_2",
        "The first half second, and the way back",
        FOLLOWED
        + "Every second training frame of the first half second, quarter-size and half-size images alone; the skirt "
        "repainted with the help of the truth. `expected`: the distance from the truth that the tracking tells of "
        "itself, mm, its rank correlation with the true ones over points and frames; `drift`: how far, mm, the "
        "way back (quarter-size images alone) ends from its start, its rank correlation with the points' mean error. "
        "Made when what is held was held across the surface, too.",
    ),
    Part(
        "loose_cloth_woman_casual_tracked",
        "Loose clothes in motion that training did not show, a synthetic woman, tracked inputs",
        "The long skirt of `woman_casual`, mm over all 12 held-out frames. Template, garment and poses of the tracked "
        "run: what a tracker gives, registered on all frames; motions are smoothed as in every evaluation. "
        "Vertexwise: frame-0 correspondences. Milliseconds of CPU a step beside other work.",
    ),
    Part(
        "loose_cloth_woman_casual",
        "The same, exact inputs",
        "Exact poses. Vertexwise: frame-0 correspondences. Rows differ by where the simulation starts. Milliseconds of "
        "CPU a step on a busy machine; the solver alone takes about 3 (least of 15).",
    ),
    Part(
        "loose_cloth_woman_casual_noisy",
        "The same, driven by a tracker's poses as they are",
        "Template and garment of the exact run, poses of the capture's tracked protocol, not refined: their errors "
        "move the whole body, skinning as much as the simulation.",
    ),
    Part(
        "loose_cloth_woman_casual_draws",
        "The same, by draws of a tracker's noise",
        "Template and garment of the exact run. Rows of draws: 1.5 degrees on every joint and 8 mm on the root, anew "
        "by seed on the exact poses, as `smplxpp capture degrade` puts them there; not registered. The other rows are "
        "of exact poses.",
    ),
    Part(
        "loose_cloth_person",
        "Loose clothes in motion that training did not show, `make demo`",
        "The skirt of the embedded person, tracked and refined poses at 10 frames a second, one held-out frame with a "
        "true surface: one frame is little.",
    ),
    Part(
        "fit",
        "Fit",
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
    *PLAYED,
    Part("ssim", "SSIM with its gradient", "Random images; ours against plain torch."),
    Part("mesh_maps", "Mesh maps", "A body of 45k faces, 9 channels."),
    Part(
        "gpu",
        "On a GPU: an H200",
        "The embedded person, exact inputs, images of 256x320, resized to 1500x2000 for a step of `paper`; torch 2.11 "
        "with CUDA 13.0, gsplat 1.5.3. `short`: thirty steps of the teacher and fewer of the rest, kernels warming up "
        "within; `longer`: 158. PSNR of trainings as short as these says nothing. The student is untrained and has the "
        "paper's sizes; deformed and drawn, its pose included. The part `mapping` is left out: it failed then "
        "for a test that took gsplat's boxes, which are rounded up, for wrong; the next table has it.",
    ),
    Part(
        "gpu_again",
        "On a GPU: gsplat against the reference",
        "The same kind of machine, two hours later. `demo` was stopped in its bake at 80 seconds; it was trained "
        "to its end after that, below.",
    ),
    Part(
        "gpu_demo",
        "On a GPU: the preset `demo` to its end",
        "The embedded person, exact inputs, images of 256x320, a template without budgets; the surface is "
        "followed, the skirt simulated. On a CPU (one thread) the same commands gave 22.93 dB in novel views and "
        "20.68 in novel poses. gsplat's kernels were compiled before, in a minute.",
    ),
    Part(
        "gpu_trainings",
        "On a GPU: `demo` and `cpu` without a simulated skirt",
        "As before, but beside the template nothing of its build was known, so that the skirt was not simulated, "
        "neither for the surface that is followed nor in new poses: `demo` loses 1.2 dB of novel views and 1.6 of "
        "novel poses by that. On a CPU (one thread) the same had 21.72 and 19.07 dB in `demo`, 22.29 and 17.95 in "
        "`cpu`, in 20 minutes with other jobs beside it.",
    ),
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
