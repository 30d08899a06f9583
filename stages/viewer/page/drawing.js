// Draws surfaces, points and cameras with WebGL 2: triangles without shared corners, so that each face has colours of its own.
import { decode, label, scaled } from "./colours.js";
import { add, cross, dot, length, looking, moved, multiply, orthographic, perspective, solved, sub, times, turned, unit, viewOf } from "./linear.js";

const MOST_LIGHTS = 16; // of the preview
const SURFACE = [`#version 300 es
in vec3 position, normal, colour;
uniform mat4 camera;
out vec3 at, facing, tint, corner;
void main() {
  gl_Position = camera * vec4(position, 1.0);
  at = position; facing = normal; tint = colour;
  int k = gl_VertexID % 3;
  corner = vec3(k == 0, k == 1, k == 2);
}`, `#version 300 es
precision highp float;
in vec3 at, facing, tint, corner;
uniform vec3 eye;
uniform int shading, lights; // shading 0: as it is; 1: by a light at the eye; 2: by the scene's lights
uniform vec3 place[${MOST_LIGHTS}], direction[${MOST_LIGHTS}], power[${MOST_LIGHTS}], ambient;
uniform float exposure, wire;
out vec4 colour;
vec3 encoded(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * x, vec3(lessThanEqual(x, vec3(0.0031308))));
}
void main() {
  vec3 towards = normalize(eye - at), n = normalize(facing);
  if (dot(n, n) < 0.5) n = normalize(cross(dFdx(at), dFdy(at)));
  vec3 shown = tint;
  if (shading == 1) shown = tint * (0.25 + 0.75 * abs(dot(n, towards)));
  if (shading == 2) {
    if (tint.x < 0.0) shown = vec3(1.0); // a light
    else {
      if (dot(n, towards) < 0.0) n = -n;
      vec3 sum = ambient;
      for (int i = 0; i < lights; i++) {
        vec3 to = place[i] - at;
        float r2 = max(dot(to, to), 1e-4);
        to *= inversesqrt(r2);
        sum += power[i] * max(dot(n, to), 0.0) * abs(dot(direction[i], to)) / r2;
      }
      shown = tint * sum * exposure / 3.14159265;
    }
  }
  shown = encoded(shown);
  vec3 step = max(fwidth(corner), vec3(1e-9)), edge = corner / step;
  float line = 1.0 - smoothstep(0.4, 1.3, min(edge.x, min(edge.y, edge.z)));
  line *= mix(1.0, 0.3, smoothstep(0.05, 0.35, max(step.x, max(step.y, step.z)))); // small triangles are not all lines
  colour = vec4(mix(shown, vec3(dot(shown, vec3(0.33)) > 0.5 ? 0.08 : 0.95), wire * line), 1.0);
}`];

const PLAIN = [`#version 300 es
in vec3 position;
in vec4 colour;
uniform mat4 camera;
uniform float size;
out vec4 tint;
void main() { gl_Position = camera * vec4(position, 1.0); gl_PointSize = size; tint = colour; }`, `#version 300 es
precision mediump float;
in vec4 tint;
out vec4 colour;
void main() { colour = tint; }`];

// Corners, normals and what can be asked of each face of a surface, computed once.
export class Triangles {
  constructor(surface) {
    this.surface = surface;
    const { vertices, faces } = surface, count = faces.shape[0];
    this.count = count;
    this.corners = new Float32Array(9 * count);
    for (let i = 0; i < 3 * count; i++) for (let c = 0; c < 3; c++) this.corners[3 * i + c] = vertices[3 * faces[i] + c];
    this.flat = new Float32Array(9 * count);
    this.area = new Float32Array(count);
    this.angle = new Float32Array(count);
    for (let f = 0; f < count; f++) this.measure(f);
    this.normals = surface.normals ? surface.normals.slice() : this.flat;
    this.bounds = bounds(this.corners);
  }

  corner(face, k) { const i = 9 * face + 3 * k; return [this.corners[i], this.corners[i + 1], this.corners[i + 2]]; }

  measure(f) {
    const a = this.corner(f, 0), b = this.corner(f, 1), c = this.corner(f, 2), n = cross(sub(b, a), sub(c, a));
    this.area[f] = length(n) / 2;
    const angle = (p, q, r) => { const u = sub(q, p), v = sub(r, p); return Math.acos(Math.min(1, Math.max(-1, dot(u, v) / (length(u) * length(v) || 1)))); };
    this.angle[f] = (Math.min(angle(a, b, c), angle(b, c, a), angle(c, a, b)) * 180) / Math.PI;
    const m = unit(n);
    for (let k = 0; k < 3; k++) this.flat.set(m, 9 * f + 3 * k);
  }

  // Names of what faces can be coloured by; values that are still to be loaded included.
  modes(scene) {
    const { colours, values, labels } = this.surface;
    return [...(scene ? ["preview"] : []), "shaded", "normals", "area", "smallest angle", ...Object.keys(colours), ...Object.keys(values), ...Object.keys(labels)];
  }

  // [(F, 3) linear colours, range or null] of a mode.
  colours(mode, extra) {
    const { colours, values, labels } = this.surface, out = new Float32Array(3 * this.count);
    const by = (of) => { for (let f = 0; f < this.count; f++) out.set(of(f), 3 * f); };
    const scale = (values, low, high, log) => {
      const at = log ? (v) => Math.log(Math.max(v, 1e-30)) : (v) => v, span = at(high) - at(low) || 1;
      by((f) => scaled((at(values[f]) - at(low)) / span).map(decode));
      return [out, [low, high]];
    };
    if (mode === "normals") { by((f) => [0, 1, 2].map((c) => decode(0.5 + 0.5 * this.flat[9 * f + c]))); return [out, null]; }
    if (mode === "area") { const [low, high] = quantiles(this.area); return scale(this.area, Math.max(low, 1e-12), Math.max(high, 1e-12), true); }
    if (mode === "smallest angle") return scale(this.angle, 0, 60, false);
    if (extra) { const [low, high] = [0, Math.max(...quantiles(extra, 0.995), 1e-12)]; by((f) => scaled(Math.sqrt(extra[f] / high)).map(decode)); return [out, [low, high]]; }
    if (mode in colours) { by((f) => [0, 1, 2].map((c) => Math.min(colours[mode][3 * f + c], 1))); return [out, null]; }
    if (mode in labels) { by((f) => label(labels[mode][f]).map(decode)); return [out, null]; }
    if (mode in values && values[mode].length === this.count) {
      let low = Infinity, high = -Infinity;
      for (const v of values[mode]) { low = Math.min(low, v); high = Math.max(high, v); }
      if (low >= 0 && high <= 1) [low, high] = [0, 1];
      return scale(values[mode], low, high, false);
    }
    out.fill(0.62);
    return [out, null];
  }

  // The nearest face along a ray, as {face, distance}.
  hit(origin, direction) {
    let best = null;
    for (let f = 0; f < this.count; f++) {
      const a = this.corner(f, 0), e = sub(this.corner(f, 1), a), g = sub(this.corner(f, 2), a), p = cross(direction, g), det = dot(e, p);
      if (Math.abs(det) < 1e-14) continue;
      const t = sub(origin, a), u = dot(t, p) / det;
      if (u < 0 || u > 1) continue;
      const q = cross(t, e), v = dot(direction, q) / det;
      if (v < 0 || u + v > 1) continue;
      const distance = dot(g, q) / det;
      if (distance > 1e-6 && (!best || distance < best.distance)) best = { face: f, distance };
    }
    return best;
  }
}

const quantiles = (values, high = 0.99) => {
  const sorted = Float32Array.from(values).sort();
  return sorted.length ? [sorted[Math.floor(0.01 * (sorted.length - 1))], sorted[Math.floor(high * (sorted.length - 1))]] : [0, 1];
};

export const bounds = (points) => {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i++) { const c = i % 3; if (points[i] < low[c]) low[c] = points[i]; if (points[i] > high[c]) high[c] = points[i]; }
  if (!(low[0] <= high[0])) return { centre: [0, 0, 0], radius: 1 };
  return { centre: times(add(low, high), 0.5), radius: Math.max(length(sub(high, low)) / 2, 1e-9) };
};

// Where a space is seen from: shared by its panes. `lens`: of a stored camera, or null for a field of view of our own.
export class Sight {
  constructor(up, flat) {
    this.worldUp = up;
    this.flat = flat;
    this.lens = null;
    this.fov = 40; // degrees, of the shorter side
    this.height = 1; // half the picture's height, world units, where it is flat
    this.home = { centre: [0, 0, 0], radius: 1 };
    this.changed = new Set();
    this.reset();
  }

  tell() { for (const listener of this.changed) listener(); }

  reset() {
    const { centre, radius } = this.home, up = unit(this.worldUp);
    this.lens = null;
    this.target = centre;
    this.height = radius;
    if (this.flat) { this.pose = looking(add(centre, [0, 0, 1], 10 * radius), centre, [0, 1, 0]); this.tell(); return; }
    let side = cross(up, [0.35, 0.9, -0.1]);
    if (length(side) < 0.1) side = cross(up, [1, 0, 0]);
    const front = unit(cross(unit(side), up)), away = unit(add(add(times(front, -1), unit(side), 0.55), up, 0.5));
    this.pose = looking(add(centre, away, (1.15 * radius) / Math.tan((this.fov * Math.PI) / 360)), centre, up);
    this.tell();
  }

  // Through a stored camera. distance: to what it looks at, which the view turns around from then on.
  through(pose, lens, distance) {
    this.pose = pose;
    this.lens = lens;
    this.target = add(pose.eye, pose.back, -distance);
    this.tell();
  }

  free() { this.lens = this.lens && { ...this.lens, stored: false }; }

  orbit(x, y) {
    if (this.flat) { this.pan(x, y); return; }
    this.free();
    const up = unit(this.worldUp), right = turned(this.pose.right, up, -x);
    const around = (v) => turned(turned(v, this.pose.right, -y), up, -x), back = around(this.pose.back);
    if (Math.abs(dot(back, up)) > Math.max(0.995, Math.abs(dot(this.pose.back, up)))) return; // not over the pole
    this.pose = { right, up: around(this.pose.up), back, eye: add(this.target, around(sub(this.pose.eye, this.target))) };
    this.tell();
  }

  pan(x, y) { // in parts of the picture's height
    this.free();
    const span = this.flat ? 2 * this.height : 2 * this.distance() * this.slope()[1];
    const shift = add(times(this.pose.right, -x * span), this.pose.up, y * span);
    this.pose = { ...this.pose, eye: add(this.pose.eye, shift) };
    this.target = add(this.target, shift);
    this.tell();
  }

  zoom(factor) {
    this.free();
    if (this.flat) this.height *= factor;
    else this.pose = { ...this.pose, eye: add(this.target, sub(this.pose.eye, this.target), factor) };
    this.tell();
  }

  distance() { return length(sub(this.pose.eye, this.target)) || 1; }

  // Half the picture's width and height at distance 1, and where the axis is in it.
  slope(aspect = this.lens?.aspect ?? 1) {
    if (this.lens) return [this.lens.x, this.lens.y, this.lens.cx, this.lens.cy];
    const t = Math.tan((this.fov * Math.PI) / 360);
    return aspect > 1 ? [t * aspect, t, 0, 0] : [t, t / aspect, 0, 0];
  }

  matrix(aspect) {
    const reach = length(sub(this.pose.eye, this.home.centre)) + 2.5 * this.home.radius;
    const view = viewOf(this.pose);
    if (this.flat) return multiply(orthographic(this.height * Math.max(aspect, 1), this.height * Math.max(1 / aspect, 1), 0.01 * this.home.radius, 30 * this.home.radius), view);
    const [x, y, cx, cy] = this.slope(aspect);
    return multiply(perspective(x, y, Math.max(1e-3 * this.home.radius, 2e-4 * reach), 3 * reach, cx, cy), view);
  }
}

export class Viewport {
  constructor(sight) {
    this.sight = sight;
    this.canvas = document.createElement("canvas");
    this.canvas.className = "space";
    this.canvas.tabIndex = 0;
    const gl = (this.gl = this.canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("This browser has no WebGL 2: use a recent Firefox, Chrome, Edge or Safari");
    this.surfaceProgram = this.program(SURFACE);
    this.plainProgram = this.program(PLAIN);
    this.buffers = { surface: this.array(this.surfaceProgram, { position: 3, normal: 3, colour: 3 }),
      lines: this.array(this.plainProgram, { position: 3, colour: 4 }), points: this.array(this.plainProgram, { position: 3, colour: 4 }) };
    this.counts = { surface: 0, lines: 0, points: 0 };
    this.wire = false;
    this.shading = 1;
    this.exposure = 1;
    this.lights = [];
    this.ambient = [0, 0, 0];
    this.show = { lines: true, points: true, surface: true };
    this.waiting = false;
    this.listener = () => this.request();
    sight.changed.add(this.listener);
    this.watcher = new ResizeObserver(() => this.request());
    this.watcher.observe(this.canvas);
  }

  free() {
    this.sight.changed.delete(this.listener);
    this.watcher.disconnect();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
    this.gone = true;
  }

  program([vertex, fragment]) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error("The shaders do not link: " + gl.getProgramInfoLog(program));
    return program;
  }

  array(program, sizes) {
    const { gl } = this, buffers = {}, vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    for (const [name, size] of Object.entries(sizes)) {
      const place = gl.getAttribLocation(program, name);
      buffers[name] = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    }
    return { vao, buffers };
  }

  fill(kind, name, data) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[kind].buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  }

  setTriangles(triangles) {
    this.triangles = triangles;
    this.counts.surface = 3 * (triangles?.count ?? 0);
    if (triangles) { this.fill("surface", "position", triangles.corners); this.fill("surface", "normal", triangles.normals); }
    this.request();
  }

  // (F, 3) linear colours; a negative one is a light.
  setColours(colours) {
    const corners = new Float32Array(3 * colours.length);
    for (let f = 0; f < colours.length / 3; f++) for (let k = 0; k < 3; k++) for (let c = 0; c < 3; c++) corners[9 * f + 3 * k + c] = colours[3 * f + c];
    this.fill("surface", "colour", corners);
    this.request();
  }

  // Segments [[from, to, [r, g, b, a]], ..].
  setLines(segments) {
    this.fill("lines", "position", new Float32Array(segments.flatMap(([a, b]) => [...a, ...b])));
    this.fill("lines", "colour", new Float32Array(segments.flatMap(([, , colour]) => [...colour, ...colour])));
    this.counts.lines = 2 * segments.length;
    this.request();
  }

  setPoints(points, colours) {
    this.fill("points", "position", points);
    this.fill("points", "colour", colours);
    this.counts.points = points.length / 3;
    this.request();
  }

  request() {
    if (this.waiting || this.gone) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  aspect() { return this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1) || 1; }

  draw() {
    const { gl, canvas } = this;
    if (this.gone || gl.isContextLost()) return;
    const ratio = Math.min(devicePixelRatio, 2), width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const camera = this.sight.matrix(width / height), set = (program, name) => gl.getUniformLocation(program, name);
    if (this.show.surface && this.counts.surface) {
      const p = this.surfaceProgram, lights = this.lights.slice(0, MOST_LIGHTS);
      gl.useProgram(p);
      gl.uniformMatrix4fv(set(p, "camera"), true, camera);
      gl.uniform3fv(set(p, "eye"), this.sight.pose.eye);
      gl.uniform1i(set(p, "shading"), this.shading);
      gl.uniform1f(set(p, "exposure"), this.exposure);
      gl.uniform1f(set(p, "wire"), this.wire ? 0.75 : 0);
      gl.uniform1i(set(p, "lights"), lights.length);
      gl.uniform3fv(set(p, "ambient"), this.ambient);
      if (lights.length) for (const name of ["place", "direction", "power"]) gl.uniform3fv(set(p, name), lights.flatMap((light) => light[name]));
      gl.bindVertexArray(this.buffers.surface.vao);
      gl.drawArrays(gl.TRIANGLES, 0, this.counts.surface);
    }
    gl.useProgram(this.plainProgram);
    gl.uniformMatrix4fv(set(this.plainProgram, "camera"), true, camera);
    gl.uniform1f(set(this.plainProgram, "size"), Math.max(1, ratio));
    for (const [kind, how] of [["points", gl.POINTS], ["lines", gl.LINES]])
      if (this.show[kind] && this.counts[kind]) {
        gl.bindVertexArray(this.buffers[kind].vao);
        gl.drawArrays(how, 0, this.counts[kind]);
      }
  }

  // The ray through a place of the canvas, in parts of its width and height.
  ray(x, y) {
    const inverse = solved(this.sight.matrix(this.aspect())), at = (z) => {
      const p = [2 * x - 1, 1 - 2 * y, z], w = inverse[12] * p[0] + inverse[13] * p[1] + inverse[14] * p[2] + inverse[15];
      return times(moved(inverse, p), 1 / w);
    };
    const near = at(-1);
    return { origin: near, direction: unit(sub(at(1), near)) };
  }

  pick(x, y) {
    if (!this.triangles) return null;
    const { origin, direction } = this.ray(x, y);
    return this.triangles.hit(origin, direction);
  }
}

// Dragging, wheel, touch and keys on a canvas move its sight. done(): the camera came to rest after a person moved it.
export const steer = (viewport, done, clicked) => {
  const { canvas, sight } = viewport, pointers = new Map();
  let drag = false, wheel = 0;
  const box = () => canvas.getBoundingClientRect();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture?.(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    drag = false;
    canvas.focus({ preventScroll: true });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], { width, height } = box();
    const [dx, dy] = [(now[0] - before[0]) / height, (now[1] - before[1]) / height];
    if (!drag && Math.hypot(dx * height, dy * height) < 3) return;
    if (pointers.size === 2) { // pinch, and move with two fingers
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1], apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      sight.zoom(apart(before) / apart(now));
      sight.pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) sight.pan(dx, dy);
    else sight.orbit(dx * 3.2, dy * 3.2);
    drag = true;
    pointers.set(event.pointerId, now);
  });
  const up = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (drag) { if (!pointers.size) done(); }
    else if (event.type === "pointerup") { const { left, top, width, height } = box(); clicked?.((event.clientX - left) / width, (event.clientY - top) / height, event); }
  };
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, up);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    sight.zoom(Math.exp(Math.min(Math.max(event.deltaY, -200), 200) * 0.0015));
    clearTimeout(wheel);
    wheel = setTimeout(done, 250);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? (x, y) => sight.pan(x, y) : (x, y) => sight.orbit(2 * x, 2 * y);
    const keys = { ArrowLeft: () => step(-0.08, 0), ArrowRight: () => step(0.08, 0), ArrowUp: () => step(0, -0.08), ArrowDown: () => step(0, 0.08),
      "+": () => sight.zoom(0.9), "=": () => sight.zoom(0.9), "-": () => sight.zoom(1 / 0.9), r: () => sight.reset() };
    if (!(event.key in keys)) return;
    event.preventDefault();
    event.stopPropagation();
    keys[event.key]();
    clearTimeout(wheel);
    wheel = setTimeout(done, 250);
  });
};
