// Adobe's and Niantic's own library: adobe.mjs FILE RESULT.json, in the axes of .ply files.
import createSpzModule from '@adobe/spz';
import fs from 'fs';

const module = await createSpzModule({ print: () => {}, printErr: () => {} });
console.log = () => {};
const [source, target] = process.argv.slice(2);
const to = module.CoordinateSystem.RDF;
const cloud = module.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(source)), { to });
cloud.alphas = cloud.alphas.map(logit => 1 / (1 + Math.exp(-logit))); // JSON has no infinity
const names = ['positions', 'rotations', 'scales', 'alphas', 'colors', 'sh'];
fs.writeFileSync(target, JSON.stringify(Object.fromEntries(names.map(name => [name, Array.from(cloud[name])]))));
