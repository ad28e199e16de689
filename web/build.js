// Bundles src/ into lumigraph/export/web/, each file with its parts' versions and licences on top: stage.js, which all pages
// with WebGL share (three.js and src/stage.js), and a program for each kind of page, which takes those from it.

import { build } from "esbuild";
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import * as three from "three";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const built = (name) => here(`../lumigraph/export/web/${name}.js`);
const own = JSON.parse(await readFile(here("package.json")));
const shown = "Built from web/ by `npm ci && npm run build`. Do not edit.";

async function notice(name) {
  const about = JSON.parse(await readFile(here(`node_modules/${name}/package.json`)));
  const licence = await readFile(here(`node_modules/${name}/LICENSE`), "utf8");
  return `${name} ${about.version}\n\n${licence.trim()}`;
}

async function bundle(name, parts, options) {
  const pinned = parts.filter((part) => own.dependencies[part]).map((part) => `${part} ${own.dependencies[part]}`);
  const notices = await Promise.all(parts.map(notice));
  const heading = ["Lumigraph's page program", ...pinned].join(" · ");
  await build({
    outfile: built(name),
    bundle: true,
    minify: true,
    format: "iife",
    target: "es2022",
    charset: "utf8",
    loader: { ".glsl": "text" },
    legalComments: "none",
    banner: { js: `/*\n${[heading, shown, ...notices].join("\n\n")}\n*/` },
    ...options,
  });
}

// In place of three.js and src/stage.js, what stage.js has put into a global variable.
const fromStage = {
  name: "from stage.js",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^(three|\.\/stage\.js)$/ }, () => ({ path: "stage", namespace: "shared" }));
    onLoad({ filter: /.*/, namespace: "shared" }, () => ({ contents: "module.exports = lumigraphStage;" }));
  },
};

let programs = "";
for (const [name, parts] of [
  ["splats", []],
  ["mesh", []],
  ["volumes", []],
  ["views", []],
  ["probes", []],
]) {
  const options = { entryPoints: [here(`src/${name}.js`)], globalName: "lumigraphProgram", plugins: [fromStage] };
  await bundle(name, parts, options);
  programs += await readFile(built(name), "utf8");
}
const names = Object.keys(three).filter((name) => new RegExp(`\\.${name}\\b`).test(programs));
const contents = `export { ${names.join(", ")} } from "three"; export * from "./src/stage.js";`;
await bundle("stage", ["three"], { stdin: { contents, resolveDir: here(".") }, globalName: "lumigraphStage" });
