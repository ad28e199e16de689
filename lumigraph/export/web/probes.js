/*
Lumigraph's page program

Built from web/ by `npm ci && npm run build`. Do not edit.
*/
var lumigraphProgram=(()=>{var ne=Object.create;var A=Object.defineProperty;var se=Object.getOwnPropertyDescriptor;var ce=Object.getOwnPropertyNames;var le=Object.getPrototypeOf,de=Object.prototype.hasOwnProperty;var me=(r,a)=>()=>{try{return a||r((a={exports:{}}).exports,a),a.exports}catch(n){throw a=0,n}},fe=(r,a)=>{for(var n in a)A(r,n,{get:a[n],enumerable:!0})},X=(r,a,n,s)=>{if(a&&typeof a=="object"||typeof a=="function")for(let c of ce(a))!de.call(r,c)&&c!==n&&A(r,c,{get:()=>a[c],enumerable:!(s=se(a,c))||s.enumerable});return r};var Z=(r,a,n)=>(n=r!=null?ne(le(r)):{},X(a||!r||!r.__esModule?A(n,"default",{value:r,enumerable:!0}):n,r)),pe=r=>X(A({},"__esModule",{value:!0}),r);var W=me((ye,J)=>{J.exports=lumigraphStage});var xe={};fe(xe,{start:()=>ve});var e=Z(W(),1);var j=`// Light probes on a grid: interpolation with visibility (Majercik 2019), as lumigraph/probes/grid.py has it.

precision highp float;
precision highp int;

uniform sampler2D light;     // L_lm and, beside the first, 1 for a free probe: \`coefficients\` texels for each probe
uniform sampler2D distances; // mean and mean square, bordered octahedral maps
uniform mat4 cells;          // from the scene to places of the grid, where probe (i, j, k) is at (i, j, k)
uniform mat3 turn;           // from the scene's axes to those of the probes
uniform vec3 steps;          // lengths of the grid's axes, in the unit of the probes
uniform float unit;          // of the probes to one of the scene
uniform ivec3 counts;
uniform int coefficients, side, across; // across: probes in a row of either texture
uniform float far;

const float PI = 3.14159265;

// The sixteen harmonics of a direction, without the bands that the probes lack.
float[16] basis(vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  return float[16](
    0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (3.0 * z * z - 1.0), -1.09254843 * x * z,
    0.54627421 * (x * x - y * y),
    -0.59004359 * y * (3.0 * x * x - y * y), 2.89061144 * x * y * z, -0.45704579 * y * (5.0 * z * z - 1.0),
    0.37317633 * z * (5.0 * z * z - 3.0), -0.45704579 * x * (5.0 * z * z - 1.0), 1.44530572 * z * (x * x - y * y),
    -0.59004359 * x * (x * x - 3.0 * y * y));
}

vec2 octahedral(vec3 d) {
  d /= abs(d.x) + abs(d.y) + abs(d.z);
  vec2 way = vec2(d.x >= 0.0 ? 1.0 : -1.0, d.y >= 0.0 ? 1.0 : -1.0);
  return d.z >= 0.0 ? d.xy : (1.0 - abs(d.yx)) * way;
}

ivec2 tile(int probe) {
  return ivec2(probe % across, probe / across);
}

vec2 moments(int probe, vec3 d) {
  vec2 place = (octahedral(d) * 0.5 + 0.5) * float(side) + 0.5; // a border of one texel, less half a texel
  ivec2 first = clamp(ivec2(floor(place)), ivec2(0), ivec2(side));
  vec2 share = place - vec2(first);
  ivec2 corner = tile(probe) * (side + 2) + first;
  vec2 a = texelFetch(distances, corner, 0).xy, b = texelFetch(distances, corner + ivec2(1, 0), 0).xy;
  vec2 c = texelFetch(distances, corner + ivec2(0, 1), 0).xy, e = texelFetch(distances, corner + ivec2(1, 1), 0).xy;
  return mix(mix(a, b, share.x), mix(c, e, share.x), share.y);
}

// Weight of each of the eight probes around a point with a normal, and their numbers.
void around(vec3 point, vec3 normal, out int[8] probes, out float[8] weights) {
  vec3 last = vec3(counts) - 1.0;
  vec3 here = (cells * vec4(point, 1.0)).xyz;
  vec3 place = clamp(here, vec3(0.0), last), first = min(floor(place), max(last - 1.0, 0.0)), share = place - first;
  vec3 n = normalize(turn * normal);
  float bias = 0.15 * min(steps.x, min(steps.y, steps.z)), total = 0.0;
  mat3 back = unit * turn * inverse(mat3(cells)); // from places of the grid to lengths of the probes' frame
  for (int corner = 0; corner < 8; corner++) {
    vec3 way = vec3(corner & 1, (corner >> 1) & 1, corner >> 2);
    ivec3 index = ivec3(min(first + way, last));
    int probe = index.x + counts.x * (index.y + counts.y * index.z);
    vec3 blend = mix(1.0 - share, share, way);
    vec3 offset = back * (here - vec3(index)); // from the probe to the point
    float facing = 0.5 * (1.0 - dot(normalize(offset), n));
    vec3 away = offset + bias * n;
    float r = length(away);
    vec2 seen = moments(probe, away / max(r, 1e-9));
    float variance = abs(seen.y - seen.x * seen.x), beyond = max(min(r, far) - seen.x, 0.0);
    float visible = beyond > 0.0 ? max(pow(variance / max(variance + beyond * beyond, 1e-12), 3.0), 0.05) : 1.0;
    float weight = (facing * facing + 0.2) * visible;
    weight *= pow(min(weight / 0.2, 1.0), 2.0);
    bool free = texelFetch(light, tile(probe) * ivec2(coefficients, 1), 0).w > 0.5;
    weights[corner] = blend.x * blend.y * blend.z * (free ? weight : 1e-4) + 1e-9;
    probes[corner] = probe;
    total += weights[corner];
  }
  for (int corner = 0; corner < 8; corner++) weights[corner] /= total;
}

// Sum of weighted harmonics along a direction; \`band\` weighs the bands.
vec3 summed(int[8] probes, float[8] weights, vec3 direction, vec4 band) {
  float[16] values = basis(normalize(turn * direction));
  vec3 sum = vec3(0.0);
  for (int k = 0; k < coefficients; k++) {
    float factor = values[k] * (k < 1 ? band.x : k < 4 ? band.y : k < 9 ? band.z : band.w);
    if (factor == 0.0) continue;
    for (int corner = 0; corner < 8; corner++)
      sum += weights[corner] * factor * texelFetch(light, tile(probes[corner]) * ivec2(coefficients, 1) + ivec2(k, 0), 0).rgb;
  }
  return max(sum, 0.0);
}

const vec4 RADIANCE = vec4(1.0), IRRADIANCE = vec4(PI, 2.0 * PI / 3.0, PI / 4.0, 0.0); // A_l, Ramamoorthi 2001

vec3 encoded(vec3 light) {
  light = clamp(light, 0.0, 1.0);
  return mix(1.055 * pow(max(light, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * light, vec3(lessThanEqual(light, vec3(0.0031308))));
}

vec3 decoded(vec3 rgb) {
  return mix(pow((max(rgb, 0.04045) + 0.055) / 1.055, vec3(2.4)), rgb / 12.92, vec3(lessThanEqual(rgb, vec3(0.04045))));
}
`;var K=Z(W(),1),F=1.06,he=.003;async function ve(r,a){let{parts:n,size:s,focal:c,pose:k,grid:l,mesh:u}=r,d=(t,i)=>new i(a,n[t][0],n[t][1]/i.BYTES_PER_ELEMENT),Q=await createImageBitmap(new Blob([d("picture",Uint8Array)])),x=d("depth",Float32Array),N=d("normals",Uint8Array),o=new K.Stage(r,{antialias:!0}),_=new e.Vector3(...k.map(t=>t[3])),[g,y,b]=[0,1,2].map(t=>new e.Vector3(...k.map(i=>i[t]))),ee=new e.Matrix3().set(g.x,y.x,b.x,g.y,y.y,b.y,g.z,y.z,b.z),q=(t,i,p)=>Object.assign(new e.DataTexture(t,i,t.length/i/(p===e.RGFormat?2:4),p,e.FloatType),{needsUpdate:!0}),M=l.across,O={light:{value:q(d("light",Float32Array),M*l.coefficients,e.RGBAFormat)},distances:{value:q(d("distances",Float32Array),M*(l.side+2),e.RGFormat)},cells:{value:new e.Matrix4().fromArray(l.cells).transpose()},turn:{value:new e.Matrix3().fromArray(l.turn).transpose()},steps:{value:new e.Vector3(...l.steps)},unit:{value:l.unit},counts:{value:l.counts},coefficients:{value:l.coefficients},side:{value:l.side},across:{value:M},far:{value:l.far}},te=Object.assign(new e.Texture(Q),{flipY:!1,minFilter:e.LinearFilter,generateMipmaps:!1,needsUpdate:!0}),B=(t,i,p)=>Object.assign(new e.DataTexture(t,...s,i,p),{minFilter:e.NearestFilter,magFilter:e.NearestFilter,needsUpdate:!0}),U=new Float32Array(2*x.length);x.forEach((t,i)=>U[2*i]=t);let V={value:new e.Vector3},E={value:0},w=new e.ShaderMaterial({glslVersion:e.GLSL3,uniforms:{...O,picture:{value:te},depth:{value:B(U,e.RGFormat,e.FloatType)},normals:{value:B(N,e.RGBAFormat)},toWorld:{value:ee},eye:{value:_},focal:{value:new e.Vector2(...c)},size:{value:new e.Vector2(...s)},ball:V,radius:E,toClip:{value:new e.Matrix4},fromClip:{value:new e.Matrix4},background:{value:new e.Vector3(...r.background)}},vertexShader:`out vec2 clip;
      void main() { clip = position.xy; gl_Position = vec4(position.xy, 0.0, 1.0); }`,fragmentShader:`${j}
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
        if (square < ${he} || facing <= 0.0) return;
        int[8] some; float[8] weights;
        around(point, n, some, weights);
        vec3 all = max(summed(some, weights, n, IRRADIANCE), 1e-6);
        vec3 ratio = PI * summed(some, weights, to, RADIANCE) / all; // light from behind the ball to the mean light
        vec3 kept = square * facing * mix(ratio, vec3(1.0), square); // a near ball hides light from many sides
        colour.rgb = encoded(decoded(colour.rgb) * clamp(1.0 - kept, 0.0, 1.0));
      }`}),G=new e.Mesh(new e.PlaneGeometry(2,2),w);Object.assign(G,{frustumCulled:!1,renderOrder:-1}),o.scene.add(G);let h=new e.BufferGeometry;h.setIndex(new e.BufferAttribute(d("faces",Uint32Array),1)),h.setAttribute("position",new e.BufferAttribute(d("vertices",Float32Array),3)),h.setAttribute("normal",new e.BufferAttribute(d("vertexNormals",Float32Array),3)),h.setAttribute("albedo",new e.BufferAttribute(d("albedo",Float32Array),3));let re=new e.ShaderMaterial({glslVersion:e.GLSL3,uniforms:O,vertexShader:`in vec3 albedo;
      out vec3 point, facing, reflected;
      void main() {
        vec4 there = modelMatrix * vec4(position, 1.0);
        point = there.xyz;
        facing = mat3(modelMatrix) * normal;
        reflected = albedo;
        gl_Position = projectionMatrix * viewMatrix * there;
      }`,fragmentShader:`${j}
      in vec3 point, facing, reflected;
      out vec4 colour;
      void main() {
        int[8] some; float[8] weights;
        vec3 n = normalize(facing);
        around(point, n, some, weights);
        colour = vec4(encoded(reflected / PI * summed(some, weights, n, IRRADIANCE)), 1.0);
      }`}),m=new e.Mesh(h,re);o.scene.add(m);let f={scale:u.scale},I=()=>{m.scale.setScalar(f.scale),m.updateMatrixWorld(),V.value.copy(m.position),E.value=u.radius*f.scale,o.redraw()},Y=(t,i=f.scale)=>{m.position.fromArray(t),f.scale=i,I()},ae=()=>{let t=Math.max(s[1]/c[1],s[0]/c[0]*innerHeight/innerWidth);return 360/Math.PI*Math.atan(t/2)};o.paint=()=>{o.camera.updateMatrixWorld(),w.uniforms.toClip.value.multiplyMatrices(o.camera.projectionMatrix,o.camera.matrixWorldInverse),w.uniforms.fromClip.value.copy(w.uniforms.toClip.value).invert(),o.renderer.render(o.scene,o.camera)};let H=()=>o.setCamera(k,ae());addEventListener("resize",H);let v=o.renderer.domElement,C=new e.Raycaster,$=t=>C.setFromCamera(new e.Vector2(2*t.clientX/innerWidth-1,1-2*t.clientY/innerHeight),o.camera),z=!1;v.addEventListener("pointerdown",t=>{$(t),z=C.ray.intersectsSphere(new e.Sphere(m.position,E.value)),z&&v.setPointerCapture(t.pointerId)}),v.addEventListener("pointerup",()=>z=!1),v.addEventListener("pointermove",t=>{if(!z)return;$(t);let i=C.ray.direction,[p,oe,D]=[g,y,b].map(T=>i.dot(T)),[R,P]=[Math.floor(c[0]*p/D+s[0]/2),Math.floor(c[1]*oe/D+s[1]/2)];if(D<=0||R<0||P<0||R>=s[0]||P>=s[1])return;let L=P*s[0]+R;if(!(x[L]>0))return;let ie=new e.Vector3(...[0,1,2].map(T=>N[4*L+T]/127.5-1)).normalize();m.position.copy(_).addScaledVector(i,x[L]).addScaledVector(ie,u.lift*f.scale),I()});let S=t=>{f.scale*=t,I()};return v.addEventListener("wheel",t=>{t.preventDefault(),S(t.deltaY<0?F:1/F)},{passive:!1}),o.press=t=>{(t.key==="+"||t.key==="=")&&S(F),t.key==="-"&&S(1/F)},o.put=Y,o.reset=()=>{Y(u.position,u.scale),H()},o.reset(),o}return pe(xe);})();
