// Light probes on a grid: interpolation with visibility (Majercik 2019), as lumigraph/probes/grid.py has it.

precision highp float;
precision highp int;

uniform sampler2D light;     // L_lm and, beside the first, 1 for a free probe: `coefficients` texels for each probe
uniform sampler2D distances; // mean and mean square, bordered octahedral maps
uniform mat4 cells;          // from the scene to places of the grid, where probe (i, j, k) is at (i, j, k)
uniform mat3 turn;           // from the scene's axes to those of the probes
uniform vec3 steps;          // lengths of the grid's axes, in the unit of the probes
uniform float unit;          // of the probes to one of the scene
uniform ivec3 counts;
uniform int coefficients, side, across; // across: probes in a row of either texture
uniform float far;

const float PI = 3.14159265;

// The sixteen harmonics of a direction, without the bands that the probes lack.
float[16] basis(vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  return float[16](
    0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (3.0 * z * z - 1.0), -1.09254843 * x * z,
    0.54627421 * (x * x - y * y),
    -0.59004359 * y * (3.0 * x * x - y * y), 2.89061144 * x * y * z, -0.45704579 * y * (5.0 * z * z - 1.0),
    0.37317633 * z * (5.0 * z * z - 3.0), -0.45704579 * x * (5.0 * z * z - 1.0), 1.44530572 * z * (x * x - y * y),
    -0.59004359 * x * (x * x - 3.0 * y * y));
}

vec2 octahedral(vec3 d) {
  d /= abs(d.x) + abs(d.y) + abs(d.z);
  vec2 way = vec2(d.x >= 0.0 ? 1.0 : -1.0, d.y >= 0.0 ? 1.0 : -1.0);
  return d.z >= 0.0 ? d.xy : (1.0 - abs(d.yx)) * way;
}

ivec2 tile(int probe) {
  return ivec2(probe % across, probe / across);
}

vec2 moments(int probe, vec3 d) {
  vec2 place = (octahedral(d) * 0.5 + 0.5) * float(side) + 0.5; // a border of one texel, less half a texel
  ivec2 first = clamp(ivec2(floor(place)), ivec2(0), ivec2(side));
  vec2 share = place - vec2(first);
  ivec2 corner = tile(probe) * (side + 2) + first;
  vec2 a = texelFetch(distances, corner, 0).xy, b = texelFetch(distances, corner + ivec2(1, 0), 0).xy;
  vec2 c = texelFetch(distances, corner + ivec2(0, 1), 0).xy, e = texelFetch(distances, corner + ivec2(1, 1), 0).xy;
  return mix(mix(a, b, share.x), mix(c, e, share.x), share.y);
}

// Weight of each of the eight probes around a point with a normal, and their numbers.
void around(vec3 point, vec3 normal, out int[8] probes, out float[8] weights) {
  vec3 last = vec3(counts) - 1.0;
  vec3 here = (cells * vec4(point, 1.0)).xyz;
  vec3 place = clamp(here, vec3(0.0), last), first = min(floor(place), max(last - 1.0, 0.0)), share = place - first;
  vec3 n = normalize(turn * normal);
  float bias = 0.15 * min(steps.x, min(steps.y, steps.z)), total = 0.0;
  mat3 back = unit * turn * inverse(mat3(cells)); // from places of the grid to lengths of the probes' frame
  for (int corner = 0; corner < 8; corner++) {
    vec3 way = vec3(corner & 1, (corner >> 1) & 1, corner >> 2);
    ivec3 index = ivec3(min(first + way, last));
    int probe = index.x + counts.x * (index.y + counts.y * index.z);
    vec3 blend = mix(1.0 - share, share, way);
    vec3 offset = back * (here - vec3(index)); // from the probe to the point
    float facing = 0.5 * (1.0 - dot(normalize(offset), n));
    vec3 away = offset + bias * n;
    float r = length(away);
    vec2 seen = moments(probe, away / max(r, 1e-9));
    float variance = abs(seen.y - seen.x * seen.x), beyond = max(min(r, far) - seen.x, 0.0);
    float visible = beyond > 0.0 ? max(pow(variance / max(variance + beyond * beyond, 1e-12), 3.0), 0.05) : 1.0;
    float weight = (facing * facing + 0.2) * visible;
    weight *= pow(min(weight / 0.2, 1.0), 2.0);
    bool free = texelFetch(light, tile(probe) * ivec2(coefficients, 1), 0).w > 0.5;
    weights[corner] = blend.x * blend.y * blend.z * (free ? weight : 1e-4) + 1e-9;
    probes[corner] = probe;
    total += weights[corner];
  }
  for (int corner = 0; corner < 8; corner++) weights[corner] /= total;
}

// Sum of weighted harmonics along a direction; `band` weighs the bands.
vec3 summed(int[8] probes, float[8] weights, vec3 direction, vec4 band) {
  float[16] values = basis(normalize(turn * direction));
  vec3 sum = vec3(0.0);
  for (int k = 0; k < coefficients; k++) {
    float factor = values[k] * (k < 1 ? band.x : k < 4 ? band.y : k < 9 ? band.z : band.w);
    if (factor == 0.0) continue;
    for (int corner = 0; corner < 8; corner++)
      sum += weights[corner] * factor * texelFetch(light, tile(probes[corner]) * ivec2(coefficients, 1) + ivec2(k, 0), 0).rgb;
  }
  return max(sum, 0.0);
}

const vec4 RADIANCE = vec4(1.0), IRRADIANCE = vec4(PI, 2.0 * PI / 3.0, PI / 4.0, 0.0); // A_l, Ramamoorthi 2001

vec3 encoded(vec3 light) {
  light = clamp(light, 0.0, 1.0);
  return mix(1.055 * pow(max(light, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * light, vec3(lessThanEqual(light, vec3(0.0031308))));
}

vec3 decoded(vec3 rgb) {
  return mix(pow((max(rgb, 0.04045) + 0.055) / 1.055, vec3(2.4)), rgb / 12.92, vec3(lessThanEqual(rgb, vec3(0.04045))));
}
