"use strict";
// Draws a scene of splats, boxes and joint axes with WebGL2. The maths is that of structuregs.raster: cameras with OpenCV's
// axes (x right, y down, z forward), pixel centres at +0.5, 2D covariances widened by a pixel's variance, colours over white.

const NEAR = 0.01;
const DILATION = 1 / 12; // px^2, as the renderer's
const COLUMNS = 16; // 16-bit numbers of a splat: mean 3, rotation 3, log scale 3, rgb 3, opacity 1, tint 3
const TEXELS = COLUMNS / 4;
const SPLATS_PER_ROW = 512; // 4 texels each: rows of 2048 texels, which every WebGL2 device allows
const ORDER_ROW = 2048; // items in a row of the texture that holds the drawing order
const BUCKETS = 65536;
const PART_SHIFT = 24; // an item of the drawing order is a splat's number, with its part above it

const POSE_GLSL = `
uniform highp sampler2D poses; // three texels a part: the rows of its 3 x 4 motion from where it stands in state 0 to the camera
mat4x3 pose(int part) {
  return transpose(mat3x4(texelFetch(poses, ivec2(0, part), 0), texelFetch(poses, ivec2(1, part), 0),
                          texelFetch(poses, ivec2(2, part), 0)));
}
uniform vec4 lens; // fx, fy, cx, cy
uniform vec2 size; // of the picture, pixels
vec2 pixel(vec3 p) { return lens.xy * p.xy / p.z + lens.zw; }
vec4 clip(vec2 at) { return vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0); }
vec2 corner() { return vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0; }
`;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
${POSE_GLSL}
uniform usampler2D splats;
uniform vec4 low[${TEXELS}], step_[${TEXELS}]; // value = low + step * number
uniform float shade; // how much of the tint is added
uniform usampler2D order; // items, from far to near
out vec2 deviations; // from the splat's middle
out vec4 colour;

mat3 rotation(vec3 m) { // of modified Rodrigues parameters: the axis times tan(angle / 4)
  float s = dot(m, m);
  vec4 q = vec4(2.0 * m, 1.0 - s) / (1.0 + s);
  vec3 a = 2.0 * q.xyz;
  float xx = a.x * q.x, yy = a.y * q.y, zz = a.z * q.z, xy = a.x * q.y, xz = a.x * q.z, yz = a.y * q.z;
  vec3 w = a * q.w;
  return mat3(1.0 - yy - zz, xy + w.z, xz - w.y, xy - w.z, 1.0 - xx - zz, yz + w.x, xz + w.y, yz - w.x, 1.0 - xx - yy);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: not drawn
  int place = gl_VertexID >> 2;
  uint item = texelFetch(order, ivec2(place % ${ORDER_ROW}, place / ${ORDER_ROW}), 0).r;
  int i = int(item & ${(1 << PART_SHIFT) - 1}u), part = int(item >> ${PART_SHIFT});
  vec4 v[${TEXELS}];
  for (int c = 0; c < ${TEXELS}; c++) {
    ivec2 at = ivec2(${TEXELS} * (i % ${SPLATS_PER_ROW}) + c, i / ${SPLATS_PER_ROW});
    v[c] = low[c] + step_[c] * vec4(texelFetch(splats, at, 0));
  }
  vec3 mean = v[0].xyz, turn = vec3(v[0].w, v[1].xy), scale = exp(vec3(v[1].zw, v[2].x)), rgb = v[2].yzw, tint = v[3].yzw;
  float opacity = v[3].x;
  mat4x3 T = pose(part);
  vec3 p = T * vec4(mean, 1.0);
  if (p.z <= ${NEAR} || opacity * 255.0 <= 1.0) return;

  mat3 axes = mat3(T) * rotation(turn) * mat3(scale.x, 0.0, 0.0, 0.0, scale.y, 0.0, 0.0, 0.0, scale.z);
  // Linearised at most 0.3 half pictures outside, where the projection of wide splats would go astray.
  vec2 margin = 0.15 * size / lens.xy;
  vec2 uv = clamp(p.xy / p.z, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  mat3 rows = transpose(axes);
  vec3 m_x = lens.x / p.z * (rows[0] - uv.x * rows[2]), m_y = lens.y / p.z * (rows[1] - uv.y * rows[2]);
  float xx = dot(m_x, m_x), xy = dot(m_x, m_y), yy = dot(m_y, m_y);
  vec3 across = cross(m_x, m_y);
  float determinant = dot(across, across) + ${DILATION} * (xx + yy) + ${DILATION * DILATION};
  float wide = 0.5 * (xx + yy) + ${DILATION} + length(vec2(0.5 * (xx - yy), xy));
  float angle = 0.5 * atan(2.0 * xy, xx == yy && xy == 0.0 ? 1.0 : xx - yy);
  vec2 axis = vec2(cos(angle), sin(angle));

  deviations = corner() * sqrt(2.0 * log(opacity * 255.0));
  vec2 offset = deviations.x * sqrt(wide) * axis + deviations.y * sqrt(determinant / wide) * vec2(-axis.y, axis.x);
  colour = vec4(max(rgb + shade * tint, 0.0), opacity);
  gl_Position = clip(pixel(p) + offset);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 deviations;
in vec4 colour;
out vec4 light;
void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(deviations, deviations)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  light = vec4(colour.rgb * alpha, alpha);
}`;

const LINE_VERTEX = `#version 300 es
precision highp float;
precision highp int;
${POSE_GLSL}
uniform float ratio; // device pixels of a pixel
in vec3 start, end, colour_;
in vec2 part_width;
out vec3 colour;
out vec2 across_half; // pixels from the line's middle, and its half width
void main() {
  mat4x3 T = pose(int(part_width.x));
  vec3 a = T * vec4(start, 1.0), b = T * vec4(end, 1.0);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (max(a.z, b.z) <= ${NEAR}) return;
  vec3 crossing = mix(a, b, (${NEAR} - a.z) / (a.z == b.z ? 1.0 : b.z - a.z));
  if (a.z < ${NEAR}) a = crossing;
  if (b.z < ${NEAR}) b = crossing;
  vec2 from = pixel(a), to = pixel(b), way = to - from;
  way = length(way) > 0.0 ? normalize(way) : vec2(1.0, 0.0);
  float half_ = 0.5 * part_width.y * ratio, reach = half_ + 1.0;
  vec2 c = corner();
  colour = colour_;
  across_half = vec2(c.y * reach, half_);
  gl_Position = clip((c.x < 0.0 ? from : to) + c.x * half_ * way + c.y * reach * vec2(-way.y, way.x));
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 colour;
in vec2 across_half;
out vec4 light;
void main() {
  float alpha = clamp(across_half.y + 0.5 - abs(across_half.x), 0.0, 1.0);
  light = vec4(colour * alpha, alpha);
}`;

class Viewer {
  /** Shows a scene (structuregs.export.html.scene_of) on a canvas. */
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("This page needs WebGL2, which this browser does not offer.");
    this.canvas = canvas;
    this.gl = gl;
    this.splatProgram = new Program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.lineProgram = new Program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.splatTexture = newTexture(gl);
    this.poseTexture = newTexture(gl);
    this.orderTexture = newTexture(gl);
    this.cornerBuffer = gl.createBuffer();
    this.lineBuffer = gl.createBuffer();
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(1, 1, 1, 1);
    this.load(scene);
  }

  /** Takes another scene, in state 0 with everything but boxes and axes shown. */
  load(scene) {
    const { gl } = this;
    const bytes = Uint8Array.from(atob(scene.splats), (c) => c.charCodeAt(0));
    const numbers = new Uint16Array(bytes.buffer);
    this.scene = scene;
    this.count = numbers.length / COLUMNS;
    this.step = scene.low.map((low, c) => (scene.high[c] - low) / 65535);
    const rows = Math.max(1, Math.ceil(this.count / SPLATS_PER_ROW));
    const padded = new Uint16Array(rows * SPLATS_PER_ROW * COLUMNS);
    padded.set(numbers);
    gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    gl.texImage2D(
      gl.TEXTURE_2D, 0, gl.RGBA16UI, SPLATS_PER_ROW * TEXELS, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, padded,
    );
    this.means = new Float32Array(3 * this.count);
    for (let i = 0; i < this.count; i++) {
      for (let c = 0; c < 3; c++) this.means[3 * i + c] = scene.low[c] + this.step[c] * numbers[COLUMNS * i + c];
    }
    this.depths = new Float32Array(this.count);
    this.items = new Uint32Array(this.count);
    this.order = new Uint32Array(Math.max(1, Math.ceil(this.count / ORDER_ROW)) * ORDER_ROW);
    this.heads = new Uint32Array(BUCKETS + 1);
    this.loadCorners();
    this.q = scene.joints.map(() => 0);
    this.shown = { parts: scene.parts.map(() => true), boxes: false, axes: false };
  }

  /** The triangles of all splats' squares: one draw of many is far quicker than as many instances of one. */
  loadCorners() {
    const { gl } = this;
    const corners = new Uint32Array(6 * this.count);
    for (let i = 0; i < this.count; i++) corners.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner), 6 * i);
    gl.bindVertexArray(this.splatProgram.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.cornerBuffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  /** The 3 x 4 motion of a part from state 0, row by row; a part moves with its parent. */
  pose(part) {
    if (part === 0) return [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
    const joint = this.scene.joints[part - 1];
    const own = jointMotion(joint, this.q[part - 1]);
    return joint.parent === 0 ? own : composed(this.pose(joint.parent), own);
  }

  /** How much of the tint to add: -1/2 in state 0, +1/2 in state 1, as ArticulatedObject.at. */
  get shade() {
    const progress = this.scene.joints
      .map((joint, i) => (joint.q[1] ? Math.min(Math.max(this.q[i] / joint.q[1], 0), 1) : null))
      .filter((p) => p !== null);
    return progress.length ? progress.reduce((a, b) => a + b) / progress.length - 0.5 : 0;
  }

  /**
   * Draws the scene.
   * camera: R (3 x 3 world to camera, row by row), centre, fx, fy, cx, cy, width, height (device pixels).
   * ratio: device pixels of a pixel, for the width of lines.
   */
  draw(camera, ratio = 1) {
    const { gl, canvas } = this;
    if (canvas.width !== camera.width || canvas.height !== camera.height) {
      canvas.width = camera.width;
      canvas.height = camera.height;
    }
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { R, centre } = camera;
    const offset = [0, 3, 6].map((i) => -(R[i] * centre[0] + R[i + 1] * centre[1] + R[i + 2] * centre[2]));
    const view = [0, 1, 2].flatMap((i) => [...R.slice(3 * i, 3 * i + 3), offset[i]]);
    const poses = this.scene.parts.map((_, part) => composed(view, this.pose(part)));
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.poseTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3, poses.length, 0, gl.RGBA, gl.FLOAT, new Float32Array(poses.flat()));
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    this.drawSplats(camera, poses);
    this.drawLines(camera, ratio);
  }

  drawSplats(camera, poses) {
    const { gl, splatProgram: program } = this;
    const count = this.sort(poses);
    program.use(camera);
    gl.uniform1i(program.at("splats"), 0);
    gl.uniform4fv(program.at("low"), this.scene.low);
    gl.uniform4fv(program.at("step_"), this.step);
    gl.uniform1f(program.at("shade"), this.shade);
    gl.uniform1i(program.at("order"), 2);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.orderTexture);
    const rows = this.order.length / ORDER_ROW;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, ORDER_ROW, rows, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, this.order);
    gl.bindVertexArray(program.array);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
  }

  /** Fills the order of drawing, from far to near, by a counting sort of 16-bit depths; the number of items. */
  sort(poses) {
    const { means, depths, items, order, heads } = this;
    let count = 0, nearest = Infinity, farthest = -Infinity, first = 0;
    this.scene.parts.forEach(({ count: size }, part) => {
      const [a, b, c, d] = poses[part].slice(8);
      const last = this.shown.parts[part] ? first + size : first;
      for (let i = first; i < last; i++) {
        const depth = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + d;
        if (depth <= NEAR) continue;
        if (depth < nearest) nearest = depth;
        if (depth > farthest) farthest = depth;
        depths[count] = depth;
        items[count++] = i + part * 2 ** PART_SHIFT;
      }
      first += size;
    });
    const scale = farthest > nearest ? (BUCKETS - 1) / (farthest - nearest) : 0;
    heads.fill(0);
    for (let i = 0; i < count; i++) heads[((farthest - depths[i]) * scale | 0) + 1]++;
    for (let k = 0; k < BUCKETS; k++) heads[k + 1] += heads[k];
    for (let i = 0; i < count; i++) order[heads[(farthest - depths[i]) * scale | 0]++] = items[i];
    return count;
  }

  drawLines(camera, ratio) {
    const { gl, lineProgram: program } = this;
    const numbers = new Float32Array(this.lines().flat());
    if (!numbers.length) return;
    program.use(camera);
    gl.uniform1f(program.at("ratio"), ratio);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.DYNAMIC_DRAW);
    gl.bindVertexArray(program.array);
    let offset = 0;
    for (const [name, width] of [["start", 3], ["end", 3], ["colour_", 3], ["part_width", 2]]) {
      const at = gl.getAttribLocation(program.handle, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, width, gl.FLOAT, false, 44, offset);
      gl.vertexAttribDivisor(at, 1);
      offset += 4 * width;
    }
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, numbers.length / 11);
  }

  /** What is shown of boxes and axes, in segments: start, end, colour, the part it moves with, width in pixels. */
  lines() {
    const { parts, joints } = this.scene;
    const segments = [];
    const add = (polyline, colour, part, width) => {
      for (let i = 0; i + 1 < polyline.length; i++) {
        segments.push([...polyline[i], ...polyline[i + 1], ...colour.map((c) => c / 255), part, width]);
      }
    };
    if (this.shown.boxes) {
      parts.forEach(({ edges, colour }, k) => this.shown.parts[k] && edges.forEach((edge) => add(edge, colour, k, 1.5)));
    }
    if (this.shown.axes) {
      joints.forEach(({ strokes, parent }, i) => {
        if (!this.shown.parts[i + 1]) return;
        strokes.forEach((stroke) => add(stroke, [255, 255, 255], parent, 5));
        strokes.forEach((stroke) => add(stroke, parts[i + 1].colour, parent, 2.5));
      });
    }
    return segments;
  }
}

/** A pair of shaders. */
class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.handle = gl.createProgram();
    this.array = gl.createVertexArray();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.handle, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(this.handle);
    if (!gl.getProgramParameter(this.handle, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.handle));
    this.places = new Map();
  }

  /** Where a uniform is. */
  at(name) {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.handle, name));
    return this.places.get(name);
  }

  /** Draws with this program from now on, as the camera sees. */
  use(camera) {
    const { gl } = this;
    gl.useProgram(this.handle);
    gl.uniform4f(this.at("lens"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(this.at("size"), camera.width, camera.height);
    gl.uniform1i(this.at("poses"), 1);
  }
}

function newTexture(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

/** The 3 x 4 motion of a joint by q: radians about its axis (Rodrigues), or units along it. */
function jointMotion({ kind, axis, origin }, q) {
  const [x, y, z] = axis;
  if (kind === "prismatic") return [1, 0, 0, q * x, 0, 1, 0, q * y, 0, 0, 1, q * z];
  const c = Math.cos(q), s = Math.sin(q), d = 1 - c;
  const R = [
    [c + d * x * x, d * x * y - s * z, d * x * z + s * y],
    [d * x * y + s * z, c + d * y * y, d * y * z - s * x],
    [d * x * z - s * y, d * y * z + s * x, c + d * z * z],
  ];
  return R.flatMap((row, i) => [...row, origin[i] - (row[0] * origin[0] + row[1] * origin[1] + row[2] * origin[2])]);
}

/** The motion b followed by a. */
function composed(a, b) {
  const motion = [];
  for (let i = 0; i < 12; i += 4) {
    for (let j = 0; j < 4; j++) motion.push(a[i] * b[j] + a[i + 1] * b[4 + j] + a[i + 2] * b[8 + j] + (j === 3 ? a[i + 3] : 0));
  }
  return motion;
}
