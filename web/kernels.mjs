// Compiles the C++ that the page runs to src/native/kernels.wasm, which the repository carries, by the clang of
// `pip install ziglang==0.17.1`: `npm run kernels`, then `npm run build`. The file says in a section of its own which
// sources it is of: a test reads it, so that C++ which changes is built anew.
import { execFileSync } from "node:child_process";
import { createHash } from "node:crypto";
import { mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const ZIG_VERSION = "0.17.1";
const native = fileURLToPath(new URL("../smplxpp/native/", import.meta.url));
/** As CMakeLists.txt has them: what must be the same on every machine, what may be reassociated, what has vectors. */
const KINDS = [
  { flags: ["-ffp-contract=off", "-fno-math-errno"], sources: ["cloth/xpbd.cpp", "cloth/carried.cpp", "web/memory.cpp", "web/threads.cpp"] },
  { flags: ["-ffast-math"], sources: ["runtime/surface.cpp", "runtime/gaussians.cpp", "web/splats.cpp"] },
  { flags: ["-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"], sources: ["runtime/pose.cpp", "runtime/field.cpp", "web/normals.cpp"] },
];
/** What memory that threads share asks of every file, the compiler's own library among them. */
const THREADS = ["-matomics", "-mbulk-memory"];
const TARGET = [
  "-target", "wasm32-wasi", "-std=c++17", "-O3", "-msimd128", ...THREADS, "-fno-exceptions", "-fno-rtti", "-fvisibility=hidden",
  "-Wall", "-Wextra", "-Werror", "-D_LIBCPP_VERBOSE_ABORT(...)=__builtin_trap()", "-I", ".",
];
/** Bytes: the field's kernel has its layers on the stack. Memory comes from the page, src/native/memory.ts has its pages. */
const STACK = 1 << 18, PAGE = 1 << 16, FIRST = 16 * PAGE, MOST = 65535 * PAGE;

const zig = process.env.ZIG ? [process.env.ZIG] : [process.env.PYTHON ?? "python3", "-m", "ziglang"];
const run = (...options) => execFileSync(zig[0], [...zig.slice(1), ...options], { cwd: native, encoding: "utf8" });

/** Every file that the build reads, from `#include "..."` to the next. */
function sources() {
  const found = new Set();
  const visit = (name) => {
    if (found.has(name)) return;
    found.add(name);
    const text = readFileSync(join(native, name), "utf8");
    for (const [, included] of text.matchAll(/^#include "(.+)"/gm)) visit(included);
  };
  KINDS.forEach(({ sources }) => sources.forEach(visit));
  return [...found].sort();
}

/** The functions that C++ exports in these files. */
function exported() {
  const names = KINDS.flatMap(({ sources }) => sources).flatMap((name) =>
    [...readFileSync(join(native, name), "utf8").matchAll(/^SMPLXPP_EXPORT [\w* ]+?(smplxpp_\w+)\(/gm)].map(([, own]) => own));
  return names.sort();
}

/** A section that engines skip: its name and its text. */
function section(name, text) {
  const number = (value) => (value < 128 ? [value] : [(value & 127) | 128, ...number(value >>> 7)]);
  const content = Buffer.concat([Buffer.from(number(name.length)), Buffer.from(name), Buffer.from(text)]);
  return Buffer.concat([Buffer.from([0, ...number(content.length)]), content]);
}

const version = run("version").trim();
if (version !== ZIG_VERSION) throw new Error(`zig ${ZIG_VERSION} builds the kernels, not ${version}: pip install ziglang==${ZIG_VERSION}`);
const out = process.argv[2] ?? fileURLToPath(new URL("src/native/kernels.wasm", import.meta.url));
const folder = mkdtempSync(join(tmpdir(), "kernels-"));
try {
  for (const { flags, sources } of KINDS) {
    for (const source of sources) run("c++", ...TARGET, ...flags, "-c", source, "-o", join(folder, `${source.replace("/", "_")}.o`));
  }
  const objects = readdirSync(folder).sort().map((name) => join(folder, name)), linked = join(folder, "kernels.wasm");
  run("c++", "-target", "wasm32-wasi", "-mexec-model=reactor", ...THREADS, "-s", ...objects, "-o", linked,
    `-Wl,-z,stack-size=${STACK},--import-memory,--shared-memory,--initial-memory=${FIRST},--max-memory=${MOST}`,
    "-Wl,--export=__stack_pointer",
    ...exported().map((name) => `-Wl,--export=${name}`));
  const sha256 = (data) => createHash("sha256").update(data).digest("hex");
  const lines = sources().map((name) => `${name} ${sha256(readFileSync(join(native, name)))}\n`);
  lines.push(`kernels.mjs ${sha256(readFileSync(fileURLToPath(import.meta.url)))}\n`);
  const built = Buffer.concat([readFileSync(linked), section("sources", lines.join(""))]);
  writeFileSync(out, built);
  console.log(`${out}: ${built.length} bytes`);
} finally {
  rmSync(folder, { recursive: true });
}
