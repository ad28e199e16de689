/*
Lumigraph's page program

Built from web/ by `npm ci && npm run build`. Do not edit.
*/
var lumigraphProgram=(()=>{var ye=Object.create;var O=Object.defineProperty;var ge=Object.getOwnPropertyDescriptor;var Ee=Object.getOwnPropertyNames;var ve=Object.getPrototypeOf,Te=Object.prototype.hasOwnProperty;var be=(r,e)=>()=>{try{return e||r((e={exports:{}}).exports,e),e.exports}catch(t){throw e=0,t}},Ae=(r,e)=>{for(var t in e)O(r,t,{get:e[t],enumerable:!0})},V=(r,e,t,o)=>{if(e&&typeof e=="object"||typeof e=="function")for(let s of Ee(e))!Te.call(r,s)&&s!==t&&O(r,s,{get:()=>e[s],enumerable:!(o=ge(e,s))||o.enumerable});return r};var I=(r,e,t)=>(t=r!=null?ye(ve(r)):{},V(e||!r||!r.__esModule?O(t,"default",{value:r,enumerable:!0}):t,r)),Re=r=>V(O({},"__esModule",{value:!0}),r);var F=be((Je,K)=>{K.exports=lumigraphStage});var $e={};Ae($e,{start:()=>Ke});var X=I(F(),1);function Y(r,e,t){let[o,s,n,a]=[0,1,2,3].map(h=>new Float32Array(r,4*h*e,e)),i=new Uint16Array(r,16*e,3*e),f=new Uint32Array(4*t*Math.ceil(e/t)),l=new Float32Array(f.buffer),u=new Float32Array(3*e);for(let h=0;h<e;h++){for(let c=0;c<3;c++)u[3*h+c]=Me(i[c*e+h]);f[4*h]=i[h]|i[e+h]<<16,f[4*h+1]=i[2*e+h],l[4*h+2]=o[h],l[4*h+3]=a[h]}return{texels:f,spans:{begins:s,ends:n,middles:o,velocities:u}}}function Me(r){let e=r&32768?-1:1,t=r>>10&31,o=r&1023;return e*(t?2**(t-15)*(1+o/1024):2**-14*(o/1024))}function $(r,e){let t=c=>document.getElementById(c),[o,s,n]=["play","moment","speed"].map(t);t("clock").hidden=!1;let a=0,i=null,f=c=>(a=Math.min(Math.max(c,0),e),s.value=a/e,r.setTime(a)),l=()=>document.body.classList.contains("playing"),u=async c=>{l()&&(i!==null&&await f((a+(c-i)/1e3*n.value)%e),i=c,requestAnimationFrame(u))},h=()=>{i=null;let c=document.body.classList.toggle("playing");o.setAttribute("aria-label",c?"Pause":"Play"),c&&requestAnimationFrame(u)};return o.onclick=h,s.oninput=()=>f(s.value*e),addEventListener("keydown",c=>{c.key!==" "||c.target===o||c.ctrlKey||c.metaKey||c.altKey||(c.preventDefault(),h())}),f}var _=I(F(),1);var Z=`// min(0.99, opacity exp(-q / 2)), and nothing below 1/255, as kernels/rasterize has it.

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
`;var J=`// The rectangle around the ellipse outside which a Gaussian adds less than 1/255 to any pixel.

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
`;var Q=`// Each Gaussian's footprint by local affine approximation, and its colour from here (Zwicker 2002; Kerbl 2023), as
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
`;function Fe(r){let e=1<<r,t=new Float32Array(0),o=null,s,n,a,i;function f([u,h,c],y,g){let w=0;for(let[E,m]of y)for(let v=E;v<m;v++){let A=u*t[3*v]+h*t[3*v+1]+c*t[3*v+2];if(o){if(g<o.begins[v]||o.ends[v]<=g)continue;let{velocities:d}=o;A+=(g-o.middles[v])*(u*d[3*v]+h*d[3*v+1]+c*d[3*v+2])}s[w]=A,a[w++]=v}return w}function l(u,h){let c=1/0,y=-1/0;for(let m=0;m<u;m++)c=Math.min(c,s[m]),y=Math.max(y,s[m]);let g=(e*e-1)/Math.max(y-c,1e-30),w=new Uint32Array(e+1),E=new Uint32Array(e+1);for(let m=0;m<u;m++){let v=n[m]=(y-s[m])*g;w[(v&e-1)+1]++,E[(v>>>r)+1]++}for(let m=0;m<e;m++)w[m+1]+=w[m],E[m+1]+=E[m];for(let m=0;m<u;m++)i[w[n[m]&e-1]++]=m;for(let m=0;m<u;m++)h[E[n[i[m]]>>>r]++]=a[i[m]]}onmessage=({data:u})=>{if(u.capacity&&(t=new Float32Array(3*u.capacity)),u.centres&&t.set(u.centres,3*u.at),u.moves&&(o=u.moves),!u.direction)return;let h=u.ranges.reduce((g,[w,E])=>g+E-w,0);(!s||s.length<h)&&(s=new Float32Array(h),[n,a,i]=[0,0,0].map(()=>new Uint32Array(h)));let c=f(u.direction,u.ranges,u.time),y=new Uint32Array(u.row*Math.ceil(c/u.row));l(c,y),postMessage({order:y,count:c},[y.buffer])}}var N=class{constructor(e,t){let o=URL.createObjectURL(new Blob([`(${Fe})(12)`],{type:"text/javascript"}));this.worker=new Worker(o),this.row=t,this.worker.postMessage({capacity:e})}hold(e){this.worker.postMessage(e)}sort(e,t,o){return new Promise(s=>{this.worker.onmessage=({data:n})=>s(n),this.worker.postMessage({direction:e,ranges:t,time:o,row:this.row})})}};var p=1024,ke=.3,ee="const vec2 CORNERS[3] = vec2[](vec2(-1), vec2(3, -1), vec2(-1, 3)); void main() { gl_Position = vec4(CORNERS[gl_VertexID], 0, 1); }",Oe="precision highp float; uniform sampler2D drawn; out vec4 picture; void main() { picture = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0); }",[B,P,G,C,te,oe,re]=[0,1,2,3,4,5,6],U=class{constructor(e,{capacity:t,degree:o,antialiased:s,placed:n=new _.Matrix4,moves:a=null}){let i=e.renderer.getContext(),f=Math.ceil(t/p);Object.assign(this,{stage:e,gl:i,rows:f,degree:o,antialiased:s,placed:n,moves:a,ranges:[],time:0}),this.sorter=new N(f*p,p),a&&this.sorter.hold({moves:a.spans}),this.begin()}begin(){let{gl:e,rows:t,degree:o,moves:s,stage:n}=this;Object.assign(this,{count:0,order:null,made:{},sizes:{},heights:1}),this.deep=e.getExtension("EXT_color_buffer_float")??e.getExtension("EXT_color_buffer_half_float"),this.programs=[[ee,Q],[J,Z],[ee,Oe]].map(([a,i])=>ze(e,a,i)),this.texture(B,e.RGBA32UI,2*p,t),this.texture(P,e.RGBA32UI,Math.max(1,o*p),o?t:1),this.texture(G,e.RGBA32UI,p,s?t:1),this.frames=[0,0].map(()=>e.createFramebuffer()),this.corners=Ie(e),s&&this.fill(G,0,s.texels,p),n.renderer.resetState()}texture(e,t,o,s){let{gl:n}=this,a=[t,o,s].join();if(n.activeTexture(n.TEXTURE0+e),this.sizes[e]!==a){n.deleteTexture(this.made[e]??null),n.bindTexture(n.TEXTURE_2D,this.made[e]=n.createTexture()),n.texStorage2D(n.TEXTURE_2D,1,t,o,s);for(let i of[n.TEXTURE_MIN_FILTER,n.TEXTURE_MAG_FILTER])n.texParameteri(n.TEXTURE_2D,i,n.NEAREST);this.sizes[e]=a}else n.bindTexture(n.TEXTURE_2D,this.made[e]);return this.made[e]}fill(e,t,o,s,n=this.gl.RGBA_INTEGER,a=4){let{gl:i}=this;i.activeTexture(i.TEXTURE0+e),i.bindTexture(i.TEXTURE_2D,this.made[e]),ne(i);let f=o.length/a/s;i.texSubImage2D(i.TEXTURE_2D,0,0,t,s,f,n,i.UNSIGNED_INT,o)}hold(e,{numbers:t,harmonics:o,centres:s}){this.fill(B,e,t,2*p),this.degree&&this.fill(P,e,o,this.degree*p),this.sorter.hold({at:e*p,centres:s}),this.stage.renderer.resetState(),this.order=null}choose(e,t=this.time){if(t===this.time&&e.join()===this.ranges.join())return;let o=e.reduce((s,[n,a])=>s+a-n,0);Object.assign(this,{ranges:e,time:t,chosen:o,order:null})}async arrange(){for(;this.sorting;)await this.sorting;this.stage.camera.updateMatrixWorld();let t=new _.Vector3(0,0,-1).transformDirection(this.stage.camera.matrixWorld).transformDirection(this.placed.clone().invert()).toArray();return this.order?.every((o,s)=>o===t[s])?!1:(this.order=t,this.sorting=this.sort(t,this.ranges,this.time),await this.sorting,!0)}async sort(e,t,o){let{order:s,count:n}=await this.sorter.sort(e,t,o);this.sorting=null,Object.assign(this,{count:n,shown:o}),n&&(this.heights=Ne(s.length/p,this.heights),this.texture(C,this.gl.R32UI,p,this.heights),this.fill(C,0,s,p,this.gl.RED_INTEGER,1),this.stage.renderer.resetState())}paint(){let{gl:e,stage:t}=this,{camera:o,renderer:s}=t;if(!this.count)return;let n=s.getDrawingBufferSize(new _.Vector2);o.updateMatrixWorld(),s.resetState(),ne(e),e.bindVertexArray(this.corners),this.project(n),this.splat(n),s.resetState()}finish(){let{gl:e}=this;e.readPixels(0,0,1,1,e.RGBA,e.UNSIGNED_BYTE,new Uint8Array(4))}project(e){let{gl:t,stage:o}=this,{camera:s}=o,n=new _.Matrix4().makeScale(1,1,-1).multiply(s.matrixWorldInverse).multiply(this.placed),a=s.position.clone().applyMatrix4(this.placed.clone().invert()),[i,,,,,f]=s.projectionMatrix.elements,l=this.use(0,{cloud:B,harmonics:P,motion:G,order:C});t.uniformMatrix4fv(l.place,!1,n.elements),t.uniform3fv(l.eye,a.toArray()),t.uniform2f(l.focal,i*e.x/2,f*e.y/2),t.uniform2f(l.size,e.x,e.y),t.uniform1f(l.near,s.near),t.uniform1f(l.time,this.shown),t.uniform1f(l.blur,ke),t.uniform1i(l.degree,this.degree),t.uniform1i(l.count,this.count),t.uniform1i(l.compensate,this.antialiased),t.uniform1i(l.moves,this.moves!==null),this.onto(0,[te,oe],t.RGBA32UI,p,this.heights),t.viewport(0,0,p,Math.ceil(this.count/p)),t.drawArrays(t.TRIANGLES,0,3)}splat(e){let{gl:t,deep:o}=this;t.bindFramebuffer(t.FRAMEBUFFER,null),t.enable(t.BLEND),t.blendFunc(t.ONE,t.ONE_MINUS_SRC_ALPHA),o&&(this.onto(1,[re],t.RGBA16F,e.x,e.y),t.clearColor(0,0,0,0),t.clear(t.COLOR_BUFFER_BIT)),t.viewport(0,0,e.x,e.y);let s=this.use(1,{shapes:te,looks:oe});t.uniform2f(s.size,e.x,e.y),t.drawElementsInstanced(t.TRIANGLES,6*p,t.UNSIGNED_SHORT,0,Math.ceil(this.count/p)),o&&(t.bindFramebuffer(t.FRAMEBUFFER,null),this.use(2,{drawn:re}),t.drawArrays(t.TRIANGLES,0,3))}use(e,t){let{gl:o}=this,{made:s,places:n}=this.programs[e];o.useProgram(s);for(let[a,i]of Object.entries(t))o.activeTexture(o.TEXTURE0+i),o.bindTexture(o.TEXTURE_2D,this.made[i]),o.uniform1i(n[a],i);return n}onto(e,t,o,s,n){let{gl:a}=this,i=t.some(l=>this.sizes[l]!==[o,s,n].join());if(a.bindFramebuffer(a.FRAMEBUFFER,this.frames[e]),!i)return;let f=t.map((l,u)=>{let h=this.texture(l,o,s,n);return a.framebufferTexture2D(a.FRAMEBUFFER,a.COLOR_ATTACHMENT0+u,a.TEXTURE_2D,h,0),a.COLOR_ATTACHMENT0+u});a.drawBuffers(f)}};function Ie(r){let e=r.createVertexArray(),t=new Uint16Array(6*p);for(let o=0;o<p;o++)t.set([0,1,2,2,1,3].map(s=>4*o+s),6*o);return r.bindVertexArray(e),r.bindBuffer(r.ELEMENT_ARRAY_BUFFER,r.createBuffer()),r.bufferData(r.ELEMENT_ARRAY_BUFFER,t,r.STATIC_DRAW),e}function Ne(r,e=1){let t=e;for(;t<r;)t*=2;return t}function ne(r){for(let e of[r.UNPACK_FLIP_Y_WEBGL,r.UNPACK_PREMULTIPLY_ALPHA_WEBGL])r.pixelStorei(e,!1);r.pixelStorei(r.UNPACK_ALIGNMENT,4);for(let e of[r.BLEND,r.DEPTH_TEST,r.CULL_FACE,r.SCISSOR_TEST,r.STENCIL_TEST])r.disable(e);r.colorMask(!0,!0,!0,!0)}function ze(r,...e){let t=r.createProgram();if(e.forEach((n,a)=>{let i=r.createShader(a?r.FRAGMENT_SHADER:r.VERTEX_SHADER);r.shaderSource(i,`#version 300 es
#define ROW ${p}
${n}`),r.compileShader(i),r.attachShader(t,i)}),r.linkProgram(t),!r.getProgramParameter(t,r.LINK_STATUS)){let[n]=r.getAttachedShaders(t).map(a=>r.getShaderInfoLog(a)).filter(Boolean);throw new Error(`This browser cannot draw the scene: ${n??r.getProgramInfoLog(t)}`)}let o=r.getProgramParameter(t,r.ACTIVE_UNIFORMS),s=Array.from({length:o},(n,a)=>r.getActiveUniform(t,a).name);return{made:t,places:Object.fromEntries(s.map(n=>[n,r.getUniformLocation(t,n)]))}}var k=I(F(),1);var Le={shift:16,steps:2048},De={shift:4,steps:8192},Be=.28209479177387814,Pe=16,ae=(r,{shift:e,steps:t})=>Math.min(Math.max(Math.round((r+e)*t),0),65535),se=(r,e)=>Uint16Array.from({length:r},(t,o)=>e(o));function H(r,e){let t=p*Math.ceil(r/p),o=new Uint32Array(8*t),s=new Float32Array(o.buffer),n=new Uint32Array(4*e*t),a=new Float32Array(3*t);return{count:r,degree:e,numbers:o,harmonics:n,centres:a,put:(f,l,u,h,c,y,g,w)=>{let E=8*f;[s[E],s[E+1],s[E+2]]=[a[3*f],a[3*f+1],a[3*f+2]]=[l,u,h],o[E+3]=c[0]|c[1]<<16,o[E+4]=c[2]|y<<16,o[E+5]=g,o[E+6]=w[0]|w[1]<<16,o[E+7]=w[2]},bytes:new Uint8Array(n.buffer)}}var j=r=>ae(r,Le),q=r=>ae(.5+Be*r,De);function ie(r){let e=new DataView(r),t=e.getUint32(8,!0),o=e.getUint8(12),s=2**-e.getUint8(13),n=3*((o+1)**2-1),a=Pe,i=d=>new Uint8Array(r,(a+=d*t)-d*t,d*t),[f,l,u,h,c,y]=[9,1,3,3,4,n].map(i),[g,w]=[se(256,d=>j(d/16-10)),se(256,d=>q((d/255-.5)/.15))],E=H(t,o),m=[0,0,0],v=[0,0,0],A=d=>((f[d]<<8|f[d+1]<<16|f[d+2]<<24)>>8)*s;for(let d=0;d<t;d++){for(let x=0;x<3;x++)m[x]=g[h[3*d+x]],v[x]=w[u[3*d+x]];let M=4*d,T=c[M]|c[M+1]<<8|c[M+2]<<16|c[M+3]<<24;E.put(d,A(9*d),A(9*d+3),A(9*d+6),m,257*l[d],T,v);for(let x=0;x<n;x++)E.bytes[16*o*d+x]=y[n*d+x]}return E}var ce=2,le=64,Ge=[0,9,24,45];async function fe(r,e){let t=await(await z(e)).json();if(t.version!==ce)throw new Error(`${e.pathname} is SOG of version ${t.version}; write it again as version ${ce}.`);let o=async T=>He(r,await(await z(new URL(T,e))).blob()),{means:s,scales:n,quats:a,sh0:i,shN:f}=t,l=[...s.files,...n.files,...a.files,...i.files,...f?.files??[]],[u,h,c,y,g,w,E]=await Promise.all(l.map(o)),m=f?.bands??0,v=H(t.count,m),A=n.codebook.map(j),d=i.codebook.map(q),M=(T,x)=>{let b=(u.data[T+x]+256*h.data[T+x])/65535,R=s.mins[x]+b*(s.maxs[x]-s.mins[x]);return Math.sign(R)*Math.expm1(Math.abs(R))};for(let T=0;T<t.count;T++){let x=4*T,[b,R]=[c.data,g.data],D=[A[b[x]],A[b[x+1]],A[b[x+2]]],S=[d[R[x]],d[R[x+1]],d[R[x+2]]];v.put(T,M(x,0),M(x,1),M(x,2),D,257*R[x+3],Ce(y.data,x),S)}if(m){let T=f.codebook.map(b=>Math.min(Math.max(Math.round(128+128*b),0),255)),x=Ge[m]/3;for(let b=0;b<t.count;b++){let R=E.data[4*b]+256*E.data[4*b+1],D=4*(R%le*x+Math.floor(R/le)*w.width);for(let S=0;S<3*x;S++)v.bytes[16*m*b+S]=T[w.data[D+4*Math.floor(S/3)+S%3]]}}return Object.assign(v,{antialiased:t.model==="antialiased"||t.antialias===!0})}function Ce(r,e){let t=r[e+3]-252;return(t?[1,2,0]:[0,1,2]).reduce((s,n)=>{let a=r[e+n]/255-.5;return s<<10|(a<0)<<9|Math.round(1022*Math.abs(a))},(t+3)%4)}async function He(r,e){let t=await createImageBitmap(e,{premultiplyAlpha:"none",colorSpaceConversion:"none"}),o=r.renderer.getContext(),{width:s,height:n}=t,[a,i,f]=[o.createTexture(),o.createFramebuffer(),new Uint8Array(4*s*n)];r.renderer.resetState();for(let l of[o.UNPACK_FLIP_Y_WEBGL,o.UNPACK_PREMULTIPLY_ALPHA_WEBGL])o.pixelStorei(l,!1);return o.bindTexture(o.TEXTURE_2D,a),o.texImage2D(o.TEXTURE_2D,0,o.RGBA,o.RGBA,o.UNSIGNED_BYTE,t),o.bindFramebuffer(o.FRAMEBUFFER,i),o.framebufferTexture2D(o.FRAMEBUFFER,o.COLOR_ATTACHMENT0,o.TEXTURE_2D,a,0),o.readPixels(0,0,s,n,o.RGBA,o.UNSIGNED_BYTE,f),o.deleteFramebuffer(i),o.deleteTexture(a),t.close(),r.renderer.resetState(),{data:f,width:s}}var je=1.5,qe=2,We=.1,Xe=1;async function ue(r,e,t){let o=new URL(e.stream,document.baseURI),s=await(await z(o)).json(),n=new W(r,o,s,t),a=n.files.filter(({level:u})=>u===n.coarsest),i=await n.unpacked(a[0]),f=new k.Matrix4().fromArray(e.placed).transpose();n.begin(new U(r,{capacity:n.capacity,degree:i.degree,antialiased:i.antialiased,placed:f})),n.put(a[0],i);let l=async u=>{for(let h of u)n.put(h,await n.unpacked(h))};return await l(a.slice(1)),r.revive=async()=>{n.begin(n.cloud),n.cloud.begin(),await l(a)},{cloud:n.cloud,select:u=>n.select(u)}}async function z(r){let e=await fetch(r).catch(()=>null);if(e?.ok)return e;throw new Error(location.protocol==="file:"?"This page loads its scene over HTTP; serve its folder, for instance by `python -m http.server`, and open it there.":`${r.pathname} cannot be loaded; put the whole folder beside this page.`)}var W=class{constructor(e,t,o,s){let n=[...he(o.tree)],a=new Map;for(let c of n)for(let[y,g]of Object.entries(c.lods)){let w=a.get(g.file)??{name:o.filenames[g.file],level:+y,count:0,rows:0,at:null};w.count=Math.max(w.count,g.offset+g.count),w.rows=Math.ceil(w.count/p),a.set(g.file,w)}let i=[...a.values()],f=i.reduce((c,y)=>c+y.rows,0),l=Math.max(...i.map(c=>c.rows)),u=p*Math.min(f,Math.ceil(je*s/p)+l),h=Math.max(...i.map(({level:c})=>c));Object.assign(this,{stage:e,base:t,budget:s,leaves:n,files:i,used:a,capacity:u,coarsest:h,free:0,loading:0,clock:0})}begin(e){for(let t of this.files)Object.assign(t,{at:null,asked:!1});Object.assign(this,{cloud:e,free:0,era:{}}),this.toLocal=e.placed.clone().invert()}unpacked(e){return fe(this.stage,new URL(e.name,this.base))}put(e,t,o=this.room(e)){this.cloud.hold(o,t),e.at=o}room(e){if(this.free+e.rows<=this.capacity/p)return(this.free+=e.rows)-e.rows;let t=this.files.filter(n=>n.at!==null&&n.used<this.clock&&n.rows>=e.rows),[o]=t.filter(({level:n})=>n<this.coarsest).sort((n,a)=>n.used-a.used);if(!o)return null;let{at:s}=o;return o.at=null,s}select(e){this.clock++;let t=this.wanted(e*this.budget),o=[];for(let[s,n]of t){let i=Object.keys(s.lods).map(Number).filter(c=>this.used.get(s.lods[c].file).at!==null),f=Math.min(...i.filter(c=>c>=n),1/0),l=s.lods[f<1/0?f:Math.max(...i)];if(!l?.count)continue;let u=this.used.get(l.file),h=p*u.at+l.offset;u.used=this.clock,o.push([h,h+l.count])}return e===1&&this.load(t),Ve(o)}wanted(e){let{camera:t,height:o}=this.stage,s=t.position.clone().applyMatrix4(this.toLocal),n=t.getWorldDirection(new k.Vector3).transformDirection(this.toLocal),a=o/2*t.projectionMatrix.elements[5],i=new Map,f=[];for(let l of this.leaves){let u=s.clone().clamp(l.low,l.high),h=u.distanceTo(s),c=l.low.clone().add(l.high).multiplyScalar(.5).sub(s).dot(n)>-l.radius,y=Object.keys(l.lods).map(Number).sort((g,w)=>w-g);i.set(l,y[0]),e-=l.lods[y[0]].count;for(let g=1;g<y.length;g++){let[w,E]=[y[g-1],y[g]].map(v=>l.lods[v].count),m=a*l.radius/Math.sqrt(Math.max(w,1))/Math.max(h,.01*l.radius);f.push({leaf:l,level:y[g],cost:E-w,error:c?m:We*m})}}for(let{leaf:l,level:u,cost:h,error:c}of f.sort((y,g)=>g.error-y.error)){if(h>e||c<Xe)break;e-=h,i.set(l,u)}return i}async load(e){if(this.loading>=qe)return;let o=[...e].map(([a,i])=>this.used.get(a.lods[i].file)).find(a=>a.at===null&&!a.asked),s=o?this.room(o):null;if(s===null)return;let{era:n}=this;o.asked=!0,this.loading++;try{let a=await this.unpacked(o);if(n!==this.era)return;this.put(o,a,s),o.asked=!1}catch(a){console.warn(a.message)}finally{this.loading--,this.stage.redraw()}}};function*he(r){for(let o of r.children??[])yield*he(o);if(!Object.keys(r.lods??{}).length)return;let[e,t]=[r.bound.min,r.bound.max].map(o=>new k.Vector3(...o));yield{low:e,high:t,radius:.5*e.distanceTo(t),lods:r.lods}}function Ve(r){let e=[];for(let[t,o]of r.sort(([s],[n])=>s-n)){let s=e.at(-1);s&&s[1]===t?s[1]=o:e.push([t,o])}return e}function pe(r){let e=matchMedia("(pointer: coarse)").matches&&Math.min(screen.width,screen.height)<800;return r.budget??(e?1e6:3e6)}var me=r=>2**Math.ceil(Math.log2(Math.min(1,r))),L=class{constructor(e){Object.assign(this,{rest:e,work:.0625,moving:!0,drawn:0})}get density(){return this.moving?Math.sqrt(Math.max(me(this.work),.25)):1}get share(){return this.moving?me(this.work/.25):1}learn(e){e>33?this.work=Math.max(.03125,this.work*33/e):e<.7*33&&(this.work=Math.min(1,1.1*this.work))}async follow(){let e=performance.now(),t=++this.drawn;await new Promise(requestAnimationFrame),this.moving&&this.learn(performance.now()-e),await new Promise(o=>setTimeout(o,150)),t===this.drawn&&await this.rest()}};var we=I(F(),1);async function Ke(r,e){let t=new we.Stage(r,{antialias:!1}),o=Ye(t,r);if(r.stream){let{cloud:h,select:c}=await ue(t,r,o);return await de(t,h,c),t}let s=async()=>ie(await xe(r.splats?e.slice(0,r.splats):e)),n=await s(),a=r.splats?Y(await xe(e.slice(r.splats)),n.count,p):null,i=new X.Matrix4().makeScale(1,-1,-1),f=new U(t,{...n,capacity:n.count,antialiased:r.antialiased,placed:i,moves:a});f.hold(0,n),t.revive=async()=>{f.begin(),f.hold(0,await s())};let l=a?n.count:Math.min(o,n.count),u=await de(t,f,h=>[[0,a?l:Math.ceil(h*l)]]);return a&&(t.setTime=async h=>{u.moving=!0,f.choose(f.ranges,Math.min(h,r.duration*(1-1e-6))),await f.arrange(),t.redraw()},t.seek=$(t,r.duration)),t}function Ye(r,e){let t=r.renderer.getContext();return Math.min(pe(e),p*t.getParameter(t.MAX_TEXTURE_SIZE))}async function de(r,e,t){let{paint:o,camera:s}=r,n=new X.Matrix4,a=new L(async()=>{await r.arranged(),r.paint()});return r.arranged=async()=>{for(a.moving=!1,s.updateMatrixWorld(),n.copy(s.matrixWorld),e.choose(t(1));await e.arrange(););},r.sorted=async()=>{for(;e.sorting;)await e.sorting},r.paint=()=>{s.updateMatrixWorld(),n.equals(s.matrixWorld)||(a.moving=!0),n.copy(s.matrixWorld),e.choose(t(a.share));let i=()=>!e.sorting&&e.arrange().then(l=>l&&r.redraw());if(e.count>2*e.chosen)return i();if(r.draft(a.density),o(),e.paint(),i(),!a.moving)return;let f=a.follow().finally(()=>r.sharpening===f&&(r.sharpening=null));r.sharpening=f},e.choose(t(a.share)),await e.arrange(),r.paint(),e.finish(),a}function xe(r){return new Response(new Blob([r]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer()}return Re($e);})();
