// Prints what the glTF validator of Khronos finds in a file, as JSON; nothing is an empty list.
// Usage: node validate.mjs FILE
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const report = await validator.validateBytes(new Uint8Array(await readFile(process.argv[2])), { maxIssues: 0 });
console.log(JSON.stringify(report.issues.messages));
