// Draws a baked scene with WebGL 2. What each file holds is said by scene.json and in the project's docs.
import { expandCodes, loadScene } from "./loader.js";
import { Residuals } from "./residuals.js";

const element = (id) => document.getElementById(id);
const SPEED = 6; // metres per second

// -- small linear algebra; matrices are row-major arrays of 16

const multiply = (a, b) => {
  const out = new Array(16).fill(0);
  for (let r = 0; r < 4; r++)
    for (let c = 0; c < 4; c++) for (let k = 0; k < 4; k++) out[4 * r + c] += a[4 * r + k] * b[4 * k + c];
  return out;
};
const transposed = (m) => m.map((_, i) => m[4 * (i % 4) + Math.floor(i / 4)]);
const add = (a, b, scale = 1) => a.map((x, i) => x + scale * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a); return a.map((x) => x / n); };
const turned = (v, axis, angle) => // Rodrigues
  add(add(v.map((x) => x * Math.cos(angle)), cross(axis, v), Math.sin(angle)), axis, dot(axis, v) * (1 - Math.cos(angle)));

// A pose: right, up, back (unit vectors) and eye, relative to the scene's centre.
const poseOf = (frame) => {
  const m = frame.camera_to_world;
  const column = (c) => [m[0][c], m[1][c], m[2][c]];
  return { right: column(0), up: column(1), back: column(2), eye: column(3) };
};

const projection = (lens, near, far) => [
  lens[0], 0, -lens[2], 0,
  0, lens[1], -lens[3], 0,
  0, 0, (far + near) / (near - far), (2 * far * near) / (near - far),
  0, 0, -1, 0,
];
const viewOf = ({ right, up, back, eye }) => [
  ...right, -dot(right, eye), ...up, -dot(up, eye), ...back, -dot(back, eye), 0, 0, 0, 1,
];

class Viewer {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2: use a recent Firefox, Chrome, Edge or Safari");
    this.gl = gl;
    this.frame = 0;
    this.pose = poseOf(scene.frames[0]);
    this.lens = scene.frames[0].lens;
    this.shift = 0;
    this.mode = 0;
    this.skybox = -1;
    this.wireframe = false;
    this.smooth = true;
    this.keys = new Set();
    this.times = [];
    this.driving = null;
    this.prepare();
  }

  prepare() {
    const { gl, scene } = this;
    const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE), layers = gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS);
    const { mesh, skyboxes } = scene;
    if (Math.max(mesh.width, mesh.height, skyboxes.side) > largest || 6 * skyboxes.count > layers)
      throw new Error(`The texture is ${mesh.width} x ${mesh.height}; this browser takes ${largest}. Bake a smaller one: atlas.max_megatexels, or bake.tile_m=50`);
    this.mesh = this.program(scene.shaders.mesh);
    this.sky = this.program(scene.shaders.sky);
    this.resolve = this.program(scene.shaders.resolve);
    this.largest = largest;
    this.textures = [];
    for (let i = 0; i < scene.textures; i++) {
      this.textures.push([this.mesh, `mesh${i}`, gl.TEXTURE_2D, this.upload(gl.TEXTURE_2D, scene.meshMaps[i], mesh.width, mesh.height)]);
      this.textures.push([this.sky, `sky${i}`, gl.TEXTURE_2D_ARRAY,
        this.upload(gl.TEXTURE_2D_ARRAY, scene.skyMaps[i], skyboxes.side, skyboxes.side, 6 * skyboxes.count)]);
    }
    const codes = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, codes);
    const source = scene.meshCodes ?? new Uint16Array(1), width = scene.meshCodes ? mesh.width : 1, height = scene.meshCodes ? mesh.height : 1;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R16UI, width, height, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT, source);
    this.clampTo(gl.TEXTURE_2D, gl.NEAREST);
    this.textures.push([this.mesh, "codes", gl.TEXTURE_2D, codes]);
    this.residuals = scene.residuals ? new Residuals(this) : null;

    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    for (const [name, size] of [["position", 3], ["uv", 2], ["chart", 1]]) {
      const place = gl.getAttribLocation(this.mesh, name);
      if (place < 0) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, scene.geometry[name], gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    }
    const faces = scene.geometry.indices;
    const edges = new Uint32Array(2 * faces.length);
    for (let i = 0; i < faces.length; i += 3)
      edges.set([faces[i], faces[i + 1], faces[i + 1], faces[i + 2], faces[i + 2], faces[i]], 2 * i);
    this.triangleBuffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.triangleBuffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    this.edgeBuffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.edgeBuffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, edges, gl.STATIC_DRAW);
    this.counts = { triangles: faces.length, edges: edges.length };
    this.nothing = gl.createVertexArray();
  }

  // Where the rays of each pixel are drawn, so many along its side; kept until the size changes.
  raysBuffer(width, height) {
    const { gl } = this;
    if (this.fine?.width === width && this.fine.height === height) return this.fine;
    if (this.fine) { gl.deleteTexture(this.fine.colour); gl.deleteRenderbuffer(this.fine.depth); gl.deleteFramebuffer(this.fine.frame); }
    const frame = gl.createFramebuffer(), colour = gl.createTexture(), depth = gl.createRenderbuffer();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, colour);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    this.clampTo(gl.TEXTURE_2D, gl.NEAREST);
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colour, 0);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    this.fine = { width, height, frame, colour, depth };
    return this.fine;
  }

  program([vertex, fragment]) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error("A shader does not compile: " + gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("The shaders do not link: " + gl.getProgramInfoLog(program));
    return program;
  }

  clampTo(target, filter) {
    const { gl } = this;
    for (const [name, value] of [[gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(target, name, value);
  }

  upload(target, data, width, height, depth) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(target, texture);
    const half = data instanceof Uint16Array;
    const inside = half ? gl.RGBA16F : gl.RGBA8, kind = half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    if (depth) gl.texImage3D(target, 0, inside, width, height, depth, 0, gl.RGBA, kind, data);
    else gl.texImage2D(target, 0, inside, width, height, 0, gl.RGBA, kind, data);
    this.clampTo(target, gl.LINEAR);
    return texture;
  }

  resize() {
    const bounds = element("stage").getBoundingClientRect();
    const frame = this.scene.frames[this.frame];
    const scale = this.still ? 1 : Math.min(bounds.width / frame.width, bounds.height / frame.height);
    const width = Math.max(1, Math.round(frame.width * scale)), height = Math.max(1, Math.round(frame.height * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) { this.canvas.width = width; this.canvas.height = height; }
    const photo = element("photo"), place = this.canvas.getBoundingClientRect();
    Object.assign(photo.style, { left: `${place.left - bounds.left}px`, top: `${place.top - bounds.top}px`, width: `${place.width}px`, height: `${place.height}px`,
      clipPath: `inset(0 ${100 - element("split").value / 10}% 0 0)` });
  }

  camera() { // the pose, moved to the side by the lane shift
    return { ...this.pose, eye: add(this.pose.eye, this.pose.right, this.shift * this.scene.metre) };
  }

  draw() {
    const { gl, scene } = this;
    this.resize();
    const pose = this.camera();
    const { width, height } = this.canvas;
    const wanted = this.smooth && !this.wireframe ? scene.rays : 1; // lines would fade
    const rays = Math.max(width, height) * wanted > this.largest ? 1 : wanted;
    const fine = rays > 1 ? this.raysBuffer(width * rays, height * rays) : null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, fine ? fine.frame : null);
    gl.viewport(0, 0, width * rays, height * rays);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    const set = (program, name, call, ...values) => {
      const place = gl.getUniformLocation(program, name);
      if (place) gl[call](place, ...values);
    };
    this.textures.forEach(([program, name, target, texture], index) => {
      gl.useProgram(program);
      gl.activeTexture(gl.TEXTURE0 + index);
      gl.bindTexture(target, texture);
      set(program, name, "uniform1i", index);
    });
    this.residuals?.use([this.mesh, this.sky], this.textures.length, pose);
    gl.useProgram(this.mesh);
    const matrix = multiply(projection(this.lens, scene.near, scene.far), viewOf(pose));
    set(this.mesh, "clip_from_scene", "uniformMatrix4fv", false, transposed(matrix));
    set(this.mesh, "eye", "uniform3fv", pose.eye);
    set(this.mesh, "mode", "uniform1i", this.mode);
    set(this.mesh, "pixel_right", "uniform3fv", pose.right.map((x) => (2 * x) / (this.canvas.width * this.lens[0])));
    set(this.mesh, "pixel_down", "uniform3fv", pose.up.map((x) => (-2 * x) / (this.canvas.height * this.lens[1])));
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.wireframe ? this.edgeBuffer : this.triangleBuffer);
    gl.drawElements(this.wireframe ? gl.LINES : gl.TRIANGLES, this.wireframe ? this.counts.edges : this.counts.triangles, gl.UNSIGNED_INT, 0);
    gl.useProgram(this.sky);
    set(this.sky, "world_from_camera", "uniformMatrix3fv", false, [...pose.right, ...pose.up, ...pose.back]);
    set(this.sky, "lens", "uniform4fv", this.lens);
    set(this.sky, "eye", "uniform3fv", pose.eye);
    set(this.sky, "mode", "uniform1i", this.mode);
    set(this.sky, "only", "uniform1i", this.skybox);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (!fine) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.resolve);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, fine.colour);
    set(this.resolve, "rays", "uniform1i", 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  settled() { // whether all is here that this view shows
    return !this.residuals || this.residuals.settled(this.camera());
  }

  goTo(index) { // a drive ends there
    this.setDriving(false);
    this.frame = (index + this.scene.frames.length) % this.scene.frames.length;
    const frame = this.scene.frames[this.frame];
    this.pose = poseOf(frame);
    this.lens = frame.lens;
    element("frames").value = String(this.frame);
    element("photo").src = frame.image;
  }

  look(dx, dy) {
    const { up } = this.scene, yaw = -dx * 0.003, pitch = -dy * 0.003;
    for (const name of ["right", "up", "back"]) this.pose[name] = unit(turned(turned(this.pose[name], this.pose.right, pitch), up, yaw));
  }

  move(seconds) {
    const step = SPEED * this.scene.metre * seconds * (this.keys.has("shift") ? 4 : 1);
    const go = (names, direction, sign) => {
      if (names.some((name) => this.keys.has(name))) this.pose.eye = add(this.pose.eye, direction, sign * step);
    };
    go(["w", "arrowup"], this.pose.back, -1);
    go(["s", "arrowdown"], this.pose.back, 1);
    go(["a", "arrowleft"], this.pose.right, -1);
    go(["d", "arrowright"], this.pose.right, 1);
    go(["q"], this.scene.up, -1);
    go(["e"], this.scene.up, 1);
  }

  drive(seconds) { // between the frames of one trajectory, a metre-true pace
    const path = this.scene.frames.filter((frame) => frame.trajectory === this.scene.frames[0].trajectory);
    if (path.length < 2) return;
    this.driving.at += (SPEED * this.scene.metre * seconds) / Math.max(1e-9, this.driving.spacing);
    const at = this.driving.at % (path.length - 1), from = Math.floor(at), part = at - from;
    const [a, b] = [poseOf(path[from]), poseOf(path[from + 1])];
    const mix = (name) => add(a[name].map((x) => x * (1 - part)), b[name], part);
    const back = unit(mix("back")), right = unit(cross(mix("up"), back));
    this.pose = { eye: mix("eye"), back, right, up: cross(back, right) };
  }

  setDriving(on) {
    element("drive").setAttribute("aria-pressed", String(on));
    this.driving = null;
    if (!on) return;
    const path = this.scene.frames.filter((frame) => frame.trajectory === this.scene.frames[0].trajectory).map(poseOf);
    const gaps = path.slice(1).map((pose, i) => Math.hypot(...add(pose.eye, path[i].eye, -1)));
    this.driving = { at: 0, spacing: gaps.length ? gaps.reduce((a, b) => a + b) / gaps.length : 1 };
  }

  // A link's #frame=3&shift=2&mode=1 chooses what is shown; still=1 draws one picture of the frame's own size in the corner, alone.
  follow(link) {
    const wanted = new URLSearchParams(link.slice(1));
    const number = (name, otherwise) => (wanted.has(name) ? Number(wanted.get(name)) : otherwise);
    this.goTo(number("frame", 0));
    this.shift = number("shift", 0);
    this.mode = number("mode", 0);
    this.skybox = number("skybox", -1);
    this.wireframe = wanted.get("wireframe") === "1";
    this.still = wanted.get("still") === "1";
    document.body.classList.toggle("still", this.still);
    element("mode").value = String(this.mode);
    element("skybox").value = String(this.skybox + 1);
    element("wireframe").checked = this.wireframe;
    for (const button of element("shifts").children)
      button.setAttribute("aria-pressed", String(Number(button.dataset.shift) === this.shift));
    this.draw();
  }

  run() {
    let before = performance.now();
    const tick = (now) => {
      const seconds = Math.min(0.1, (now - before) / 1000);
      this.times.push(now - before);
      before = now;
      if (this.times.length > 40) this.times.shift();
      const mean = this.times.reduce((a, b) => a + b) / this.times.length;
      element("timing").textContent = `${mean.toFixed(1)} ms, ${(1000 / mean).toFixed(0)} fps`;
      if (this.driving) this.drive(seconds);
      this.move(seconds);
      this.draw();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }
}

function controls(viewer) {
  const { scene, canvas } = viewer;
  const choice = (id, labels, change) => {
    const list = element(id);
    labels.forEach((label, index) => list.add(new Option(label, String(index))));
    list.onchange = () => change(Number(list.value));
  };
  choice("frames", scene.frames.map((frame) => `${frame.name} (${frame.split})`), (index) => viewer.goTo(index));
  choice("mode", ["full image", "mesh only", "skyboxes only", "opacity", "UV charts", "code indices"], (index) => { viewer.mode = index; });
  choice("skybox", ["all skyboxes", ...scene.skyboxes.half_sizes.map((half, i) => `skybox ${i + 1}, ${Math.round(Math.min(...half) / scene.metre)} m`)],
    (index) => { viewer.skybox = index - 1; });
  for (const shift of [-3, -2, 0, 2, 3]) {
    const button = document.createElement("button");
    button.textContent = shift > 0 ? `+${shift} m` : `${shift} m`;
    button.dataset.shift = String(shift);
    button.setAttribute("aria-pressed", String(shift === 0));
    button.onclick = () => {
      viewer.shift = shift;
      for (const other of element("shifts").children) other.setAttribute("aria-pressed", String(other === button));
    };
    element("shifts").append(button);
  }
  element("previous").onclick = () => viewer.goTo(viewer.frame - 1);
  element("next").onclick = () => viewer.goTo(viewer.frame + 1);
  element("wireframe").onchange = (event) => { viewer.wireframe = event.target.checked; };
  element("smooth").onchange = (event) => { viewer.smooth = event.target.checked; };
  element("smooth").parentElement.hidden = scene.rays === 1;
  element("residuals").onchange = (event) => { viewer.residuals.on = event.target.checked; };
  element("residuals").parentElement.hidden = !viewer.residuals;
  element("compare").onchange = (event) => {
    for (const id of ["photo", "split"]) element(id).hidden = !event.target.checked;
    if (event.target.checked) viewer.goTo(viewer.frame);
  };
  element("drive").onclick = () => viewer.setDriving(!viewer.driving);
  let held = null;
  canvas.onpointerdown = (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); canvas.focus(); };
  canvas.onpointermove = (event) => {
    if (!held) return;
    viewer.look(event.clientX - held[0], event.clientY - held[1]);
    held = [event.clientX, event.clientY];
  };
  canvas.onpointerup = canvas.onpointercancel = () => { held = null; };
  addEventListener("keydown", (event) => {
    if (event.target instanceof HTMLSelectElement || event.target instanceof HTMLInputElement) return;
    viewer.keys.add(event.key.toLowerCase());
  });
  addEventListener("keyup", (event) => viewer.keys.delete(event.key.toLowerCase()));
  addEventListener("blur", () => viewer.keys.clear());
  const megabytes = (viewer.scene.bytes / 1e6).toFixed(1);
  element("facts").textContent = `${scene.mesh.faces.toLocaleString("en")} faces, texture ${scene.mesh.width} x ${scene.mesh.height}, ${megabytes} MB loaded`;
}

try {
  const scene = await loadScene((text) => { element("message").textContent = text; });
  expandCodes(scene);
  const viewer = new Viewer(element("view"), scene);
  controls(viewer);
  viewer.follow(location.hash);
  addEventListener("hashchange", () => viewer.follow(location.hash));
  element("panel").hidden = viewer.still;
  element("message").textContent = "";
  window.lightmill = viewer; // for the browser's console
  if (!viewer.still) viewer.run();
  document.documentElement.dataset.ready = "true";
} catch (error) {
  element("message").textContent = error.message;
  document.documentElement.dataset.ready = "failed";
  throw error;
}
