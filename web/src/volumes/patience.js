// A picture that costs much: as large as a moment allows while the camera moves, then in full, a band at a time.

import { BufferAttribute, BufferGeometry, Camera, CustomBlending, GLSL3, LinearFilter, Mesh, NoBlending, OneFactor, OneMinusSrcAlphaFactor, Scene, ShaderMaterial, Vector2, WebGLRenderTarget } from "three";

const MOVING = 33, RESTING = 66; // milliseconds that a picture, or a band of one, may take
const PAUSE = 120; // milliseconds without change after which the camera counts as resting
const FIRST = 64 * 64; // pixels, before it is known what they cost
const FEWEST = 48 * 48; // pixels of a picture, however long they take
const LARGE = 0.8; // of the full picture's pixels: then it may as well be drawn in full
const ROWS = 4; // of a band, at least

const VERTEX = "out vec2 place; void main() { place = position.xy; gl_Position = vec4(position, 1.0); }";

export class Patience {
  // fragment: GLSL that writes `picture`, multiplied by opacity;  update: called before each picture
  constructor(stage, uniforms, fragment, update) {
    Object.assign(this, { stage, update, turn: 0, rate: null });
    const target = () => new WebGLRenderTarget(1, 1, { depthBuffer: false, minFilter: LinearFilter, magFilter: LinearFilter });
    [this.rough, this.full] = [target(), target()];
    this.volume = new Scene().add(screen(uniforms, fragment, { blending: NoBlending }));
    this.shown = screen(
      { drawn: { value: null } },
      "precision highp float; uniform sampler2D drawn; in vec2 place; out vec4 picture; void main() { picture = texture(drawn, 0.5 + 0.5 * place); }",
      { blending: CustomBlending, blendSrc: OneFactor, blendDst: OneMinusSrcAlphaFactor, transparent: true },
    );
    stage.scene.add(this.shown);
  }

  // Once, so that compiling and sending textures count for no picture.
  begin() {
    this.update();
    this.draw(this.rough, 0, 1);
    this.rate = null;
  }

  paint() {
    const size = this.stage.renderer.getDrawingBufferSize(new Vector2());
    const pixels = size.x * size.y, allowed = this.rate ? Math.max(this.rate * MOVING, FEWEST) : FIRST;
    const turn = ++this.turn;
    this.update();
    if (allowed > LARGE * pixels) {
      this.stage.sharpening = null;
      this.fit(this.full, size);
      this.draw(this.full, 0, size.y);
      this.show(this.full);
      return;
    }
    this.fit(this.rough, size.clone().multiplyScalar(Math.sqrt(allowed / pixels)).ceil());
    this.draw(this.rough, 0, this.rough.height);
    this.show(this.rough);
    this.stage.sharpening = this.sharpen(turn, size);
  }

  async sharpen(turn, size) {
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
    if (turn !== this.turn) return;
    this.fit(this.full, size);
    for (let row = 0; row < size.y; ) {
      const rows = Math.max(ROWS, Math.floor((this.rate * RESTING) / size.x));
      this.draw(this.full, row, rows);
      row += rows;
      await new Promise(requestAnimationFrame);
      if (turn !== this.turn) return;
    }
    this.show(this.full);
    this.stage.sharpening = null;
  }

  fit(target, { x, y }) {
    if (target.width !== x || target.height !== y) target.setSize(x, y);
  }

  // Some rows of the picture, and how long they took.
  draw(target, row, rows) {
    const { renderer } = this.stage, begin = performance.now();
    target.scissorTest = true;
    target.scissor.set(0, row, target.width, rows);
    renderer.setRenderTarget(target);
    renderer.render(this.volume, NOWHERE);
    renderer.readRenderTargetPixels(target, 0, row, 1, 1, PIXEL); // waits until it is drawn
    renderer.setRenderTarget(null);
    const rate = (target.width * Math.min(rows, target.height - row)) / Math.max(performance.now() - begin, 0.1);
    this.rate = this.rate ? 0.5 * (this.rate + rate) : rate;
  }

  show(target) {
    this.shown.material.uniforms.drawn.value = target.texture;
    this.stage.renderer.render(this.stage.scene, this.stage.camera);
  }
}

const NOWHERE = new Camera(), PIXEL = new Uint8Array(4);

// One triangle over all of the picture.
function screen(uniforms, fragmentShader, options) {
  const corners = new BufferGeometry();
  corners.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const more = { glslVersion: GLSL3, vertexShader: VERTEX, depthTest: false, depthWrite: false };
  const mesh = new Mesh(corners, new ShaderMaterial({ uniforms, fragmentShader, ...more, ...options }));
  return Object.assign(mesh, { frustumCulled: false, renderOrder: 1 });
}
