/*
Lumigraph's page program

Built from web/ by `npm ci && npm run build`. Do not edit.
*/
var lumigraphProgram=(()=>{var we=Object.create;var k=Object.defineProperty;var ye=Object.getOwnPropertyDescriptor;var ge=Object.getOwnPropertyNames;var Ee=Object.getPrototypeOf,ve=Object.prototype.hasOwnProperty;var Te=(r,e)=>()=>{try{return e||r((e={exports:{}}).exports,e),e.exports}catch(o){throw e=0,o}},be=(r,e)=>{for(var o in e)k(r,o,{get:e[o],enumerable:!0})},K=(r,e,o,t)=>{if(e&&typeof e=="object"||typeof e=="function")for(let s of ge(e))!ve.call(r,s)&&s!==o&&k(r,s,{get:()=>e[s],enumerable:!(t=ye(e,s))||t.enumerable});return r};var z=(r,e,o)=>(o=r!=null?we(Ee(r)):{},K(e||!r||!r.__esModule?k(o,"default",{value:r,enumerable:!0}):o,r)),Ae=r=>K(k({},"__esModule",{value:!0}),r);var F=Te((Ze,Y)=>{Y.exports=lumigraphStage});var Ye={};be(Ye,{start:()=>Ve});var V=z(F(),1);function $(r,e,o){let[t,s,n,a]=[0,1,2,3].map(h=>new Float32Array(r,4*h*e,e)),i=new Uint16Array(r,16*e,3*e),f=new Uint32Array(4*o*Math.ceil(e/o)),c=new Float32Array(f.buffer),u=new Float32Array(3*e);for(let h=0;h<e;h++){for(let l=0;l<3;l++)u[3*h+l]=Re(i[l*e+h]);f[4*h]=i[h]|i[e+h]<<16,f[4*h+1]=i[2*e+h],c[4*h+2]=t[h],c[4*h+3]=a[h]}return{texels:f,spans:{begins:s,ends:n,middles:t,velocities:u}}}function Re(r){let e=r&32768?-1:1,o=r>>10&31,t=r&1023;return e*(o?2**(o-15)*(1+t/1024):2**-14*(t/1024))}function Z(r,e){let o=l=>document.getElementById(l),[t,s,n]=["play","moment","speed"].map(o);o("clock").hidden=!1;let a=0,i=null,f=l=>(a=Math.min(Math.max(l,0),e),s.value=a/e,r.setTime(a)),c=()=>document.body.classList.contains("playing"),u=async l=>{c()&&(i!==null&&await f((a+(l-i)/1e3*n.value)%e),i=l,requestAnimationFrame(u))},h=()=>{i=null;let l=document.body.classList.toggle("playing");t.setAttribute("aria-label",l?"Pause":"Play"),l&&requestAnimationFrame(u)};return t.onclick=h,s.oninput=()=>f(s.value*e),addEventListener("keydown",l=>{l.key!==" "||l.target===t||l.ctrlKey||l.metaKey||l.altKey||(l.preventDefault(),h())}),f}var U=z(F(),1);var J=`// min(0.99, opacity exp(-q / 2)), and nothing below 1/255, as kernels/rasterize has it.

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
`;var Q=`// The rectangle around the ellipse outside which a Gaussian adds less than 1/255 to any pixel.

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
`;var ee=`// Each Gaussian's footprint by local affine approximation, and its colour from here (Zwicker 2002; Kerbl 2023), as
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
`;function _e(r){let e=1<<r,o=new Float32Array(0),t=null,s,n,a,i;function f([u,h,l],y,g){let w=0;for(let[E,m]of y)for(let v=E;v<m;v++){let A=u*o[3*v]+h*o[3*v+1]+l*o[3*v+2];if(t){if(g<t.begins[v]||t.ends[v]<=g)continue;let{velocities:d}=t;A+=(g-t.middles[v])*(u*d[3*v]+h*d[3*v+1]+l*d[3*v+2])}s[w]=A,a[w++]=v}return w}function c(u,h){let l=1/0,y=-1/0;for(let m=0;m<u;m++)l=Math.min(l,s[m]),y=Math.max(y,s[m]);let g=(e*e-1)/Math.max(y-l,1e-30),w=new Uint32Array(e+1),E=new Uint32Array(e+1);for(let m=0;m<u;m++){let v=n[m]=(y-s[m])*g;w[(v&e-1)+1]++,E[(v>>>r)+1]++}for(let m=0;m<e;m++)w[m+1]+=w[m],E[m+1]+=E[m];for(let m=0;m<u;m++)i[w[n[m]&e-1]++]=m;for(let m=0;m<u;m++)h[E[n[i[m]]>>>r]++]=a[i[m]]}onmessage=({data:u})=>{if(u.capacity&&(o=new Float32Array(3*u.capacity)),u.centres&&o.set(u.centres,3*u.at),u.moves&&(t=u.moves),!u.direction)return;let h=u.ranges.reduce((g,[w,E])=>g+E-w,0);(!s||s.length<h)&&(s=new Float32Array(h),[n,a,i]=[0,0,0].map(()=>new Uint32Array(h)));let l=f(u.direction,u.ranges,u.time),y=new Uint32Array(u.row*Math.ceil(l/u.row));c(l,y),postMessage({order:y,count:l},[y.buffer])}}var I=class{constructor(e,o){let t=URL.createObjectURL(new Blob([`(${_e})(12)`],{type:"text/javascript"}));this.worker=new Worker(t),this.row=o,this.worker.postMessage({capacity:e})}hold(e){this.worker.postMessage(e)}sort(e,o,t){return new Promise(s=>{this.worker.onmessage=({data:n})=>s(n),this.worker.postMessage({direction:e,ranges:o,time:t,row:this.row})})}};var p=1024,Fe=.3,te="const vec2 CORNERS[3] = vec2[](vec2(-1), vec2(3, -1), vec2(-1, 3)); void main() { gl_Position = vec4(CORNERS[gl_VertexID], 0, 1); }",Oe=`precision highp float; uniform sampler2D drawn; uniform vec2 size, whole; out vec4 picture;
void main() {
  picture = size == whole ? texelFetch(drawn, ivec2(gl_FragCoord.xy), 0)
    : texture(drawn, min(gl_FragCoord.xy * size / whole, size - 0.5) / whole);
}`,[P,G,C,H,oe,re,ne]=[0,1,2,3,4,5,6],_=class{constructor(e,{capacity:o,degree:t,antialiased:s,placed:n=new U.Matrix4,moves:a=null}){let i=e.renderer.getContext(),f=Math.ceil(o/p);Object.assign(this,{stage:e,gl:i,degree:t,antialiased:s,placed:n,moves:a,ranges:[],time:0,count:0,made:{},sizes:{}}),this.deep=i.getExtension("EXT_color_buffer_float")??i.getExtension("EXT_color_buffer_half_float"),this.programs=[[te,ee],[Q,J],[te,Oe]].map(([c,u])=>Ie(i,c,u)),this.texture(P,i.RGBA32UI,2*p,f),this.texture(G,i.RGBA32UI,Math.max(1,t*p),t?f:1),this.texture(C,i.RGBA32UI,p,a?f:1),this.frames=[0,0].map(()=>i.createFramebuffer()),this.corners=ke(i),this.sorter=new I(f*p,p),a&&(this.fill(C,0,a.texels,p),this.sorter.hold({moves:a.spans})),e.renderer.resetState()}texture(e,o,t,s){let{gl:n}=this,a=[o,t,s].join();if(n.activeTexture(n.TEXTURE0+e),this.sizes[e]!==a){n.deleteTexture(this.made[e]??null),n.bindTexture(n.TEXTURE_2D,this.made[e]=n.createTexture()),n.texStorage2D(n.TEXTURE_2D,1,o,t,s);let i=o===n.RGBA16F?n.LINEAR:n.NEAREST;for(let f of[n.TEXTURE_MIN_FILTER,n.TEXTURE_MAG_FILTER])n.texParameteri(n.TEXTURE_2D,f,i);this.sizes[e]=a}else n.bindTexture(n.TEXTURE_2D,this.made[e]);return this.made[e]}fill(e,o,t,s,n=this.gl.RGBA_INTEGER,a=4){let{gl:i}=this;i.activeTexture(i.TEXTURE0+e),i.bindTexture(i.TEXTURE_2D,this.made[e]),se(i);let f=t.length/a/s;i.texSubImage2D(i.TEXTURE_2D,0,0,o,s,f,n,i.UNSIGNED_INT,t)}hold(e,{numbers:o,harmonics:t,centres:s}){this.fill(P,e,o,2*p),this.degree&&this.fill(G,e,t,this.degree*p),this.sorter.hold({at:e*p,centres:s}),this.stage.renderer.resetState(),this.order=null}choose(e,o=this.time){if(o===this.time&&e.join()===this.ranges.join())return;let t=e.reduce((s,[n,a])=>s+a-n,0);Object.assign(this,{ranges:e,time:o,chosen:t,order:null})}async arrange(){for(;this.sorting;)await this.sorting;this.stage.camera.updateMatrixWorld();let o=new U.Vector3(0,0,-1).transformDirection(this.stage.camera.matrixWorld).transformDirection(this.placed.clone().invert()).toArray();return this.order?.every((t,s)=>t===o[s])?!1:(this.order=o,this.sorting=this.sort(o,this.ranges,this.time),await this.sorting,!0)}async sort(e,o,t){let{order:s,count:n}=await this.sorter.sort(e,o,t);this.sorting=null,Object.assign(this,{count:n,shown:t}),n&&(this.heights=ze(s.length/p,this.heights),this.texture(H,this.gl.R32UI,p,this.heights),this.fill(H,0,s,p,this.gl.RED_INTEGER,1),this.stage.renderer.resetState())}paint(e){let{gl:o,stage:t}=this,{camera:s,renderer:n}=t;if(!this.count)return;let a=n.getDrawingBufferSize(new U.Vector2),i=this.deep?a.clone().multiplyScalar(e).ceil():a;s.updateMatrixWorld(),n.resetState(),se(o),o.bindVertexArray(this.corners),this.project(i),this.splat(i,a),n.resetState()}project(e){let{gl:o,stage:t}=this,{camera:s}=t,n=new U.Matrix4().makeScale(1,1,-1).multiply(s.matrixWorldInverse).multiply(this.placed),a=s.position.clone().applyMatrix4(this.placed.clone().invert()),[i,,,,,f]=s.projectionMatrix.elements,c=this.use(0,{cloud:P,harmonics:G,motion:C,order:H});o.uniformMatrix4fv(c.place,!1,n.elements),o.uniform3fv(c.eye,a.toArray()),o.uniform2f(c.focal,i*e.x/2,f*e.y/2),o.uniform2f(c.size,e.x,e.y),o.uniform1f(c.near,s.near),o.uniform1f(c.time,this.shown),o.uniform1f(c.blur,Fe),o.uniform1i(c.degree,this.degree),o.uniform1i(c.count,this.count),o.uniform1i(c.compensate,this.antialiased),o.uniform1i(c.moves,this.moves!==null),this.onto(0,[oe,re],o.RGBA32UI,p,this.heights),o.viewport(0,0,p,Math.ceil(this.count/p)),o.drawArrays(o.TRIANGLES,0,3)}splat(e,o){let{gl:t,deep:s}=this;t.bindFramebuffer(t.FRAMEBUFFER,null),t.enable(t.BLEND),t.blendFunc(t.ONE,t.ONE_MINUS_SRC_ALPHA),s&&(this.onto(1,[ne],t.RGBA16F,o.x,o.y),t.clearColor(0,0,0,0),t.clear(t.COLOR_BUFFER_BIT)),t.viewport(0,0,e.x,e.y);let n=this.use(1,{shapes:oe,looks:re});if(t.uniform2f(n.size,e.x,e.y),t.drawElementsInstanced(t.TRIANGLES,6*p,t.UNSIGNED_SHORT,0,Math.ceil(this.count/p)),!s)return;t.bindFramebuffer(t.FRAMEBUFFER,null),t.viewport(0,0,o.x,o.y);let a=this.use(2,{drawn:ne});t.uniform2f(a.size,e.x,e.y),t.uniform2f(a.whole,o.x,o.y),t.drawArrays(t.TRIANGLES,0,3)}use(e,o){let{gl:t}=this,{made:s,places:n}=this.programs[e];t.useProgram(s);for(let[a,i]of Object.entries(o))t.activeTexture(t.TEXTURE0+i),t.bindTexture(t.TEXTURE_2D,this.made[i]),t.uniform1i(n[a],i);return n}onto(e,o,t,s,n){let{gl:a}=this,i=o.some(c=>this.sizes[c]!==[t,s,n].join());if(a.bindFramebuffer(a.FRAMEBUFFER,this.frames[e]),!i)return;let f=o.map((c,u)=>{let h=this.texture(c,t,s,n);return a.framebufferTexture2D(a.FRAMEBUFFER,a.COLOR_ATTACHMENT0+u,a.TEXTURE_2D,h,0),a.COLOR_ATTACHMENT0+u});a.drawBuffers(f)}};function ke(r){let e=r.createVertexArray(),o=new Uint16Array(6*p);for(let t=0;t<p;t++)o.set([0,1,2,2,1,3].map(s=>4*t+s),6*t);return r.bindVertexArray(e),r.bindBuffer(r.ELEMENT_ARRAY_BUFFER,r.createBuffer()),r.bufferData(r.ELEMENT_ARRAY_BUFFER,o,r.STATIC_DRAW),e}function ze(r,e=1){let o=e;for(;o<r;)o*=2;return o}function se(r){for(let e of[r.UNPACK_FLIP_Y_WEBGL,r.UNPACK_PREMULTIPLY_ALPHA_WEBGL])r.pixelStorei(e,!1);r.pixelStorei(r.UNPACK_ALIGNMENT,4);for(let e of[r.BLEND,r.DEPTH_TEST,r.CULL_FACE,r.SCISSOR_TEST,r.STENCIL_TEST])r.disable(e);r.colorMask(!0,!0,!0,!0)}function Ie(r,...e){let o=r.createProgram();if(e.forEach((n,a)=>{let i=r.createShader(a?r.FRAGMENT_SHADER:r.VERTEX_SHADER);r.shaderSource(i,`#version 300 es
#define ROW ${p}
${n}`),r.compileShader(i),r.attachShader(o,i)}),r.linkProgram(o),!r.getProgramParameter(o,r.LINK_STATUS)){let[n]=r.getAttachedShaders(o).map(a=>r.getShaderInfoLog(a)).filter(Boolean);throw new Error(`This browser cannot draw the scene: ${n??r.getProgramInfoLog(o)}`)}let t=r.getProgramParameter(o,r.ACTIVE_UNIFORMS),s=Array.from({length:t},(n,a)=>r.getActiveUniform(o,a).name);return{made:o,places:Object.fromEntries(s.map(n=>[n,r.getUniformLocation(o,n)]))}}var O=z(F(),1);var Ne={shift:16,steps:2048},Le={shift:4,steps:8192},De=.28209479177387814,Be=16,ie=(r,{shift:e,steps:o})=>Math.min(Math.max(Math.round((r+e)*o),0),65535),ae=(r,e)=>Uint16Array.from({length:r},(o,t)=>e(t));function q(r,e){let o=p*Math.ceil(r/p),t=new Uint32Array(8*o),s=new Float32Array(t.buffer),n=new Uint32Array(4*e*o),a=new Float32Array(3*o);return{count:r,degree:e,numbers:t,harmonics:n,centres:a,put:(f,c,u,h,l,y,g,w)=>{let E=8*f;[s[E],s[E+1],s[E+2]]=[a[3*f],a[3*f+1],a[3*f+2]]=[c,u,h],t[E+3]=l[0]|l[1]<<16,t[E+4]=l[2]|y<<16,t[E+5]=g,t[E+6]=w[0]|w[1]<<16,t[E+7]=w[2]},bytes:new Uint8Array(n.buffer)}}var j=r=>ie(r,Ne),W=r=>ie(.5+De*r,Le);function ce(r){let e=new DataView(r),o=e.getUint32(8,!0),t=e.getUint8(12),s=2**-e.getUint8(13),n=3*((t+1)**2-1),a=Be,i=d=>new Uint8Array(r,(a+=d*o)-d*o,d*o),[f,c,u,h,l,y]=[9,1,3,3,4,n].map(i),[g,w]=[ae(256,d=>j(d/16-10)),ae(256,d=>W((d/255-.5)/.15))],E=q(o,t),m=[0,0,0],v=[0,0,0],A=d=>((f[d]<<8|f[d+1]<<16|f[d+2]<<24)>>8)*s;for(let d=0;d<o;d++){for(let x=0;x<3;x++)m[x]=g[h[3*d+x]],v[x]=w[u[3*d+x]];let M=4*d,T=l[M]|l[M+1]<<8|l[M+2]<<16|l[M+3]<<24;E.put(d,A(9*d),A(9*d+3),A(9*d+6),m,257*c[d],T,v);for(let x=0;x<n;x++)E.bytes[16*t*d+x]=y[n*d+x]}return E}var le=2,fe=64,Pe=[0,9,24,45];async function L(r,e){let o=await(await N(e)).json();if(o.version!==le)throw new Error(`${e.pathname} is SOG of version ${o.version}; write it again as version ${le}.`);let t=async T=>Ce(r,await(await N(new URL(T,e))).blob()),{means:s,scales:n,quats:a,sh0:i,shN:f}=o,c=[...s.files,...n.files,...a.files,...i.files,...f?.files??[]],[u,h,l,y,g,w,E]=await Promise.all(c.map(t)),m=f?.bands??0,v=q(o.count,m),A=n.codebook.map(j),d=i.codebook.map(W),M=(T,x)=>{let b=(u.data[T+x]+256*h.data[T+x])/65535,R=s.mins[x]+b*(s.maxs[x]-s.mins[x]);return Math.sign(R)*Math.expm1(Math.abs(R))};for(let T=0;T<o.count;T++){let x=4*T,[b,R]=[l.data,g.data],B=[A[b[x]],A[b[x+1]],A[b[x+2]]],S=[d[R[x]],d[R[x+1]],d[R[x+2]]];v.put(T,M(x,0),M(x,1),M(x,2),B,257*R[x+3],Ge(y.data,x),S)}if(m){let T=f.codebook.map(b=>Math.min(Math.max(Math.round(128+128*b),0),255)),x=Pe[m]/3;for(let b=0;b<o.count;b++){let R=E.data[4*b]+256*E.data[4*b+1],B=4*(R%fe*x+Math.floor(R/fe)*w.width);for(let S=0;S<3*x;S++)v.bytes[16*m*b+S]=T[w.data[B+4*Math.floor(S/3)+S%3]]}}return Object.assign(v,{antialiased:o.model==="antialiased"||o.antialias===!0})}function Ge(r,e){let o=r[e+3]-252;return(o?[1,2,0]:[0,1,2]).reduce((s,n)=>{let a=r[e+n]/255-.5;return s<<10|(a<0)<<9|Math.round(1022*Math.abs(a))},(o+3)%4)}async function Ce(r,e){let o=await createImageBitmap(e,{premultiplyAlpha:"none",colorSpaceConversion:"none"}),t=r.renderer.getContext(),{width:s,height:n}=o,[a,i,f]=[t.createTexture(),t.createFramebuffer(),new Uint8Array(4*s*n)];r.renderer.resetState();for(let c of[t.UNPACK_FLIP_Y_WEBGL,t.UNPACK_PREMULTIPLY_ALPHA_WEBGL])t.pixelStorei(c,!1);return t.bindTexture(t.TEXTURE_2D,a),t.texImage2D(t.TEXTURE_2D,0,t.RGBA,t.RGBA,t.UNSIGNED_BYTE,o),t.bindFramebuffer(t.FRAMEBUFFER,i),t.framebufferTexture2D(t.FRAMEBUFFER,t.COLOR_ATTACHMENT0,t.TEXTURE_2D,a,0),t.readPixels(0,0,s,n,t.RGBA,t.UNSIGNED_BYTE,f),t.deleteFramebuffer(i),t.deleteTexture(a),o.close(),r.renderer.resetState(),{data:f,width:s}}var He=1.5,qe=2,je=.1,We=1;async function ue(r,e,o){let t=new URL(e.stream,document.baseURI),s=await(await N(t)).json(),n=new X(r,t,s,o),a=n.files.filter(({level:c})=>c===n.coarsest),i=await L(r,new URL(a[0].name,t)),f=new O.Matrix4().fromArray(e.placed).transpose();n.begin(new _(r,{capacity:n.capacity,degree:i.degree,antialiased:i.antialiased,placed:f})),n.put(a[0],i);for(let c of a.slice(1))n.put(c,await L(r,new URL(c.name,t)));return{cloud:n.cloud,select:c=>n.select(c)}}async function N(r){let e=await fetch(r).catch(()=>null);if(e?.ok)return e;throw new Error(location.protocol==="file:"?"This page loads its scene over HTTP; serve its folder, for instance by `python -m http.server`, and open it there.":`${r.pathname} cannot be loaded; put the whole folder beside this page.`)}var X=class{constructor(e,o,t,s){let n=[...he(t.tree)],a=new Map;for(let l of n)for(let[y,g]of Object.entries(l.lods)){let w=a.get(g.file)??{name:t.filenames[g.file],level:+y,count:0,rows:0,at:null};w.count=Math.max(w.count,g.offset+g.count),w.rows=Math.ceil(w.count/p),a.set(g.file,w)}let i=[...a.values()],f=i.reduce((l,y)=>l+y.rows,0),c=Math.max(...i.map(l=>l.rows)),u=p*Math.min(f,Math.ceil(He*s/p)+c),h=Math.max(...i.map(({level:l})=>l));Object.assign(this,{stage:e,base:o,budget:s,leaves:n,files:i,used:a,capacity:u,coarsest:h,free:0,loading:0,clock:0})}begin(e){this.cloud=e,this.toLocal=e.placed.clone().invert()}put(e,o,t=this.room(e)){this.cloud.hold(t,o),e.at=t}room(e){if(this.free+e.rows<=this.capacity/p)return(this.free+=e.rows)-e.rows;let o=this.files.filter(n=>n.at!==null&&n.used<this.clock&&n.rows>=e.rows),[t]=o.filter(({level:n})=>n<this.coarsest).sort((n,a)=>n.used-a.used);if(!t)return null;let{at:s}=t;return t.at=null,s}select(e){this.clock++;let o=this.wanted(e*this.budget),t=[];for(let[s,n]of o){let i=Object.keys(s.lods).map(Number).filter(l=>this.used.get(s.lods[l].file).at!==null),f=Math.min(...i.filter(l=>l>=n),1/0),c=s.lods[f<1/0?f:Math.max(...i)];if(!c?.count)continue;let u=this.used.get(c.file),h=p*u.at+c.offset;u.used=this.clock,t.push([h,h+c.count])}return e===1&&this.load(o),Xe(t)}wanted(e){let{camera:o,renderer:t}=this.stage,s=o.position.clone().applyMatrix4(this.toLocal),n=o.getWorldDirection(new O.Vector3).transformDirection(this.toLocal),a=t.domElement.height/2*o.projectionMatrix.elements[5],i=new Map,f=[];for(let c of this.leaves){let u=s.clone().clamp(c.low,c.high),h=u.distanceTo(s),l=c.low.clone().add(c.high).multiplyScalar(.5).sub(s).dot(n)>-c.radius,y=Object.keys(c.lods).map(Number).sort((g,w)=>w-g);i.set(c,y[0]),e-=c.lods[y[0]].count;for(let g=1;g<y.length;g++){let[w,E]=[y[g-1],y[g]].map(v=>c.lods[v].count),m=a*c.radius/Math.sqrt(Math.max(w,1))/Math.max(h,.01*c.radius);f.push({leaf:c,level:y[g],cost:E-w,error:l?m:je*m})}}for(let{leaf:c,level:u,cost:h,error:l}of f.sort((y,g)=>g.error-y.error)){if(h>e||l<We)break;e-=h,i.set(c,u)}return i}async load(e){if(this.loading>=qe)return;let t=[...e].map(([n,a])=>this.used.get(n.lods[a].file)).find(n=>n.at===null&&!n.asked),s=t?this.room(t):null;if(s!==null){t.asked=!0,this.loading++;try{this.put(t,await L(this.stage,new URL(t.name,this.base)),s),t.asked=!1}catch(n){console.warn(n.message)}this.loading--,this.stage.redraw()}}};function*he(r){for(let t of r.children??[])yield*he(t);if(!Object.keys(r.lods??{}).length)return;let[e,o]=[r.bound.min,r.bound.max].map(t=>new O.Vector3(...t));yield{low:e,high:o,radius:.5*e.distanceTo(o),lods:r.lods}}function Xe(r){let e=[];for(let[o,t]of r.sort(([s],[n])=>s-n)){let s=e.at(-1);s&&s[1]===o?s[1]=t:e.push([o,t])}return e}function me(r){let e=matchMedia("(pointer: coarse)").matches&&Math.min(screen.width,screen.height)<800;return r.budget??(e?1e6:3e6)}var D=class{constructor(e){Object.assign(this,{rest:e,work:1,moving:!1,drawn:0})}get scale(){return this.moving?Math.sqrt(Math.max(this.work,.25)):1}get share(){return this.moving?2**Math.ceil(Math.log2(Math.min(1,this.work/.25))):1}learn(e){e>33?this.work=Math.max(.03125,this.work*33/e):e<.7*33&&(this.work=Math.min(1,1.1*this.work))}async follow(){let e=performance.now(),o=++this.drawn;await new Promise(requestAnimationFrame),this.moving&&this.learn(performance.now()-e),await new Promise(t=>setTimeout(t,150)),o===this.drawn&&await this.rest()}};var xe=z(F(),1);async function Ve(r,e){let o=new xe.Stage(r,{antialias:!1}),{gl:t,budget:s}=Ke(o,r);if(r.stream){let{cloud:h,select:l}=await ue(o,r,s);return await pe(o,h,l,t),o}let n=ce(await de(r.splats?e.slice(0,r.splats):e)),a=r.splats?$(await de(e.slice(r.splats)),n.count,p):null,i=new V.Matrix4().makeScale(1,-1,-1),f=new _(o,{...n,capacity:n.count,antialiased:r.antialiased,placed:i,moves:a});f.hold(0,n);let c=a?n.count:Math.min(s,n.count),u=await pe(o,f,h=>[[0,a?c:Math.ceil(h*c)]],t);return a&&(o.setTime=async h=>{u.moving=!0,f.choose(f.ranges,Math.min(h,r.duration*(1-1e-6))),await f.arrange(),o.redraw()},o.seek=Z(o,r.duration)),o}function Ke(r,e){let o=r.renderer.getContext();return{gl:o,budget:Math.min(me(e),p*o.getParameter(o.MAX_TEXTURE_SIZE))}}async function pe(r,e,o,t){let{paint:s,camera:n}=r,a=new V.Matrix4,i=new D(async()=>{await r.arranged(),r.paint()});r.arranged=async()=>{for(i.moving=!1,n.updateMatrixWorld(),a.copy(n.matrixWorld),e.choose(o(1));await e.arrange(););},r.sorted=async()=>{for(;e.sorting;)await e.sorting},r.paint=()=>{n.updateMatrixWorld(),a.equals(n.matrixWorld)||(i.moving=!0),a.copy(n.matrixWorld),e.choose(o(i.share));let c=()=>!e.sorting&&e.arrange().then(h=>h&&r.redraw());if(e.count>2*e.chosen)return c();if(s(),e.paint(i.scale),c(),!i.moving)return;let u=i.follow().finally(()=>r.sharpening===u&&(r.sharpening=null));r.sharpening=u},await r.arranged(),r.paint();let f=performance.now();return t.readPixels(0,0,1,1,t.RGBA,t.UNSIGNED_BYTE,new Uint8Array(4)),i.learn(performance.now()-f),i}function de(r){return new Response(new Blob([r]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer()}return Ae(Ye);})();
