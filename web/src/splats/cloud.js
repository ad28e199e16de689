// A cloud of Gaussians on the graphics card, drawn as `lumigraph render` draws it: footprints first, each in a texel, then
// their rectangles from the farthest to the nearest, blended in sRGB in numbers of 16 bits.

import { Matrix4, Vector2, Vector3 } from "three";
import fragment from "./footprint.frag.glsl";
import vertex from "./footprint.vert.glsl";
import projection from "./project.glsl";
import { Sorter } from "./sorter.js";

export const ROW = 1024; // Gaussians in a row of each texture
const BLUR = 0.3; // square pixels by which a footprint is widened
const WHOLE = "const vec2 CORNERS[3] = vec2[](vec2(-1), vec2(3, -1), vec2(-1, 3)); void main() { gl_Position = vec4(CORNERS[gl_VertexID], 0, 1); }";
const COPY = "precision highp float; uniform sampler2D drawn; out vec4 picture; void main() { picture = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0); }";
const [CLOUD, HARMONICS, MOTION, ORDER, SHAPES, LOOKS, DRAWN] = [0, 1, 2, 3, 4, 5, 6]; // units of textures

export class Cloud {
  // capacity: Gaussians at most;  placed: Matrix4 from the cloud's frame to the scene's, a similarity
  constructor(stage, { capacity, degree, antialiased, placed = new Matrix4(), moves = null }) {
    const gl = stage.renderer.getContext(), rows = Math.ceil(capacity / ROW);
    Object.assign(this, { stage, gl, rows, degree, antialiased, placed, moves, ranges: [], time: 0 });
    this.sorter = new Sorter(rows * ROW, ROW);
    if (moves) this.sorter.hold({ moves: moves.spans });
    this.begin();
  }

  // Programs and empty textures: at first, and again once a lost context is back.
  begin() {
    const { gl, rows, degree, moves, stage } = this;
    Object.assign(this, { count: 0, order: null, made: {}, sizes: {}, heights: 1 });
    this.deep = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
    this.programs = [[WHOLE, projection], [vertex, fragment], [WHOLE, COPY]].map(([v, f]) => program(gl, v, f));
    this.texture(CLOUD, gl.RGBA32UI, 2 * ROW, rows);
    this.texture(HARMONICS, gl.RGBA32UI, Math.max(1, degree * ROW), degree ? rows : 1);
    this.texture(MOTION, gl.RGBA32UI, ROW, moves ? rows : 1);
    this.frames = [0, 0].map(() => gl.createFramebuffer());
    this.corners = rectangles(gl);
    if (moves) this.fill(MOTION, 0, moves.texels, ROW);
    stage.renderer.resetState();
  }

  // A texture of a size on a unit of its own; as it is where it has that size.
  texture(unit, format, width, height) {
    const { gl } = this, size = [format, width, height].join();
    gl.activeTexture(gl.TEXTURE0 + unit);
    if (this.sizes[unit] !== size) {
      gl.deleteTexture(this.made[unit] ?? null);
      gl.bindTexture(gl.TEXTURE_2D, (this.made[unit] = gl.createTexture()));
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
      this.sizes[unit] = size;
    } else gl.bindTexture(gl.TEXTURE_2D, this.made[unit]);
    return this.made[unit];
  }

  // Numbers of whole rows, from a row on.
  fill(unit, row, numbers, width, format = this.gl.RGBA_INTEGER, channels = 4) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, this.made[unit]);
    plain(gl);
    const height = numbers.length / channels / width;
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, format, gl.UNSIGNED_INT, numbers);
  }

  // Packed Gaussians of whole rows, from a row on (see `packed`).
  hold(row, { numbers, harmonics, centres }) {
    this.fill(CLOUD, row, numbers, 2 * ROW);
    if (this.degree) this.fill(HARMONICS, row, harmonics, this.degree * ROW);
    this.sorter.hold({ at: row * ROW, centres });
    this.stage.renderer.resetState();
    this.order = null;
  }

  // Shows Gaussians begin <= i < end of each range, at a time in seconds.
  choose(ranges, time = this.time) {
    if (time === this.time && ranges.join() === this.ranges.join()) return;
    const chosen = ranges.reduce((sum, [begin, end]) => sum + end - begin, 0);
    Object.assign(this, { ranges, time, chosen, order: null });
  }

  // The order for the camera, after any that is under way; `order` names what it is for. Returns whether it is a new one.
  async arrange() {
    while (this.sorting) await this.sorting;
    this.stage.camera.updateMatrixWorld();
    const direction = new Vector3(0, 0, -1).transformDirection(this.stage.camera.matrixWorld);
    const wanted = direction.transformDirection(this.placed.clone().invert()).toArray();
    if (this.order?.every((value, i) => value === wanted[i])) return false;
    this.order = wanted;
    this.sorting = this.sort(wanted, this.ranges, this.time);
    await this.sorting;
    return true;
  }

  async sort(direction, ranges, time) {
    const { order, count } = await this.sorter.sort(direction, ranges, time);
    this.sorting = null;
    Object.assign(this, { count, shown: time });
    if (!count) return;
    this.heights = grown(order.length / ROW, this.heights);
    this.texture(ORDER, this.gl.R32UI, ROW, this.heights);
    this.fill(ORDER, 0, order, ROW, this.gl.RED_INTEGER, 1);
    this.stage.renderer.resetState();
  }

  paint() {
    const { gl, stage } = this, { camera, renderer } = stage;
    if (!this.count) return;
    const size = renderer.getDrawingBufferSize(new Vector2());
    camera.updateMatrixWorld();
    renderer.resetState();
    plain(gl);
    gl.bindVertexArray(this.corners);
    this.project(size);
    this.splat(size);
    renderer.resetState();
  }

  // Waits until everything is drawn.
  finish() {
    const { gl } = this;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  project(size) {
    const { gl, stage } = this, { camera } = stage;
    const forward = new Matrix4().makeScale(1, 1, -1).multiply(camera.matrixWorldInverse).multiply(this.placed);
    const eye = camera.position.clone().applyMatrix4(this.placed.clone().invert());
    const [across, , , , , up] = camera.projectionMatrix.elements;
    const put = this.use(0, { cloud: CLOUD, harmonics: HARMONICS, motion: MOTION, order: ORDER });
    gl.uniformMatrix4fv(put.place, false, forward.elements);
    gl.uniform3fv(put.eye, eye.toArray());
    gl.uniform2f(put.focal, (across * size.x) / 2, (up * size.y) / 2);
    gl.uniform2f(put.size, size.x, size.y);
    gl.uniform1f(put.near, camera.near);
    gl.uniform1f(put.time, this.shown);
    gl.uniform1f(put.blur, BLUR);
    gl.uniform1i(put.degree, this.degree);
    gl.uniform1i(put.count, this.count);
    gl.uniform1i(put.compensate, this.antialiased);
    gl.uniform1i(put.moves, this.moves !== null);
    this.onto(0, [SHAPES, LOOKS], gl.RGBA32UI, ROW, this.heights);
    gl.viewport(0, 0, ROW, Math.ceil(this.count / ROW));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  splat(size) {
    const { gl, deep } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (deep) {
      this.onto(1, [DRAWN], gl.RGBA16F, size.x, size.y);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
    }
    gl.viewport(0, 0, size.x, size.y);
    const put = this.use(1, { shapes: SHAPES, looks: LOOKS });
    gl.uniform2f(put.size, size.x, size.y);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * ROW, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / ROW));
    if (!deep) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.use(2, { drawn: DRAWN });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // A program with the textures that it reads. Returns the places of its numbers.
  use(which, textures) {
    const { gl } = this, { made, places } = this.programs[which];
    gl.useProgram(made);
    for (const [name, unit] of Object.entries(textures)) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.made[unit]);
      gl.uniform1i(places[name], unit);
    }
    return places;
  }

  // Draws from here on into textures of a size.
  onto(which, units, format, width, height) {
    const { gl } = this, changed = units.some((unit) => this.sizes[unit] !== [format, width, height].join());
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frames[which]);
    if (!changed) return;
    const places = units.map((unit, i) => {
      const texture = this.texture(unit, format, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      return gl.COLOR_ATTACHMENT0 + i;
    });
    gl.drawBuffers(places);
  }
}

// Corners of a row of rectangles, four each: an instance for each Gaussian would cost more than the Gaussian does.
function rectangles(gl) {
  const made = gl.createVertexArray(), numbers = new Uint16Array(6 * ROW);
  for (let i = 0; i < ROW; i++) numbers.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner), 6 * i);
  gl.bindVertexArray(made);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, numbers, gl.STATIC_DRAW);
  return made;
}

// Rows for as many, by doubling, so that textures seldom change their size.
function grown(rows, before = 1) {
  let height = before;
  while (height < rows) height *= 2;
  return height;
}

// Numbers go to textures as they are.
function plain(gl) {
  for (const name of [gl.UNPACK_FLIP_Y_WEBGL, gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL]) gl.pixelStorei(name, false);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
  for (const name of [gl.BLEND, gl.DEPTH_TEST, gl.CULL_FACE, gl.SCISSOR_TEST, gl.STENCIL_TEST]) gl.disable(name);
  gl.colorMask(true, true, true, true);
}

function program(gl, ...sources) {
  const made = gl.createProgram();
  sources.forEach((source, i) => {
    const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
    gl.shaderSource(shader, `#version 300 es\n#define ROW ${ROW}\n${source}`);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    const [log] = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader)).filter(Boolean);
    throw new Error(`This browser cannot draw the scene: ${log ?? gl.getProgramInfoLog(made)}`);
  }
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
  const names = Array.from({ length: count }, (_, i) => gl.getActiveUniform(made, i).name);
  return { made, places: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(made, name)])) };
}
