/*
Lumigraph's page program

Built from web/ by `npm ci && npm run build`. Do not edit.
*/
var lumigraphProgram=(()=>{var X=Object.create;var z=Object.defineProperty;var K=Object.getOwnPropertyDescriptor;var Y=Object.getOwnPropertyNames;var Z=Object.getPrototypeOf,J=Object.prototype.hasOwnProperty;var Q=(r,e)=>()=>{try{return e||r((e={exports:{}}).exports,e),e.exports}catch(n){throw e=0,n}},ee=(r,e)=>{for(var n in e)z(r,n,{get:e[n],enumerable:!0})},O=(r,e,n,t)=>{if(e&&typeof e=="object"||typeof e=="function")for(let i of Y(e))!J.call(r,i)&&i!==n&&z(r,i,{get:()=>e[i],enumerable:!(t=K(e,i))||t.enumerable});return r};var R=(r,e,n)=>(n=r!=null?X(Z(r)):{},O(e||!r||!r.__esModule?z(n,"default",{value:r,enumerable:!0}):n,r)),te=r=>O(z({},"__esModule",{value:!0}),r);var D=Q((Re,L)=>{L.exports=lumigraphStage});var De={};ee(De,{start:()=>Se});var E=R(D(),1),H=R(D(),1);var j=`// Along a ray in steps of one voxel, over what is empty in leaps; then a small network, once (Hedman 2021, section 4).

uniform isampler3D blocks;   // where each block of the grid lies in the atlas; below 0 there is none
uniform usampler3D clear;    // how many cells from here on are empty
uniform sampler3D values;    // colour and alpha
uniform sampler3D features;
uniform float voxel, side, cell;  // scene units; voxels of a block; voxels of a cell
uniform ivec3 atlas;         // blocks along each axis of the textures

#ifdef CURVED
uniform float ball; // radius in voxels of the ball in the grid's middle beyond which all is contracted
const float SURE = 0.9, LEAST = 1e-3; // as lumigraph/kernels/block_march has them

vec3 placed(vec3 p) {
  p -= 2.0 * ball;
  float share = ball / max(length(p), ball);
  return 2.0 * ball + (2.0 - share) * share * p;
}

// So many steps further, each as long as brings the ray a voxel onward where it is contracted.
float later(float t, float steps, float along, float aside) {
  for (float i = 0.0; i < steps; i++) {
    float radius = sqrt(aside + (along + t) * (along + t)), share = ball / max(radius, ball);
    float speed = sqrt(1.0 + 4.0 * aside / (ball * ball) * (1.0 - share)) * share * ball;
    t += radius <= ball ? 1.0 : radius / max(speed - (along + t) / radius, LEAST);
  }
  return t;
}
#endif

void main() {
  vec3 direction = normalize(mat3(pose) * vec3(place * slope, -1.0));
  vec3 origin = (pose[3].xyz - low) / voxel, inverse = inverted(direction);
#ifdef CURVED
  vec2 range = vec2(0.0, ball * ball); // there the last voxel begins
  vec3 middle = origin - 2.0 * ball;
  float along = dot(middle, direction);
  middle -= along * direction;
  float aside = dot(middle, middle);
#else
  vec2 range = through(origin, inverse, side * vec3(textureSize(blocks, 0)));
#endif
  float t = max(range.x, near / voxel) + 0.5, light = 1.0;
  vec3 colour = vec3(0.0);
  vec4 feature = vec4(0.0);
  while (t < range.y && light > SPENT) {
    vec3 p = origin + t * direction;
#ifdef CURVED
    p = placed(p);
#endif
    vec3 here = floor(p / cell);
    float far = float(texelFetch(clear, ivec3(here), 0).r);
    if (far > 0.0) {
      vec3 lower = (here - far + 1.0) * cell, upper = (here + far) * cell;
#ifdef CURVED
      vec3 inside = min(p - lower, upper - p);
      t = later(t, max(floor(SURE * min(min(inside.x, inside.y), inside.z)), 1.0), along, aside);
#else
      t += max(ceil(leaving(origin, inverse, lower, upper) - t), 1.0);
#endif
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
#ifdef CURVED
    t = later(t, 1.0, along, aside);
#else
    t += 1.0;
#endif
  }
#ifdef WIDTHS
  if (light < 1.0) colour += (1.0 - light) * seen(direction, colour, feature);
#endif
  picture = vec4(colour, 1.0 - light);
}
`;var s=R(D(),1),T=1024,N={count:[1,s.RedIntegerFormat,s.UnsignedIntType,"R32UI"],number:[1,s.RedIntegerFormat,s.IntType,"R32I"],byte:[1,s.RedIntegerFormat,s.UnsignedByteType,"R8UI"],bytes:[4,s.RGBAFormat,s.UnsignedByteType,"RGBA8"],halves:[2,s.RGFormat,s.HalfFloatType,"RG16F"],floats:[4,s.RGBAFormat,s.FloatType,"RGBA32F"]};function I(r,e,n=!1){let[,t,i,o]=N[e];return Object.assign(r,{format:t,type:i,internalFormat:o,unpackAlignment:1,needsUpdate:!0}),r.onUpdate=()=>r.image.data=null,n&&(r.minFilter=r.magFilter=s.LinearFilter),r}function k(r,e,[n,t,i],o){return I(new s.Data3DTexture(r,n,t,i),e,o)}function F(r,e){let[n]=N[e],t=Math.max(1,Math.ceil(r.length/n/T)),i=Math.min(t,T),o=Math.ceil(t/i),l=new r.constructor(T*i*o*n);return l.set(r),I(new s.DataArrayTexture(l,T,i,o),e)}function V(r,e,n){return I(new s.DataTexture(r,e,n),"floats")}function U(r){let e=0;return(n,t)=>{let i=new n(r,e,t);return e+=i.byteLength,i}}function C(r,e,n){let{grid:t,blocks:i,block:o,channels:l,voxel:d,cell:m,cells:f,network:u,contracted:c}=r,g=o+2,v=U(e),b=v(Int32Array,t[0]*t[1]*t[2]),M=v(Uint8Array,f[0]*f[1]*f[2]),x=v(Uint8Array,l*i*g**3),p=ne(i,Math.floor(n/g)),y=S=>k(ie(x,S,i,g,p),"bytes",p.map(q=>q*g),!0),w={blocks:k(b,"number",t),clear:k(M,"byte",f),values:y(0),voxel:d,side:o,cell:m,atlas:p},h=[j];if(c&&(w.ball=t[0]*o/4,h.unshift("#define CURVED")),!u)return{uniforms:w,fragment:h};let A=[u[0].weights.length,...u.map(S=>S.biases.length)];return Object.assign(w,{features:y(4),network:oe(u)}),{uniforms:w,fragment:["#define WIDTHS","uniform highp sampler2D network;",ae(A),...h]}}function ne(r,e){let n=Math.min(e,Math.max(1,Math.ceil(Math.cbrt(r)))),t=Math.min(e,Math.max(1,Math.ceil(Math.sqrt(r/n)))),i=Math.max(1,Math.ceil(r/(n*t)));if(i>e)throw new Error("This scene is larger than the graphics of this device can hold; open it on another one.");return[n,t,i]}function ie(r,e,n,t,[i,o,l]){let d=new Uint8Array(4*i*o*l*t**3),m=i*t,f=o*t;for(let u=0;u<4;u++)for(let c=0,g=(e+u)*n*t**3;c<n;c++){let[v,b,M]=[c%i,Math.floor(c/i)%o,Math.floor(c/(i*o))];for(let x=0;x<t;x++)for(let p=0;p<t;p++){let y=4*(v*t+m*(b*t+p+f*(M*t+x)))+u;for(let w=0;w<t;w++,y+=4)d[y]=r[g++]}}return d}function oe(r){let e=Math.max(...r.map(i=>Math.ceil(i.biases.length/4))),n=r.flatMap(i=>[...i.weights,i.biases]),t=new Float32Array(4*e*n.length);return n.forEach((i,o)=>t.set(i,4*e*o)),V(t,e,n.length)}function ae([r,e,n,t]){let i=(o,l,d,m,f)=>`
    vec4 ${o}[${Math.ceil(d/4)}];
    for (int j = 0; j < ${Math.ceil(d/4)}; j++) {
      vec4 total = texelFetch(network, ivec2(j, ${m+l}), 0);
      for (int i = 0; i < ${l}; i++) total += ${f}[i / 4][i % 4] * texelFetch(network, ivec2(j, ${m} + i), 0);
      ${o}[j] = ${d===t&&o==="c"?"total":"max(total, 0.0)"};
    }`;return`vec3 seen(vec3 d, vec3 colour, vec4 feature) {
    vec4 x[${Math.ceil(r/4)}];
    float all[${4*Math.ceil(r/4)}];
    int n = 0;
    for (int k = 0; k < 3; k++) all[n++] = d[k];
    for (int octave = 0; octave < 4; octave++)
      for (int k = 0; k < 3; k++, n++) {
        all[n] = sin(d[k] * exp2(float(octave)));
        all[n + 12] = cos(d[k] * exp2(float(octave)));
      }
    n += 12;
    for (int k = 0; k < 3; k++) all[n++] = colour[k];
    for (int k = 0; k < 4; k++) all[n++] = feature[k];
    for (int i = 0; i < ${r}; i++) x[i / 4][i % 4] = all[i];
    ${i("a",r,e,0,"x")}
    ${i("b",e,n,r+1,"a")}
    ${i("c",n,t,r+e+2,"b")}
    return 1.0 / (1.0 + exp(-c[0].rgb));
  }`}var W=`// Along a ray from cell to cell: what a cell holds is the same everywhere inside of it (Yu 2021, section 4).

uniform usampler3D entries;      // where to begin for each cell of the entry level
uniform usampler2DArray cells;   // eight of every node: nothing, the number of a leaf, or of a node further down
uniform sampler2DArray thick;    // density and scale of every leaf
uniform float size;              // of the cube, in scene units
uniform float entry;             // cells of the entry level along its side
uniform float crumb;             // a length that is nothing to any cell

const uint NODE = 0x80000000u, LEAF = 0x40000000u, NUMBER = 0x3ffffffu;

// The cell around a place, as a leaf's number (LEAF set) or 0, with its corners.
uint find(vec3 p, out vec3 lower, out vec3 upper) {
  ivec3 cell = clamp(ivec3(p), ivec3(0), ivec3(entry) - 1);
  uint found = texelFetch(entries, cell, 0).r;
  float side = 1.0;
  lower = vec3(cell);
  if (found < LEAF) { // empty, and so are all cells nearer than that
    upper = lower + float(found);
    lower -= float(found) - 1.0;
    return 0u;
  }
  if (found < NODE) { // a leaf, perhaps larger
    side = exp2(float((found >> 26) & 15u));
    lower = floor(lower / side) * side;
    upper = lower + side;
    return found;
  }
  while (found >= NODE) {
    side *= 0.5;
    vec3 further = step(lower + side, p);
    lower += further * side;
    found = texelFetch(cells, at(8u * (found & NUMBER) + uint(dot(further, vec3(4.0, 2.0, 1.0)))), 0).r;
  }
  upper = lower + side;
  return found;
}

void main() {
  vec3 direction = normalize(mat3(pose) * vec3(place * slope, -1.0));
  vec3 origin = (pose[3].xyz - low) * (entry / size), d = direction * (entry / size), inverse = inverted(d);
  float basis[BASES] = harmonics(direction);
  vec2 range = through(origin, inverse, vec3(entry));
  float t = max(range.x, near), light = 1.0;
  vec3 colour = vec3(0.0);
  while (t < range.y && light > SPENT) {
    vec3 lower, upper;
    uint leaf = find(origin + (t + crumb) * d, lower, upper);
    float end = max(leaving(origin, inverse, lower, upper), t + crumb);
    if (leaf != 0u) {
      uint i = leaf & NUMBER;
      vec2 held = texelFetch(thick, at(i), 0).rg;
      float left = light * exp(-held.x * (min(end, range.y) - t));
      colour += (light - left) / (1.0 + exp(-held.y * sum(TEXELS * i, basis)));
      light = left;
    }
    t = end;
  }
  picture = vec4(colour, 1.0 - light);
}
`;var se=1,ce=2,$=2147483648,he=1073741824,fe=.002,ue=["0.28209479","-0.48860251 * y","0.48860251 * z","-0.48860251 * x","1.09254843 * x * y","-1.09254843 * y * z","0.31539157 * (3.0 * z * z - 1.0)","-1.09254843 * x * z","0.54627422 * (x * x - y * y)","-0.59004359 * y * (3.0 * x * x - y * y)","2.89061144 * x * y * z","-0.45704580 * y * (5.0 * z * z - 1.0)","0.37317633 * z * (5.0 * z * z - 3.0)","-0.45704580 * x * (5.0 * z * z - 1.0)","1.44530572 * z * (x * x - y * y)","-0.59004359 * x * (x * x - 3.0 * y * y)"];function G(r,e){let{nodes:n,leaves:t,bases:i,level:o,levels:l,size:d}=r,m=2**o,f=3*i,u=Math.ceil(f/4),c=U(e),[g,v]=[c(Uint16Array,t),c(Uint16Array,t)],[b,M,x]=[c(Uint8Array,8*n),c(Uint8Array,m**3),c(Uint8Array,t*f)],p=new Uint32Array(8*n);for(let h=0,A=0,S=1;h<p.length;h++)p[h]=b[h]===se?he+A++:b[h]===ce?$+S++:0;let y=new Uint16Array(2*t);for(let h=0;h<t;h++)[y[2*h],y[2*h+1]]=[g[h],v[h]];let w=new Uint8Array(4*u*t);for(let h=0;h<f;h++)for(let A=0;A<t;A++)w[4*u*A+h]=x[h*t+A];return{uniforms:{entries:k(de(p,M,o),"count",[m,m,m]),cells:F(p,"count"),thick:F(y,"halves"),colours:F(w,"bytes"),size:d,entry:m,crumb:fe*d/2**l},fragment:[`const int BASES = ${i};`,`const uint TEXELS = ${u}u;`,pe(i),W]}}function de(r,e,n){let t=new Uint32Array(e),i=2**n,o=(l,d,m,f,u)=>{let c=2**(n-d-1);for(let g=0;g<8;g++){let v=r[8*l+g],[b,M,x]=[m+c*(g>>2),f+c*(g>>1&1),u+c*(g&1)];if(v>=$&&c>1)o(v-$,d+1,b,M,x);else if(v>=$)t[b+i*(M+i*x)]=v;else if(v)for(let p=0;p<c**3;p++){let[y,w,h]=[p%c,Math.floor(p/c)%c,Math.floor(p/c**2)];t[b+y+i*(M+w+i*(x+h))]=v+Math.log2(c)*2**26}}};return o(0,0,0,0,0),t}function pe(r){let e=Array.from({length:Math.ceil(3*r/4)},(n,t)=>{let o=[0,1,2,3].map(l=>[4*t+l,"xyzw"[l]]).filter(([l])=>l<3*r).map(([l,d])=>`total.${"xyz"[l%3]} += basis[${Math.floor(l/3)}] * code.${d};`);return`code = (255.0 * texelFetch(colours, at(first + ${t}u), 0) - 128.0) / 127.0; ${o.join(" ")}`});return[`uniform highp sampler2DArray colours;
    ivec3 at(uint i) { return ivec3(i & 1023u, (i >> 10) & 1023u, i >> 20); }
    float[BASES] harmonics(vec3 d) {
      float x = d.x, y = d.y, z = d.z;
      return float[BASES](${ue.slice(0,r).join(", ")});
    }
    vec3 sum(uint first, float basis[BASES]) {
      vec3 total = vec3(0.0);
      vec4 code;
      ${e.join(`
      `)}
      return total;
    }`].join(`
`)}var a=R(D(),1),me=33,ge=66,ve=120,we=4096,xe=2304,ye=.8,be=4,Me="out vec2 place; void main() { place = position.xy; gl_Position = vec4(position, 1.0); }",B=class{constructor(e,n,t,i){Object.assign(this,{stage:e,update:i,turn:0,rate:null});let o=()=>new a.WebGLRenderTarget(1,1,{depthBuffer:!1,minFilter:a.LinearFilter,magFilter:a.LinearFilter});[this.rough,this.full]=[o(),o()],this.volume=new a.Scene().add(P(n,t,{blending:a.NoBlending})),this.shown=P({drawn:{value:null}},"precision highp float; uniform sampler2D drawn; in vec2 place; out vec4 picture; void main() { picture = texture(drawn, 0.5 + 0.5 * place); }",{blending:a.CustomBlending,blendSrc:a.OneFactor,blendDst:a.OneMinusSrcAlphaFactor,transparent:!0}),e.scene.add(this.shown)}begin(){this.update(),this.draw(this.rough,0,1),this.rate=null}paint(){let e=this.stage.renderer.getDrawingBufferSize(new a.Vector2),n=e.x*e.y,t=this.rate?Math.max(this.rate*me,xe):we,i=++this.turn;if(this.update(),t>ye*n){this.stage.sharpening=null,this.fit(this.full,e),this.draw(this.full,0,e.y),this.show(this.full);return}this.fit(this.rough,e.clone().multiplyScalar(Math.sqrt(t/n)).ceil()),this.draw(this.rough,0,this.rough.height),this.show(this.rough),this.stage.sharpening=this.sharpen(i,e)}async sharpen(e,n){if(await new Promise(t=>setTimeout(t,ve)),e===this.turn){this.fit(this.full,n);for(let t=0;t<n.y;){let i=Math.max(be,Math.floor(this.rate*ge/n.x));if(this.draw(this.full,t,i),t+=i,await new Promise(requestAnimationFrame),e!==this.turn)return}this.show(this.full),this.stage.sharpening=null}}fit(e,{x:n,y:t}){(e.width!==n||e.height!==t)&&e.setSize(n,t)}draw(e,n,t){let{renderer:i}=this.stage,o=performance.now();e.scissorTest=!0,e.scissor.set(0,n,e.width,t),i.setRenderTarget(e),i.render(this.volume,Ae),i.readRenderTargetPixels(e,0,n,1,1,Ee),i.setRenderTarget(null);let l=e.width*Math.min(t,e.height-n)/Math.max(performance.now()-o,.1);this.rate=this.rate?.5*(this.rate+l):l}show(e){this.shown.material.uniforms.drawn.value=e.texture,this.stage.renderer.render(this.stage.scene,this.stage.camera)}},Ae=new a.Camera,Ee=new Uint8Array(4);function P(r,e,n){let t=new a.BufferGeometry;t.setAttribute("position",new a.BufferAttribute(new Float32Array([-1,-1,0,3,-1,0,-1,3,0]),3));let i={glslVersion:a.GLSL3,vertexShader:Me,depthTest:!1,depthWrite:!1},o=new a.Mesh(t,new a.ShaderMaterial({uniforms:r,fragmentShader:e,...i,...n}));return Object.assign(o,{frustumCulled:!1,renderOrder:1})}var _=`precision highp float;
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
`;async function Se(r,e){let n=new H.Stage(r,{antialias:!1}),t=n.renderer.getContext(),i=t.getParameter(t.MAX_3D_TEXTURE_SIZE),o=r.volume==="octree"?G(r,e):C(r,e,i),l={pose:new E.Matrix4,slope:new E.Vector2,near:r.near,low:new E.Vector3(...r.low),...o.uniforms},d=Object.fromEntries(Object.entries(l).map(([f,u])=>[f,{value:u}])),m=new B(n,d,[_,...o.fragment].join(`
`),()=>{let{camera:f}=n,u=Math.tan(E.MathUtils.degToRad(f.fov)/2);f.updateMatrixWorld(),l.pose.copy(f.matrixWorld),l.slope.set(u*f.aspect,u)});return m.begin(),n.paint=()=>m.paint(),n.redraw(),n}return te(De);})();
