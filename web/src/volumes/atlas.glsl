// Along a ray in steps of one voxel, over what is empty in leaps; then a small network, once (Hedman 2021, section 4).

uniform isampler3D blocks;   // where each block of the grid lies in the atlas; below 0 there is none
uniform usampler3D clear;    // how many cells from here on are empty
uniform sampler3D values;    // colour and alpha
uniform sampler3D features;
uniform float voxel, side, cell;  // scene units; voxels of a block; voxels of a cell
uniform ivec3 atlas;         // blocks along each axis of the textures

#ifdef CURVED
uniform float ball; // radius in voxels of the ball in the grid's middle beyond which all is contracted
const float SURE = 0.9, LEAST = 1e-3; // as lumigraph/kernels/block_march has them

vec3 placed(vec3 p) {
  p -= 2.0 * ball;
  float share = ball / max(length(p), ball);
  return 2.0 * ball + (2.0 - share) * share * p;
}

// So many steps further, each as long as brings the ray a voxel onward where it is contracted.
float later(float t, float steps, float along, float aside) {
  for (float i = 0.0; i < steps; i++) {
    float radius = sqrt(aside + (along + t) * (along + t)), share = ball / max(radius, ball);
    float speed = sqrt(1.0 + 4.0 * aside / (ball * ball) * (1.0 - share)) * share * ball;
    t += radius <= ball ? 1.0 : radius / max(speed - (along + t) / radius, LEAST);
  }
  return t;
}
#endif

void main() {
  vec3 direction = normalize(mat3(pose) * vec3(place * slope, -1.0));
  vec3 origin = (pose[3].xyz - low) / voxel, inverse = inverted(direction);
#ifdef CURVED
  vec2 range = vec2(0.0, ball * ball); // there the last voxel begins
  vec3 middle = origin - 2.0 * ball;
  float along = dot(middle, direction);
  middle -= along * direction;
  float aside = dot(middle, middle);
#else
  vec2 range = through(origin, inverse, side * vec3(textureSize(blocks, 0)));
#endif
  float t = max(range.x, near / voxel) + 0.5, light = 1.0;
  vec3 colour = vec3(0.0);
  vec4 feature = vec4(0.0);
  while (t < range.y && light > SPENT) {
    vec3 p = origin + t * direction;
#ifdef CURVED
    p = placed(p);
#endif
    vec3 here = floor(p / cell);
    float far = float(texelFetch(clear, ivec3(here), 0).r);
    if (far > 0.0) {
      vec3 lower = (here - far + 1.0) * cell, upper = (here + far) * cell;
#ifdef CURVED
      vec3 inside = min(p - lower, upper - p);
      t = later(t, max(floor(SURE * min(min(inside.x, inside.y), inside.z)), 1.0), along, aside);
#else
      t += max(ceil(leaving(origin, inverse, lower, upper) - t), 1.0);
#endif
      continue;
    }
    vec3 block = floor(p / side);
    int i = texelFetch(blocks, ivec3(block), 0).r;
    if (i >= 0) {
      vec3 slot = vec3(i % atlas.x, (i / atlas.x) % atlas.y, i / (atlas.x * atlas.y));
      vec3 where = (slot * (side + 2.0) + 1.0 + p - block * side) / (vec3(atlas) * (side + 2.0));
      vec4 value = texture(values, where);
      colour += light * value.rgb;
#ifdef WIDTHS
      feature += light * texture(features, where);
#endif
      light *= 1.0 - value.a;
    }
#ifdef CURVED
    t = later(t, 1.0, along, aside);
#else
    t += 1.0;
#endif
  }
#ifdef WIDTHS
  if (light < 1.0) colour += (1.0 - light) * seen(direction, colour, feature);
#endif
  picture = vec4(colour, 1.0 - light);
}
