// A canvas, a camera that a person turns around the scene, and a picture drawn only when something has changed.

import { BackSide, Color, ColorManagement, LinearSRGBColorSpace, MathUtils, Matrix4, Mesh, PerspectiveCamera, Scene, ShaderMaterial, SphereGeometry, Spherical, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const DENSEST = 2; // physical pixels to a CSS pixel; more cost much and show little
const TURN = 0.06; // radians for each press of a key
const ZOOM = 1.08; // times, likewise

// Colours are what the photographs hold, sRGB-encoded, and are blended as they are.
ColorManagement.enabled = false;

export class Stage {
  constructor(settings, { antialias }) {
    this.settings = settings;
    this.density = 1; // share of the screen's pixels on each side, for rough pictures
    this.renderer = new WebGLRenderer({ antialias, alpha: false, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = LinearSRGBColorSpace; // no second encoding
    this.clear();
    this.scene = new Scene();
    if (settings.sky) this.scene.add(sky(settings));
    this.camera = new PerspectiveCamera(50, 1, settings.near, settings.far);
    this.camera.up.set(0, 0, 1);
    this.paint = () => this.renderer.render(this.scene, this.camera);
    this.arranged = async () => {}; // to await: what must be put in order before a camera's picture is right
    this.sorted = async () => {}; // and what of that is under way
    this.revive = async () => {}; // to await, once the context is back: further things on the graphics card
    this.sharpening = null; // while a coarse picture is shown, and a better one being drawn

    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", settings.title);
    canvas.addEventListener("webglcontextlost", () => document.body.classList.remove("open"));
    canvas.addEventListener("webglcontextrestored", async () => {
      this.clear(); // three.js has forgotten it
      await this.revive();
      this.redraw();
      document.body.classList.add("open");
    });
    document.getElementById("stage").append(canvas);

    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, {
      enableDamping: !matchMedia("(prefers-reduced-motion: reduce)").matches,
      dampingFactor: 0.08,
      rotateSpeed: settings.inward ? 0.7 : -0.35, // looking outward, the scene is dragged along
      minDistance: settings.nearest,
      maxDistance: settings.farthest,
      enableZoom: settings.inward,
      maxPolarAngle: MathUtils.degToRad(settings.lowest),
      minPolarAngle: MathUtils.degToRad(2),
    });
    this.controls.addEventListener("change", () => this.redraw());
    canvas.addEventListener("keydown", (event) => this.press(event));
    addEventListener("resize", () => this.resize());
    this.angle = settings.angle;
    this.reset();
    this.resize();
  }

  clear() {
    this.renderer.setClearColor(new Color(...this.settings.background), 1);
  }

  // Where the page begins, looking at what the photographs look at.
  reset() {
    this.angle = this.settings.angle;
    this.free = null;
    this.controls.enabled = true;
    this.controls.target.fromArray(this.settings.target);
    this.camera.position.fromArray(this.settings.position);
    this.lens();
    this.controls.update();
    this.redraw();
  }

  // The browser enlarges a picture with fewer pixels than the screen has.
  draft(density) {
    if (density === this.density) return;
    this.density = density;
    this.renderer.setPixelRatio(density * ratio());
  }

  // Of the whole picture, pixels.
  get height() {
    return innerHeight * ratio();
  }

  resize() {
    this.renderer.setPixelRatio(this.density * ratio());
    this.renderer.setSize(innerWidth, innerHeight);
    this.lens();
    this.redraw();
  }

  // The angle of view holds across the smaller side, so that a phone held upright sees as much as one held across.
  lens() {
    const aspect = innerWidth / innerHeight;
    const across = Math.tan(MathUtils.degToRad(this.angle) / 2);
    const upright = 2 * MathUtils.radToDeg(Math.atan(across / Math.min(aspect, 1)));
    Object.assign(this.camera, { aspect, fov: this.free ?? upright });
    this.camera.updateProjectionMatrix();
  }

  redraw() {
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => {
      this.asked = null;
      if (this.controls.enabled) {
        this.controls.update(); // goes on, by way of `change`, until damping has come to rest
        this.stay();
      }
      this.paint();
    });
  }

  // Keeps the target within the scene and the camera above its floor, by moving both alike.
  stay() {
    const { inward, within, floor } = this.settings;
    if (!inward || !within) return;
    const [low, high] = within.map((corner) => new Vector3(...corner));
    const { target } = this.controls;
    const back = target.clone().clamp(low, high).sub(target);
    back.z += Math.max(0, (floor ?? -Infinity) - this.camera.position.z - back.z);
    target.add(back);
    this.camera.position.add(back);
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turns = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] };
    const zooms = { "+": 1 / ZOOM, "=": 1 / ZOOM, "-": ZOOM };
    if (event.key in turns) this.orbit(...turns[event.key], 1);
    else if (event.key in zooms) this.orbit(0, 0, zooms[event.key]);
    else return;
    event.preventDefault();
  }

  // Around the target by angles in radians, and away from it by a factor; the controls keep their limits.
  orbit(azimuth, polar, factor) {
    this.controls.enabled = true;
    const turned = new Matrix4().makeRotationX(Math.PI / 2); // Spherical has y upwards
    const offset = this.camera.position.clone().sub(this.controls.target).applyMatrix4(turned.clone().invert());
    const place = new Spherical().setFromVector3(offset);
    place.theta += azimuth;
    place.phi = Math.min(Math.max(place.phi + polar, 0.01), Math.PI - 0.01);
    if (this.settings.inward) place.radius *= factor;
    offset.setFromSpherical(place).applyMatrix4(turned);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.redraw();
  }

  // Exactly this camera, until the page is reset: a 3x4 camera-to-world pose with x right, y down, z forward, and the
  // vertical angle of view in degrees.
  async setCamera(pose, fov) {
    const [x, y, z, position] = [0, 1, 2, 3].map((k) => new Vector3(pose[0][k], pose[1][k], pose[2][k]));
    this.controls.enabled = false;
    this.free = fov;
    this.camera.position.copy(position);
    this.camera.quaternion.setFromRotationMatrix(new Matrix4().makeBasis(x, y.negate(), z.negate()));
    this.camera.updateMatrixWorld();
    this.lens();
    await this.arranged();
    this.paint();
    await this.rest();
  }

  // Until the picture no longer changes.
  async rest() {
    do {
      await this.sorted();
      await shown();
    } while (this.asked || this.sharpening);
  }
}

// A sphere around the camera, wherever it is: overhead, horizon and underfoot, by the height of the direction.
function sky({ sky: [overhead, underfoot], background, near, far }) {
  const colour = (rgb) => ({ value: new Vector3(...rgb) });
  const material = new ShaderMaterial({
    uniforms: { overhead: colour(overhead), horizon: colour(background), underfoot: colour(underfoot) },
    vertexShader: `varying vec3 direction;
      void main() {
        direction = position;
        gl_Position = projectionMatrix * vec4(mat3(viewMatrix) * position, 1.0);
      }`,
    fragmentShader: `uniform vec3 overhead, horizon, underfoot;
      varying vec3 direction;
      void main() {
        float height = normalize(direction).z;
        vec3 colour = mix(horizon, height > 0.0 ? overhead : underfoot, smoothstep(0.0, 0.5, abs(height)));
        gl_FragColor = vec4(colour, 1.0);
      }`,
    side: BackSide,
    depthTest: false,
    depthWrite: false,
  });
  const sphere = new Mesh(new SphereGeometry(Math.sqrt(near * far), 32, 16), material);
  Object.assign(sphere, { frustumCulled: false, renderOrder: -1 });
  return sphere;
}

const ratio = () => Math.min(devicePixelRatio, DENSEST);

// Until what was painted is on the screen.
export function shown() {
  return new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
}
