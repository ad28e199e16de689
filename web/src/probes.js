// A rendered picture with its depth, and in it a mesh that the mouse moves, lit by probes; it shades what is around it.

import { BufferAttribute, BufferGeometry, DataTexture, FloatType, GLSL3, LinearFilter, Matrix3, Matrix4, Mesh, NearestFilter, PlaneGeometry, Raycaster, RGBAFormat, RGFormat, ShaderMaterial, Sphere, Texture, Vector2, Vector3 } from "three";
import probes from "./probes/probes.glsl";
import { Stage } from "./stage.js";

const ZOOM = 1.06; // times, for each notch of the wheel
const MIN_SHADE = 0.003; // squared sine of the mesh's half angle below which it shades nothing

export async function start(settings, data) {
  const { parts, size, focal, pose, grid, mesh: about } = settings;
  const part = (name, kind) => new kind(data, parts[name][0], parts[name][1] / kind.BYTES_PER_ELEMENT);
  const image = await createImageBitmap(new Blob([part("picture", Uint8Array)]));
  const depth = part("depth", Float32Array), normals = part("normals", Uint8Array);

  const stage = new Stage(settings, { antialias: true });
  const eye = new Vector3(...pose.map((row) => row[3]));
  const [x, y, z] = [0, 1, 2].map((k) => new Vector3(...pose.map((row) => row[k])));
  const toWorld = new Matrix3().set(x.x, y.x, z.x, x.y, y.y, z.y, x.z, y.z, z.z);

  const floats = (values, width, format) => Object.assign(new DataTexture(values, width, values.length / width / (format === RGFormat ? 2 : 4), format, FloatType), { needsUpdate: true });
  const across = grid.across;
  const shared = {
    light: { value: floats(part("light", Float32Array), across * grid.coefficients, RGBAFormat) },
    distances: { value: floats(part("distances", Float32Array), across * (grid.side + 2), RGFormat) },
    cells: { value: new Matrix4().fromArray(grid.cells).transpose() },
    turn: { value: new Matrix3().fromArray(grid.turn).transpose() },
    steps: { value: new Vector3(...grid.steps) },
    unit: { value: grid.unit },
    counts: { value: grid.counts },
    coefficients: { value: grid.coefficients },
    side: { value: grid.side },
    across: { value: across },
    far: { value: grid.far },
  };

  // The picture, at its depth.
  const picture = Object.assign(new Texture(image), { flipY: false, minFilter: LinearFilter, generateMipmaps: false, needsUpdate: true });
  const one = (values, format, type) => Object.assign(new DataTexture(values, ...size, format, type), { minFilter: NearestFilter, magFilter: NearestFilter, needsUpdate: true });
  const wide = new Float32Array(2 * depth.length);
  depth.forEach((value, i) => (wide[2 * i] = value));
  const ball = { value: new Vector3() }, radius = { value: 0 };
  const behind = new ShaderMaterial({
    glslVersion: GLSL3,
    uniforms: {
      ...shared, picture: { value: picture }, depth: { value: one(wide, RGFormat, FloatType) }, normals: { value: one(normals, RGBAFormat) },
      toWorld: { value: toWorld }, eye: { value: eye }, focal: { value: new Vector2(...focal) }, size: { value: new Vector2(...size) },
      ball, radius, toClip: { value: new Matrix4() }, fromClip: { value: new Matrix4() }, background: { value: new Vector3(...settings.background) },
    },
    vertexShader: `out vec2 clip;
      void main() { clip = position.xy; gl_Position = vec4(position.xy, 0.0, 1.0); }`,
    fragmentShader: `${probes}
      in vec2 clip;
      out vec4 colour;
      uniform sampler2D picture, depth, normals;
      uniform mat3 toWorld;
      uniform mat4 toClip, fromClip;
      uniform vec3 eye, ball, background;
      uniform vec2 focal, size;
      uniform float radius;

      void main() {
        vec4 there = fromClip * vec4(clip, 1.0, 1.0);
        vec3 way = normalize(there.xyz / there.w - eye), local = way * toWorld;
        vec2 pixel = focal * local.xy / local.z + 0.5 * size;
        colour = vec4(background, 1.0);
        gl_FragDepth = 1.0;
        if (local.z <= 0.0 || any(lessThan(pixel, vec2(0.0))) || any(greaterThanEqual(pixel, size))) return;
        colour.rgb = texture(picture, pixel / size).rgb;
        float t = texelFetch(depth, ivec2(pixel), 0).x;
        if (t <= 0.0) return; // nothing is there
        vec3 point = eye + t * way;
        vec4 at = toClip * vec4(point, 1.0);
        gl_FragDepth = clamp(0.5 * at.z / at.w + 0.5, 0.0, 1.0);
        vec3 n = normalize(texelFetch(normals, ivec2(pixel), 0).xyz * 2.0 - 1.0), to = ball - point;
        float away = length(to), square = min(radius * radius / (away * away), 1.0), facing = dot(n, to / away);
        if (square < ${MIN_SHADE} || facing <= 0.0) return;
        int[8] some; float[8] weights;
        around(point, n, some, weights);
        vec3 all = max(summed(some, weights, n, IRRADIANCE), 1e-6);
        vec3 ratio = PI * summed(some, weights, to, RADIANCE) / all; // light from behind the ball to the mean light
        vec3 kept = square * facing * mix(ratio, vec3(1.0), square); // a near ball hides light from many sides
        colour.rgb = encoded(decoded(colour.rgb) * clamp(1.0 - kept, 0.0, 1.0));
      }`,
  });
  const plane = new Mesh(new PlaneGeometry(2, 2), behind);
  Object.assign(plane, { frustumCulled: false, renderOrder: -1 });
  stage.scene.add(plane);

  // The mesh in the probes' light.
  const geometry = new BufferGeometry();
  geometry.setIndex(new BufferAttribute(part("faces", Uint32Array), 1));
  geometry.setAttribute("position", new BufferAttribute(part("vertices", Float32Array), 3));
  geometry.setAttribute("normal", new BufferAttribute(part("vertexNormals", Float32Array), 3));
  geometry.setAttribute("albedo", new BufferAttribute(part("albedo", Float32Array), 3));
  const material = new ShaderMaterial({
    glslVersion: GLSL3,
    uniforms: shared,
    vertexShader: `in vec3 albedo;
      out vec3 point, facing, reflected;
      void main() {
        vec4 there = modelMatrix * vec4(position, 1.0);
        point = there.xyz;
        facing = mat3(modelMatrix) * normal;
        reflected = albedo;
        gl_Position = projectionMatrix * viewMatrix * there;
      }`,
    fragmentShader: `${probes}
      in vec3 point, facing, reflected;
      out vec4 colour;
      void main() {
        int[8] some; float[8] weights;
        vec3 n = normalize(facing);
        around(point, n, some, weights);
        colour = vec4(encoded(reflected / PI * summed(some, weights, n, IRRADIANCE)), 1.0);
      }`,
  });
  const mesh = new Mesh(geometry, material);
  stage.scene.add(mesh);

  const shape = { scale: about.scale };
  const place = () => {
    mesh.scale.setScalar(shape.scale);
    mesh.updateMatrixWorld();
    ball.value.copy(mesh.position);
    radius.value = about.radius * shape.scale;
    stage.redraw();
  };
  const put = (position, scale = shape.scale) => {
    mesh.position.fromArray(position);
    shape.scale = scale;
    place();
  };

  // The camera stands where the picture was taken; a window of another shape shows more background, not more picture.
  const angle = () => {
    const upright = Math.max(size[1] / focal[1], ((size[0] / focal[0]) * innerHeight) / innerWidth);
    return (360 / Math.PI) * Math.atan(upright / 2);
  };
  stage.paint = () => {
    stage.camera.updateMatrixWorld();
    behind.uniforms.toClip.value.multiplyMatrices(stage.camera.projectionMatrix, stage.camera.matrixWorldInverse);
    behind.uniforms.fromClip.value.copy(behind.uniforms.toClip.value).invert();
    stage.renderer.render(stage.scene, stage.camera);
  };
  const look = () => stage.setCamera(pose, angle());
  addEventListener("resize", look);

  // Dragging moves the mesh over what is behind it; the wheel makes it larger or smaller.
  const canvas = stage.renderer.domElement, ray = new Raycaster();
  const aim = (event) => ray.setFromCamera(new Vector2((2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight), stage.camera);
  let held = false;
  canvas.addEventListener("pointerdown", (event) => {
    aim(event);
    held = ray.ray.intersectsSphere(new Sphere(mesh.position, radius.value));
    if (held) canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointerup", () => (held = false));
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    aim(event);
    const way = ray.ray.direction;
    const [u, v, w] = [x, y, z].map((axis) => way.dot(axis));
    const [column, row] = [Math.floor((focal[0] * u) / w + size[0] / 2), Math.floor((focal[1] * v) / w + size[1] / 2)];
    if (w <= 0 || column < 0 || row < 0 || column >= size[0] || row >= size[1]) return;
    const pixel = row * size[0] + column;
    if (!(depth[pixel] > 0)) return;
    const n = new Vector3(...[0, 1, 2].map((k) => normals[4 * pixel + k] / 127.5 - 1)).normalize();
    mesh.position.copy(eye).addScaledVector(way, depth[pixel]).addScaledVector(n, about.lift * shape.scale);
    place();
  });
  const resize = (factor) => {
    shape.scale *= factor;
    place();
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    resize(event.deltaY < 0 ? ZOOM : 1 / ZOOM);
  }, { passive: false });
  stage.press = (event) => {
    if (event.key === "+" || event.key === "=") resize(ZOOM);
    if (event.key === "-") resize(1 / ZOOM);
  };

  stage.put = put;
  stage.reset = () => {
    put(about.position, about.scale);
    look();
  };
  stage.reset();
  return stage;
}
