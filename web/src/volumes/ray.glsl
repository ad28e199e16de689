precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp sampler2DArray;
precision highp isampler3D;
precision highp usampler3D;
precision highp usampler2DArray;

uniform mat4 pose;        // camera to world, y up and z back
uniform vec2 slope;       // of the rays at the picture's edges
uniform float near;       // along the ray
uniform vec3 low;
in vec2 place;            // in the picture, from -1 to 1
out vec4 picture;         // multiplied by opacity

const float SPENT = 1.0 / 1024.0; // light at which a ray ends

// Where a ray enters and leaves a box from 0 to size.
vec2 through(vec3 origin, vec3 inverse, vec3 size) {
  vec3 a = -origin * inverse, b = (size - origin) * inverse;
  vec3 first = min(a, b), last = max(a, b);
  return vec2(max(max(first.x, first.y), first.z), min(min(last.x, last.y), last.z));
}

// Where a ray leaves a box.
float leaving(vec3 origin, vec3 inverse, vec3 lower, vec3 upper) {
  vec3 last = (mix(lower, upper, greaterThan(inverse, vec3(0.0))) - origin) * inverse;
  return min(min(last.x, last.y), last.z);
}

// One over each component, for none is quite 0.
vec3 inverted(vec3 direction) {
  return 1.0 / mix(direction, vec3(1e-9), lessThan(abs(direction), vec3(1e-9)));
}
