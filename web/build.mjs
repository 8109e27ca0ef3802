// Builds the player into one file, its worker inside: pipelines/web/assets/player.js. With --tests: what the tests import.
// With --package: dist/, which npm pack takes; with --package FOLDER: its scripts alone.
import { execFileSync } from "node:child_process";
import { createHash } from "node:crypto";
import { copyFileSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const shared = { bundle: true, minify: true, target: "es2022", legalComments: "none", charset: "ascii" };
const files = { loader: { ".css": "text", ".wasm": "binary" } };

/** Names and bytes of what the build reads, in one number: a test tells by it whether the built file is old. */
function digestOfSources() {
  const sha256 = (data) => createHash("sha256").update(data).digest("hex");
  const entries = readdirSync(here("src"), { recursive: true, withFileTypes: true }).filter((entry) => entry.isFile());
  const names = entries.map((entry) => `${entry.parentPath ?? entry.path}/${entry.name}`.slice(here(".").length));
  const lines = [...names, "build.mjs", "package-lock.json"].sort().map((name) => `${name}\0${sha256(readFileSync(here(name)))}\n`);
  return sha256(lines.join(""));
}

/** A script of its own, as text that others carry. */
async function scriptOf(source, define = {}) {
  const built = await build({ ...shared, ...files, entryPoints: [here(source)], format: "iife", write: false, define });
  return JSON.stringify(built.outputFiles[0].text);
}

const define = { HELPER_SOURCE: await scriptOf("src/native/helper.ts") };
if (process.argv.includes("--tests")) {
  await build({
    entryPoints: [here("test/modules.ts")], outfile: here("build/modules.mjs"), bundle: true, format: "esm",
    target: "es2022", platform: "neutral", define, ...files,
  });
} else if (process.argv.includes("--package")) {
  const worker = await scriptOf("src/worker/worker.ts", define);
  const out = process.argv[process.argv.indexOf("--package") + 1] ?? here("dist");
  rmSync(out, { recursive: true, force: true });
  const entryPoints = ["index", "element", "three"].map((name) => here(`src/embed/${name}.ts`));
  const licence = { js: "/* smplxpp, Apache-2.0 */" };
  await build({
    ...shared, ...files, entryPoints, outdir: out, format: "esm", splitting: true, external: ["three"], banner: licence,
    define: { WORKER_SOURCE: worker },
  });
  await build({ ...shared, ...files, entryPoints: [here("src/worker/worker.ts")], outfile: `${out}/worker.js`, format: "iife", define, banner: licence });
  if (out === here("dist")) {
    execFileSync(process.execPath, [here("node_modules/typescript/bin/tsc"), "-p", here("tsconfig.package.json")], { stdio: "inherit" });
    for (const name of ["LICENSE", "NOTICE"]) copyFileSync(here(`../${name}`), `${out}/${name}`);
  }
} else {
  const outfile = process.argv[2] ?? here("../pipelines/web/assets/player.js");
  const licence = `/* smplxpp player, Apache-2.0; web/ of the project has its sources ${digestOfSources()} */`;
  await build({
    ...shared, ...files, entryPoints: [here("src/main.ts")], outfile, format: "esm", banner: { js: licence },
    define: { WORKER_SOURCE: await scriptOf("src/worker/worker.ts", define) },
  });
  console.log(`${outfile}: ${readFileSync(outfile).length} bytes`);
}
