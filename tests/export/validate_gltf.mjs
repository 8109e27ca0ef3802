// Validates a glTF file with Khronos's gltf-validator and prints its report as JSON.
// Usage: node validate_gltf.mjs FILE; the npm package is looked for in NODE_PATH, then as usual. Exit 3: not installed.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

const require = createRequire(import.meta.url);
let validator;
try {
  validator = require("gltf-validator");
} catch (error) {
  if (error.code !== "MODULE_NOT_FOUND") throw error;
  process.exit(3);
}
const report = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])), { maxIssues: 50 });
console.log(JSON.stringify(report));
