// Each Gaussian's footprint by local affine approximation, and its colour from here (Zwicker 2002; Kerbl 2023), as
// kernels/project computes them. One fragment is one Gaussian, in the order in which they are drawn.

precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D order, cloud, harmonics, motion; // ROW Gaussians in a row of each
uniform mat4 place; // the cloud's frame to the camera's: x right, y up, z forward
uniform vec3 eye; // in the cloud's frame
uniform vec2 focal, size; // pixels
uniform float near, time, blur;
uniform int degree, count;
uniform bool compensate, moves;

layout(location = 0) out uvec4 shape; // centre and longer axis, pixels
layout(location = 1) out uvec4 look; // shorter axis, colour, opacity

const float FAINTEST = 1.0 / 255.0;

// x, y, z, w: two bits name the largest, the others have a sign and 9 bits of sqrt(1/2).
vec4 quaternion(uint code) {
  uvec3 parts = uvec3(code >> 20, code >> 10, code);
  vec3 few = vec3(parts & 511u) * (sqrt(0.5) / 511.0) * (1.0 - 2.0 * vec3((parts >> 9) & 1u));
  float most = sqrt(max(0.0, 1.0 - dot(few, few)));
  uint largest = code >> 30;
  if (largest == 0u) return vec4(most, few);
  if (largest == 1u) return vec4(few.x, most, few.yz);
  if (largest == 2u) return vec4(few.xy, most, few.z);
  return vec4(few, most);
}

mat3 matrix(vec4 q) {
  vec3 s = 2.0 * q.xyz;
  vec3 squares = s * q.xyz, mixed = s.xxy * q.yzz, turned = s * q.w; // xy, xz, yz
  return mat3(1.0 - squares.y - squares.z, mixed.x + turned.z, mixed.y - turned.y,
              mixed.x - turned.z, 1.0 - squares.x - squares.z, mixed.z + turned.x,
              mixed.y + turned.y, mixed.z - turned.x, 1.0 - squares.x - squares.y);
}

uvec4 held[3];

// The k-th coefficient beyond degree 0: three bytes, 128 of which are zero.
vec3 coefficient(int k) {
  vec3 found;
  for (int c = 0; c < 3; c++) {
    int at = 3 * k + c;
    found[c] = float((held[at >> 4][(at >> 2) & 3] >> (8 * (at & 3))) & 255u);
  }
  return (found - 128.0) / 128.0;
}

vec3 seenFrom(vec3 d, ivec2 texel) {
  int texels = degree; // 9, 24 and 45 bytes
  for (int i = 0; i < texels; i++) held[i] = texelFetch(harmonics, ivec2(texels * texel.x + i, texel.y), 0);
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.4886025119 * (z * coefficient(1) - y * coefficient(0) - x * coefficient(2));
  if (degree == 1) return sum;
  sum += 1.0925484306 * (x * y * coefficient(3) - y * z * coefficient(4) - x * z * coefficient(6));
  sum += 0.3153915653 * (3.0 * zz - 1.0) * coefficient(5) + 0.5462742153 * (xx - yy) * coefficient(7);
  if (degree == 2) return sum;
  sum -= 0.5900435899 * (y * (3.0 * xx - yy) * coefficient(8) + x * (xx - 3.0 * yy) * coefficient(14));
  sum += 1.4453057213 * z * (2.0 * x * y * coefficient(9) + (xx - yy) * coefficient(13));
  sum -= 0.4570457995 * (5.0 * zz - 1.0) * (y * coefficient(10) + x * coefficient(12));
  return sum + 0.3731763326 * z * (5.0 * zz - 3.0) * coefficient(11);
}

void main() {
  shape = look = uvec4(0u);
  ivec2 here = ivec2(gl_FragCoord.xy);
  if (here.y * ROW + here.x >= count) return;
  int number = int(texelFetch(order, here, 0).x);
  ivec2 texel = ivec2(number % ROW, number / ROW);
  uvec4 first = texelFetch(cloud, ivec2(2 * texel.x, texel.y), 0), second = texelFetch(cloud, ivec2(2 * texel.x + 1, texel.y), 0);
  vec3 mean = uintBitsToFloat(first.xyz);
  float opacity = float(second.x >> 16) / 65535.0;
  if (moves) {
    uvec4 moved = texelFetch(motion, texel, 0);
    vec2 further = uintBitsToFloat(moved.zw); // middle, 1 / fade
    float away = time - further.x;
    mean += away * vec3(unpackHalf2x16(moved.x), unpackHalf2x16(moved.y).x);
    opacity *= exp(-0.5 * away * away * further.y * further.y);
  }
  vec3 p = (place * vec4(mean, 1.0)).xyz;
  if (p.z <= near || opacity <= FAINTEST) return;
  vec3 scales = exp(vec3(first.w & 65535u, first.w >> 16, second.x & 65535u) / 2048.0 - 16.0);
  mat3 axes = mat3(place) * matrix(quaternion(second.y));
  axes = mat3(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z);

  // Beyond the picture's margin, 0.15 of its size, the slope of the projection stays that of the margin.
  vec2 plane = p.xy / p.z, edge = 0.65 * size / focal, slope = clamp(plane, -edge, edge);
  mat3 rows = transpose(axes);
  vec3 across = focal.x / p.z * (rows[0] - slope.x * rows[2]), up = focal.y / p.z * (rows[1] - slope.y * rows[2]);
  vec3 normal = cross(across, up);
  float narrow = dot(normal, normal); // the determinant before blurring, without cancellation
  float a = dot(across, across) + blur, b = dot(across, up), c = dot(up, up) + blur;
  float determinant = narrow + blur * (a + c - blur);
  if (compensate) opacity *= sqrt(max(narrow / determinant, 1e-8));
  if (opacity <= FAINTEST) return;
  vec2 centre = focal * plane + 0.5 * size;
  vec2 extent = sqrt(2.0 * log(opacity / FAINTEST) * vec2(a, c));
  if (any(lessThan(centre + extent, vec2(0.5))) || any(greaterThan(centre - extent, size - 0.5))) return;

  float half_ = 0.5 * (a - c), apart = length(vec2(half_, b)), longer = 0.5 * (a + c) + apart;
  vec2 along = apart > 0.0 ? normalize(half_ > 0.0 ? vec2(half_ + apart, b) : vec2(b, apart - half_)) : vec2(1.0, 0.0);
  along *= sqrt(longer);
  vec3 colour = vec3(second.z & 65535u, second.z >> 16, second.w & 65535u) / 8192.0 - 4.0;
  if (degree > 0) colour += seenFrom(normalize(mean - eye), texel);
  colour = max(colour, 0.0);
  shape = floatBitsToUint(vec4(centre, along));
  look = uvec4(floatBitsToUint(sqrt(determinant / longer)), packHalf2x16(colour.rg), packHalf2x16(vec2(colour.b, 0.0)), floatBitsToUint(opacity));
}
