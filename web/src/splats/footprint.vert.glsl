// The rectangle around the ellipse outside which a Gaussian adds less than 1/255 to any pixel.

precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D shapes, looks;
uniform vec2 size; // pixels
out vec2 place; // standard deviations along both axes
flat out vec4 colour;

void main() {
  ivec2 texel = ivec2(gl_VertexID >> 2, gl_InstanceID);
  uvec4 look = texelFetch(looks, texel, 0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // not to be seen
  float opacity = uintBitsToFloat(look.w);
  if (opacity == 0.0) return;
  vec4 shape = uintBitsToFloat(texelFetch(shapes, texel, 0));
  colour = vec4(unpackHalf2x16(look.y), unpackHalf2x16(look.z).x, opacity);
  place = sqrt(2.0 * log(255.0 * opacity)) * (2.0 * vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) - 1.0);
  vec2 across = normalize(vec2(-shape.w, shape.z)) * uintBitsToFloat(look.x);
  gl_Position = vec4(2.0 * (shape.xy + place.x * shape.zw + place.y * across) / size - 1.0, 0.0, 1.0);
}
