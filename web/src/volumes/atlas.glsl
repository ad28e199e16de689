// Along a ray in steps of one voxel, over what is empty in leaps; then a small network, once (Hedman 2021, section 4).

uniform isampler3D blocks;   // where each block of the grid lies in the atlas; below 0 there is none
uniform usampler3D clear;    // how many cells from here on are empty
uniform sampler3D values;    // colour and alpha
uniform sampler3D features;
uniform float voxel, side, cell;  // scene units; voxels of a block; voxels of a cell
uniform ivec3 atlas;         // blocks along each axis of the textures

void main() {
  vec3 direction = normalize(mat3(pose) * vec3(place * slope, -1.0));
  vec3 origin = (pose[3].xyz - low) / voxel, inverse = inverted(direction);
  vec2 range = through(origin, inverse, side * vec3(textureSize(blocks, 0)));
  float t = max(range.x, near / voxel) + 0.5, light = 1.0;
  vec3 colour = vec3(0.0);
  vec4 feature = vec4(0.0);
  while (t < range.y && light > SPENT) {
    vec3 p = origin + t * direction;
    vec3 here = floor(p / cell);
    float far = float(texelFetch(clear, ivec3(here), 0).r);
    if (far > 0.0) {
      t += max(ceil(leaving(origin, inverse, (here - far + 1.0) * cell, (here + far) * cell) - t), 1.0);
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
    t += 1.0;
  }
#ifdef WIDTHS
  if (light < 1.0) colour += (1.0 - light) * seen(direction, colour, feature);
#endif
  picture = vec4(colour, 1.0 - light);
}
