// min(0.99, opacity exp(-q / 2)), and nothing below 1/255, as kernels/rasterize has it.

precision highp float;

in vec2 place;
flat in vec4 colour;
out vec4 picture;

void main() {
  float opacity = colour.a * exp(-0.5 * dot(place, place));
  if (opacity < 1.0 / 255.0) discard;
  opacity = min(opacity, 0.99);
  picture = vec4(colour.rgb * opacity, opacity);
}
