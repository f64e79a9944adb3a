// Draws a GLB with Babylon.js in headless Chromium at one moment of its animation, over white.
// Usage: node picture.mjs CHROMIUM FILE.glb OUT.png '{"fraction":…,"width":…,"height":…,"fov":…,"eye":[…],"target":[…]}'
import { spawn } from "node:child_process";
import { mkdtemp, readFile, rm, writeFile } from "node:fs/promises";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { extname, join } from "node:path";

const [chromium, glb, out, wish] = process.argv.slice(2);
const types = { ".html": "text/html", ".js": "text/javascript", ".wasm": "application/wasm", ".json": "application/json" };
const profile = await mkdtemp(join(tmpdir(), "picture-"));

const picture = new Promise((resolve, reject) => {
  const server = createServer(async (request, response) => {
    const path = new URL(request.url, "http://localhost").pathname;
    if (path === "/answer") {
      let text = "";
      for await (const chunk of request) text += chunk;
      response.end();
      text.startsWith("data:") ? resolve(Buffer.from(text.split(",")[1], "base64")) : reject(new Error(text));
    } else if (path === "/wish") {
      response.end(wish);
    } else {
      const file = path === "/glb" ? glb : join(import.meta.dirname, path);
      const body = await readFile(file).catch(() => null);
      response.writeHead(body ? 200 : 404, { "content-type": types[extname(file)] ?? "application/octet-stream" });
      response.end(body);
    }
  });
  server.listen(0, "127.0.0.1", () => {
    const flags = ["--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"];
    flags.push(`--user-data-dir=${profile}`, `http://127.0.0.1:${server.address().port}/page.html`);
    browser = spawn(chromium, flags, { stdio: "ignore" });
  });
  setTimeout(() => reject(new Error("no picture came within 3 minutes")), 180_000);
});
let browser;
try {
  await writeFile(out, await picture);
} finally {
  browser?.kill();
  await rm(profile, { recursive: true, force: true }).catch(() => {});
}
process.exit(0);
