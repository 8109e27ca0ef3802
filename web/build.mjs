// Builds the player into one file, its worker inside: pipelines/web/assets/player.js. With --tests: what the tests import.
import { createHash } from "node:crypto";
import { readdirSync, readFileSync } from "node:fs";
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
} else {
  const outfile = process.argv[2] ?? here("../pipelines/web/assets/player.js");
  const licence = `/* smplxpp player, Apache-2.0; web/ of the project has its sources ${digestOfSources()} */`;
  await build({
    ...shared, ...files, entryPoints: [here("src/main.ts")], outfile, format: "iife", banner: { js: licence },
    define: { WORKER_SOURCE: await scriptOf("src/worker/worker.ts", define) },
  });
  console.log(`${outfile}: ${readFileSync(outfile).length} bytes`);
}
