/*
Lumigraph's page program

Built from web/ by `npm ci && npm run build`. Do not edit.
*/
var lumigraphProgram=(()=>{var Q=Object.create;var b=Object.defineProperty;var ee=Object.getOwnPropertyDescriptor;var te=Object.getOwnPropertyNames;var re=Object.getPrototypeOf,oe=Object.prototype.hasOwnProperty;var ne=(r,t)=>()=>{try{return t||r((t={exports:{}}).exports,t),t.exports}catch(e){throw t=0,e}},ie=(r,t)=>{for(var e in t)b(r,e,{get:t[e],enumerable:!0})},M=(r,t,e,o)=>{if(t&&typeof t=="object"||typeof t=="function")for(let n of te(t))!oe.call(r,n)&&n!==e&&b(r,n,{get:()=>t[n],enumerable:!(o=ee(t,n))||o.enumerable});return r};var F=(r,t,e)=>(e=r!=null?Q(re(r)):{},M(t||!r||!r.__esModule?b(e,"default",{value:r,enumerable:!0}):e,r)),se=r=>M(b({},"__esModule",{value:!0}),r);var S=ne((ze,D)=>{D.exports=lumigraphStage});var Se={};ie(Se,{start:()=>Re});var $=F(S(),1);function N(r,t,e){let[o,n,i,s]=[0,1,2,3].map(f=>new Float32Array(r,4*f*t,t)),a=new Uint16Array(r,16*t,3*t),m=new Uint32Array(4*e*Math.ceil(t/e)),h=new Float32Array(m.buffer),l=new Float32Array(3*t);for(let f=0;f<t;f++){for(let c=0;c<3;c++)l[3*f+c]=ae(a[c*t+f]);m[4*f]=a[f]|a[t+f]<<16,m[4*f+1]=a[2*t+f],h[4*f+2]=o[f],h[4*f+3]=s[f]}return{texels:m,spans:{begins:n,ends:i,middles:o,velocities:l}}}function ae(r){let t=r&32768?-1:1,e=r>>10&31,o=r&1023;return t*(e?2**(e-15)*(1+o/1024):2**-14*(o/1024))}function O(r,t){let e=c=>document.getElementById(c),[o,n,i]=["play","moment","speed"].map(e);e("clock").hidden=!1;let s=0,a=null,m=c=>(s=Math.min(Math.max(c,0),t),n.value=s/t,r.setTime(s)),h=()=>document.body.classList.contains("playing"),l=async c=>{h()&&(a!==null&&await m((s+(c-a)/1e3*i.value)%t),a=c,requestAnimationFrame(l))},f=()=>{a=null;let c=document.body.classList.toggle("playing");o.setAttribute("aria-label",c?"Pause":"Play"),c&&requestAnimationFrame(l)};return o.onclick=f,n.oninput=()=>m(n.value*t),addEventListener("keydown",c=>{c.key!==" "||c.target===o||c.ctrlKey||c.metaKey||c.altKey||(c.preventDefault(),f())}),m}var T=F(S(),1);var B=`// min(0.99, opacity exp(-q / 2)), and nothing below 1/255, as kernels/rasterize has it.

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
`;var C=`// The rectangle around the ellipse outside which a Gaussian adds less than 1/255 to any pixel.

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
`;var P=`// Each Gaussian's footprint by local affine approximation, and its colour from here (Zwicker 2002; Kerbl 2023), as
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
`;function ue(r){let t=1<<r,e=new Float32Array(0),o=null,n,i,s,a;function m([l,f,c],g,v){let w=0;for(let[x,u]of g)for(let y=x;y<u;y++){let A=l*e[3*y]+f*e[3*y+1]+c*e[3*y+2];if(o){if(v<o.begins[y]||o.ends[y]<=v)continue;let{velocities:p}=o;A+=(v-o.middles[y])*(l*p[3*y]+f*p[3*y+1]+c*p[3*y+2])}n[w]=A,s[w++]=y}return w}function h(l,f){let c=1/0,g=-1/0;for(let u=0;u<l;u++)c=Math.min(c,n[u]),g=Math.max(g,n[u]);let v=(t*t-1)/Math.max(g-c,1e-30),w=new Uint32Array(t+1),x=new Uint32Array(t+1);for(let u=0;u<l;u++){let y=i[u]=(g-n[u])*v;w[(y&t-1)+1]++,x[(y>>>r)+1]++}for(let u=0;u<t;u++)w[u+1]+=w[u],x[u+1]+=x[u];for(let u=0;u<l;u++)a[w[i[u]&t-1]++]=u;for(let u=0;u<l;u++)f[x[i[a[u]]>>>r]++]=s[a[u]]}onmessage=({data:l})=>{if(l.capacity&&(e=new Float32Array(3*l.capacity)),l.centres&&e.set(l.centres,3*l.at),l.moves&&(o=l.moves),!l.direction)return;let f=l.ranges.reduce((v,[w,x])=>v+x-w,0);(!n||n.length<f)&&(n=new Float32Array(f),[i,s,a]=[0,0,0].map(()=>new Uint32Array(f)));let c=m(l.direction,l.ranges,l.time),g=new Uint32Array(l.row*Math.ceil(c/l.row));h(c,g),postMessage({order:g,count:c},[g.buffer])}}var _=class{constructor(t,e){let o=URL.createObjectURL(new Blob([`(${ue})(12)`],{type:"text/javascript"}));this.worker=new Worker(o),this.row=e,this.worker.postMessage({capacity:t})}hold(t){this.worker.postMessage(t)}sort(t,e,o){return new Promise(n=>{this.worker.onmessage=({data:i})=>n(i),this.worker.postMessage({direction:t,ranges:e,time:o,row:this.row})})}};var d=1024,me=.3,q="const vec2 CORNERS[3] = vec2[](vec2(-1), vec2(3, -1), vec2(-1, 3)); void main() { gl_Position = vec4(CORNERS[gl_VertexID], 0, 1); }",he="precision highp float; uniform sampler2D drawn; out vec4 picture; void main() { picture = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0); }",[U,I,k,L,G,H,W]=[0,1,2,3,4,5,6],z=class{constructor(t,{capacity:e,degree:o,antialiased:n,placed:i=new T.Matrix4,moves:s=null}){let a=t.renderer.getContext(),m=Math.ceil(e/d);Object.assign(this,{stage:t,gl:a,degree:o,antialiased:n,placed:i,moves:s,ranges:[],time:0,count:0,made:{},sizes:{}}),this.programs=[[q,P],[C,B],[q,he]].map(([h,l])=>xe(a,h,l)),this.texture(U,a.RGBA32UI,2*d,m),this.texture(I,a.RGBA32UI,Math.max(1,o*d),o?m:1),this.texture(k,a.RGBA32UI,d,s?m:1),this.frames=[0,0].map(()=>a.createFramebuffer()),this.corners=pe(a),this.sorter=new _(m*d,d),s&&(this.fill(k,0,s.texels,d),this.sorter.hold({moves:s.spans})),t.renderer.resetState()}texture(t,e,o,n){let{gl:i}=this,s=[e,o,n].join();if(i.activeTexture(i.TEXTURE0+t),this.sizes[t]!==s){i.deleteTexture(this.made[t]??null),i.bindTexture(i.TEXTURE_2D,this.made[t]=i.createTexture()),i.texStorage2D(i.TEXTURE_2D,1,e,o,n);for(let a of[i.TEXTURE_MIN_FILTER,i.TEXTURE_MAG_FILTER])i.texParameteri(i.TEXTURE_2D,a,i.NEAREST);this.sizes[t]=s}else i.bindTexture(i.TEXTURE_2D,this.made[t]);return this.made[t]}fill(t,e,o,n,i=this.gl.RGBA_INTEGER,s=4){let{gl:a}=this;a.activeTexture(a.TEXTURE0+t),a.bindTexture(a.TEXTURE_2D,this.made[t]),V(a);let m=o.length/s/n;a.texSubImage2D(a.TEXTURE_2D,0,0,e,n,m,i,a.UNSIGNED_INT,o)}hold(t,{numbers:e,harmonics:o,centres:n}){this.fill(U,t,e,2*d),this.degree&&this.fill(I,t,o,this.degree*d),this.sorter.hold({at:t*d,centres:n}),this.stage.renderer.resetState(),this.order=null}choose(t,e=this.time){Object.assign(this,{ranges:t,time:e,order:null})}async arrange(){for(;this.sorting;)await this.sorting;let t=new T.Vector3(0,0,-1).transformDirection(this.stage.camera.matrixWorld);t.transformDirection(this.placed.clone().invert());let e=t.toArray();if(this.order&&this.order.every((s,a)=>s===e[a]))return!1;this.order=e;let{time:o}=this;this.sorting=this.sorter.sort(e,this.ranges,o);let{order:n,count:i}=await this.sorting;return this.sorting=null,Object.assign(this,{count:i,shown:o}),i&&(this.heights=de(n.length/d,this.heights),this.texture(L,this.gl.R32UI,d,this.heights),this.fill(L,0,n,d,this.gl.RED_INTEGER,1),this.stage.renderer.resetState()),!0}paint(){let{gl:t,stage:e}=this,{camera:o,renderer:n}=e;if(!this.count)return;let i=n.getDrawingBufferSize(new T.Vector2);o.updateMatrixWorld(),n.resetState(),V(t),t.bindVertexArray(this.corners),this.project(i),this.splat(i),n.resetState()}project(t){let{gl:e,stage:o}=this,{camera:n}=o,i=new T.Matrix4().makeScale(1,1,-1).multiply(n.matrixWorldInverse).multiply(this.placed),s=n.position.clone().applyMatrix4(this.placed.clone().invert()),[a,,,,,m]=n.projectionMatrix.elements,h=this.use(0,{cloud:U,harmonics:I,motion:k,order:L});e.uniformMatrix4fv(h.place,!1,i.elements),e.uniform3fv(h.eye,s.toArray()),e.uniform2f(h.focal,a*t.x/2,m*t.y/2),e.uniform2f(h.size,t.x,t.y),e.uniform1f(h.near,n.near),e.uniform1f(h.time,this.shown),e.uniform1f(h.blur,me),e.uniform1i(h.degree,this.degree),e.uniform1i(h.count,this.count),e.uniform1i(h.compensate,this.antialiased),e.uniform1i(h.moves,this.moves!==null),this.onto(0,[G,H],e.RGBA32UI,d,this.heights),e.viewport(0,0,d,Math.ceil(this.count/d)),e.drawArrays(e.TRIANGLES,0,3)}splat(t){let{gl:e}=this,o=e.getExtension("EXT_color_buffer_float")??e.getExtension("EXT_color_buffer_half_float");e.bindFramebuffer(e.FRAMEBUFFER,null),e.enable(e.BLEND),e.blendFunc(e.ONE,e.ONE_MINUS_SRC_ALPHA),o&&(this.onto(1,[W],e.RGBA16F,t.x,t.y),e.clearColor(0,0,0,0),e.clear(e.COLOR_BUFFER_BIT)),e.viewport(0,0,t.x,t.y);let n=this.use(1,{shapes:G,looks:H});e.uniform2f(n.size,t.x,t.y),e.drawElementsInstanced(e.TRIANGLES,6*d,e.UNSIGNED_SHORT,0,Math.ceil(this.count/d)),o&&(e.bindFramebuffer(e.FRAMEBUFFER,null),this.use(2,{drawn:W}),e.drawArrays(e.TRIANGLES,0,3))}use(t,e){let{gl:o}=this,{made:n,places:i}=this.programs[t];o.useProgram(n);for(let[s,a]of Object.entries(e))o.activeTexture(o.TEXTURE0+a),o.bindTexture(o.TEXTURE_2D,this.made[a]),o.uniform1i(i[s],a);return i}onto(t,e,o,n,i){let{gl:s}=this,a=e.some(h=>this.sizes[h]!==[o,n,i].join());if(s.bindFramebuffer(s.FRAMEBUFFER,this.frames[t]),!a)return;let m=e.map((h,l)=>{let f=this.texture(h,o,n,i);return s.framebufferTexture2D(s.FRAMEBUFFER,s.COLOR_ATTACHMENT0+l,s.TEXTURE_2D,f,0),s.COLOR_ATTACHMENT0+l});s.drawBuffers(m)}};function pe(r){let t=r.createVertexArray(),e=new Uint16Array(6*d);for(let o=0;o<d;o++)e.set([0,1,2,2,1,3].map(n=>4*o+n),6*o);return r.bindVertexArray(t),r.bindBuffer(r.ELEMENT_ARRAY_BUFFER,r.createBuffer()),r.bufferData(r.ELEMENT_ARRAY_BUFFER,e,r.STATIC_DRAW),t}function de(r,t=1){let e=t;for(;e<r;)e*=2;return e}function V(r){for(let t of[r.UNPACK_FLIP_Y_WEBGL,r.UNPACK_PREMULTIPLY_ALPHA_WEBGL])r.pixelStorei(t,!1);r.pixelStorei(r.UNPACK_ALIGNMENT,4);for(let t of[r.BLEND,r.DEPTH_TEST,r.CULL_FACE,r.SCISSOR_TEST,r.STENCIL_TEST])r.disable(t);r.colorMask(!0,!0,!0,!0)}function xe(r,...t){let e=r.createProgram();if(t.forEach((i,s)=>{let a=r.createShader(s?r.FRAGMENT_SHADER:r.VERTEX_SHADER);r.shaderSource(a,`#version 300 es
#define ROW ${d}
${i}`),r.compileShader(a),r.attachShader(e,a)}),r.linkProgram(e),!r.getProgramParameter(e,r.LINK_STATUS)){let[i]=r.getAttachedShaders(e).map(s=>r.getShaderInfoLog(s)).filter(Boolean);throw new Error(`This browser cannot draw the scene: ${i??r.getProgramInfoLog(e)}`)}let o=r.getProgramParameter(e,r.ACTIVE_UNIFORMS),n=Array.from({length:o},(i,s)=>r.getActiveUniform(e,s).name);return{made:e,places:Object.fromEntries(n.map(i=>[i,r.getUniformLocation(e,i)]))}}var ye={shift:16,steps:2048},we={shift:4,steps:8192},ge=.28209479177387814,ve=16,j=(r,{shift:t,steps:e})=>Math.min(Math.max(Math.round((r+t)*e),0),65535),X=(r,t)=>Uint16Array.from({length:r},(e,o)=>t(o));function Ee(r,t){let e=d*Math.ceil(r/d),o=new Uint32Array(8*e),n=new Float32Array(o.buffer),i=new Uint32Array(4*t*e),s=new Float32Array(3*e);return{count:r,degree:t,numbers:o,harmonics:i,centres:s,put:(m,h,l,f,c,g,v,w)=>{let x=8*m;[n[x],n[x+1],n[x+2]]=[s[3*m],s[3*m+1],s[3*m+2]]=[h,l,f],o[x+3]=c[0]|c[1]<<16,o[x+4]=c[2]|g<<16,o[x+5]=v,o[x+6]=w[0]|w[1]<<16,o[x+7]=w[2]},bytes:new Uint8Array(i.buffer)}}var Te=r=>j(r,ye),Ae=r=>j(.5+ge*r,we);function K(r){let t=new DataView(r),e=t.getUint32(8,!0),o=t.getUint8(12),n=2**-t.getUint8(13),i=3*((o+1)**2-1),s=ve,a=p=>new Uint8Array(r,(s+=p*e)-p*e,p*e),[m,h,l,f,c,g]=[9,1,3,3,4,i].map(a),[v,w]=[X(256,p=>Te(p/16-10)),X(256,p=>Ae((p/255-.5)/.15))],x=Ee(e,o),u=[0,0,0],y=[0,0,0],A=p=>((m[p]<<8|m[p+1]<<16|m[p+2]<<24)>>8)*n;for(let p=0;p<e;p++){for(let E=0;E<3;E++)u[E]=v[f[3*p+E]],y[E]=w[l[3*p+E]];let R=4*p,J=c[R]|c[R+1]<<8|c[R+2]<<16|c[R+3]<<24;x.put(p,A(9*p),A(9*p+3),A(9*p+6),u,257*h[p],J,y);for(let E=0;E<i;E++)x.bytes[16*o*p+E]=g[i*p+E]}return x}var Z=F(S(),1);async function Re(r,t){let e=new Z.Stage(r,{antialias:!1}),o=K(await Y(r.splats?t.slice(0,r.splats):t)),n=r.splats?N(await Y(t.slice(r.splats)),o.count,d):null,i=new $.Matrix4().makeScale(1,-1,-1),s=new z(e,{...o,capacity:o.count,antialiased:r.antialiased,placed:i,moves:n});return s.hold(0,o),s.choose([[0,o.count]]),be(e,s),n&&(e.setTime=async a=>{s.choose(s.ranges,Math.min(a,r.duration*(1-1e-6))),await e.arranged(),e.redraw()},e.seek=O(e,r.duration),await e.seek(0)),await e.arranged(),e.redraw(),e}function be(r,t){let{paint:e}=r;r.arranged=async()=>{for(r.camera.updateMatrixWorld();await t.arrange(););},r.sorted=async()=>{for(;t.sorting;)await t.sorting},r.paint=()=>{e(),t.paint(),t.sorting||t.arrange().then(o=>o&&r.redraw())}}function Y(r){return new Response(new Blob([r]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer()}return se(Se);})();
