// Bundles src/{splats,mesh,volumes,views,probes}.js into lumigraph/export/web/, each with its parts' versions and licences on top.

import { build } from "esbuild";
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const own = JSON.parse(await readFile(here("package.json")));
const shown = "Built from web/ by `npm ci && npm run build`. Do not edit.";

// What Spark's WebAssembly is made of, as the paths inside it tell; all of it is MIT, Zlib, or MIT or Apache-2.0.
const CRATES =
  "Inside Spark's WebAssembly, under the MIT, Apache-2.0 or Zlib licence: anyhow, console_error_panic_hook, fdeflate, " +
  "hashbrown, image, image-webp, indexmap, js-sys, memchr, miniz_oxide, png, serde, serde_json, serde-wasm-bindgen, " +
  "smallvec, wasm-bindgen, zip, zlib-rs.";

async function notice(name) {
  const about = JSON.parse(await readFile(here(`node_modules/${name}/package.json`)));
  const licence = await readFile(here(`node_modules/${name}/LICENSE`), "utf8");
  return `${name} ${about.version}\n\n${licence.trim()}`;
}

for (const [page, parts] of [
  ["splats", ["three", "@sparkjsdev/spark", "fflate"]],
  ["mesh", ["three"]],
  ["volumes", ["three"]],
  ["views", []],
  ["probes", ["three"]],
]) {
  const pinned = parts.filter((name) => own.dependencies[name]).map((name) => `${name} ${own.dependencies[name]}`);
  const notices = await Promise.all(parts.map(notice));
  if (parts.includes("@sparkjsdev/spark")) notices.push(CRATES);
  const heading = ["Lumigraph's page program", ...pinned].join(" · ");
  await build({
    entryPoints: [here(`src/${page}.js`)],
    outfile: here(`../lumigraph/export/web/${page}.js`),
    bundle: true,
    minify: true,
    format: "iife",
    globalName: "lumigraphProgram",
    target: "es2022",
    charset: "utf8",
    loader: { ".glsl": "text" },
    legalComments: "none",
    banner: { js: `/*\n${[heading, shown, ...notices].join("\n\n")}\n*/` },
  });
}
