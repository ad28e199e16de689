// Along a ray from cell to cell: what a cell holds is the same everywhere inside of it (Yu 2021, section 4).

uniform usampler3D entries;      // where to begin for each cell of the entry level
uniform usampler2DArray cells;   // eight of every node: nothing, the number of a leaf, or of a node further down
uniform sampler2DArray thick;    // density and scale of every leaf
uniform float size;              // of the cube, in scene units
uniform float entry;             // cells of the entry level along its side
uniform float crumb;             // a length that is nothing to any cell

const uint NODE = 0x80000000u, LEAF = 0x40000000u, NUMBER = 0x3ffffffu;

// The cell around a place, as a leaf's number (LEAF set) or 0, with its corners.
uint find(vec3 p, out vec3 lower, out vec3 upper) {
  ivec3 cell = clamp(ivec3(p), ivec3(0), ivec3(entry) - 1);
  uint found = texelFetch(entries, cell, 0).r;
  float side = 1.0;
  lower = vec3(cell);
  if (found < LEAF) { // empty, and so are all cells nearer than that
    upper = lower + float(found);
    lower -= float(found) - 1.0;
    return 0u;
  }
  if (found < NODE) { // a leaf, perhaps larger
    side = exp2(float((found >> 26) & 15u));
    lower = floor(lower / side) * side;
    upper = lower + side;
    return found;
  }
  while (found >= NODE) {
    side *= 0.5;
    vec3 further = step(lower + side, p);
    lower += further * side;
    found = texelFetch(cells, at(8u * (found & NUMBER) + uint(dot(further, vec3(4.0, 2.0, 1.0)))), 0).r;
  }
  upper = lower + side;
  return found;
}

void main() {
  vec3 direction = normalize(mat3(pose) * vec3(place * slope, -1.0));
  vec3 origin = (pose[3].xyz - low) * (entry / size), d = direction * (entry / size), inverse = inverted(d);
  float basis[BASES] = harmonics(direction);
  vec2 range = through(origin, inverse, vec3(entry));
  float t = max(range.x, near), light = 1.0;
  vec3 colour = vec3(0.0);
  while (t < range.y && light > SPENT) {
    vec3 lower, upper;
    uint leaf = find(origin + (t + crumb) * d, lower, upper);
    float end = max(leaving(origin, inverse, lower, upper), t + crumb);
    if (leaf != 0u) {
      uint i = leaf & NUMBER;
      vec2 held = texelFetch(thick, at(i), 0).rg;
      float left = light * exp(-held.x * (min(end, range.y) - t));
      colour += (light - left) / (1.0 + exp(-held.y * sum(TEXELS * i, basis)));
      light = left;
    }
    t = end;
  }
  picture = vec4(colour, 1.0 - light);
}
