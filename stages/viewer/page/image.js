// Linear HDR images, light by light: the sum of the lights' layers, each times its gain, exposed, tone mapped and encoded as
// stages.graphics.tonemap does it (`to_picture`). One WebGL 2 context draws all images of the page; each shows a copy.
import { decode, encode, hex, label, unhex } from "./colours.js";
import { choice, h, number, slider } from "./data.js";

const VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray lights;
uniform vec3 gains[64];
uniform int count, height, kind, mapper; // kind 0: radiance; 1: linear colour in [0, 1]; 2: as it is shown
uniform float exposure;
out vec4 colour;

const vec3 LUMINANCE = vec3(0.2126, 0.7152, 0.0722);
vec3 hable(vec3 x) { return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3; }
vec3 filmic(vec3 x) { return hable(2.0 * x) / hable(vec3(11.2)); }
vec3 aces(vec3 x) {
  x = mat3(0.59719, 0.07600, 0.02840, 0.35458, 0.90834, 0.13383, 0.04823, 0.01566, 0.83777) * (x / 0.6);
  x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081);
  return mat3(1.60475, -0.10208, -0.00327, -0.53108, 1.10813, -0.07276, -0.07367, -0.00605, 1.07602) * x;
}
vec3 agx(vec3 x) {
  const mat3 rec2020 = mat3(0.6274, 0.0691, 0.0164, 0.3293, 0.9195, 0.0880, 0.0433, 0.0113, 0.8956);
  const mat3 inset = mat3(0.856627153315983, 0.137318972929847, 0.11189821299995, 0.0951212405381588, 0.761241990602591,
    0.0767994186031903, 0.0482516061458583, 0.101439036467562, 0.811302368396859);
  const mat3 outset = mat3(1.1271005818144368, -0.1413297634984383, -0.14132976349843826, -0.11060664609660323,
    1.157823702216272, -0.11060664609660294, -0.016493938717834573, -0.016493938717834257, 1.2519364065950405);
  x = log2(max(inset * (rec2020 * x), vec3(1e-10)));
  x = clamp((x + 12.47393) / (4.026069 + 12.47393), 0.0, 1.0);
  x = (((((15.5 * x - 40.14) * x + 31.96) * x - 6.868) * x + 0.4298) * x + 0.1191) * x - 0.00232;
  return inverse(rec2020) * pow(max(outset * x, vec3(0)), vec3(2.2));
}
vec3 neutral(vec3 x) {
  float start = 0.76, low = min(x.r, min(x.g, x.b));
  vec3 base = x - (low < 0.08 ? low - 6.25 * low * low : 0.04);
  float peak = max(base.r, max(base.g, base.b));
  if (peak < start) return base;
  float pressed = 1.0 - (1.0 - start) * (1.0 - start) / (peak + 1.0 - 2.0 * start);
  float share = 1.0 / (0.15 * (peak - pressed) + 1.0);
  return base * (pressed / peak) * share + pressed * (1.0 - share);
}
vec3 mapped(vec3 x) {
  if (mapper == 1) return x / (1.0 + dot(x, LUMINANCE));
  if (mapper == 2) return filmic(x);
  if (mapper == 3) return aces(x);
  if (mapper == 4) return agx(x);
  if (mapper == 5) return neutral(x);
  return x;
}
vec3 encoded(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * x, vec3(lessThanEqual(x, vec3(0.0031308))));
}
void main() {
  ivec2 at = ivec2(int(gl_FragCoord.x), int(gl_FragCoord.y)); // row 0 is read back first
  vec3 sum = vec3(0);
  for (int i = 0; i < count; i++) sum += gains[i] * texelFetch(lights, ivec3(at, i), 0).rgb;
  colour = vec4(kind == 2 ? sum : encoded(kind == 1 ? sum : mapped(sum * exposure)), 1.0);
}`;

export const MAPPERS = ["none", "reinhard", "filmic", "aces", "agx", "pbr_neutral"];
const MOST_LIGHTS = 64;

class Painter {
  constructor() {
    this.canvas = document.createElement("canvas");
    const gl = (this.gl = this.canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false }));
    if (!gl) throw new Error("This browser has no WebGL 2: use a recent Firefox, Chrome, Edge or Safari");
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("The shaders do not link: " + gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = Object.fromEntries(["lights", "gains", "count", "height", "kind", "mapper", "exposure"].map((name) => [name, gl.getUniformLocation(program, name)]));
    this.largest = Math.min(MOST_LIGHTS, gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS));
  }

  // lights: (L, H, W, 3) half floats or floats.
  upload(lights) {
    const { gl } = this, [count, height, width] = lights.shape;
    if (count > this.largest) throw new Error(`This image has ${count} lights, the page draws ${this.largest}`);
    const texture = gl.createTexture(), half = lights.dtype === "float16";
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, half ? gl.RGB16F : gl.RGB32F, width, height, Math.max(count, 1), 0, gl.RGB,
      half ? gl.HALF_FLOAT : gl.FLOAT, count ? lights : new (half ? Uint16Array : Float32Array)(3 * width * height));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, gl.NEAREST);
    return { texture, count, height, width };
  }

  draw({ texture, count, height, width }, gains, { exposure = 1, mapper = 0, kind = 0 }) {
    const { gl, canvas, at } = this;
    if (canvas.width < width) canvas.width = width;
    if (canvas.height < height) canvas.height = height;
    gl.viewport(0, 0, width, height);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.uniform1i(at.count, count);
    if (count) gl.uniform3fv(at.gains, gains.flat());
    gl.uniform1i(at.kind, kind);
    gl.uniform1i(at.mapper, mapper);
    gl.uniform1f(at.exposure, exposure);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const pixels = new Uint8ClampedArray(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return new ImageData(pixels, width, height);
  }

  free(image) { if (image) this.gl.deleteTexture(image.texture); }
}

let painter = null;
const paint = () => (painter ??= new Painter());

const HALVES = new Float32Array(65536);
for (let i = 0; i < 65536; i++) {
  const sign = i & 0x8000 ? -1 : 1, exponent = (i >> 10) & 31, fraction = i & 1023;
  HALVES[i] = sign * (exponent === 0 ? fraction * 2 ** -24 : exponent === 31 ? (fraction ? NaN : Infinity) : (1 + fraction / 1024) * 2 ** (exponent - 15));
}
export const valueAt = (array, index) => (array.dtype === "float16" ? HALVES[array[index]] : array[index]);

// Another output of the renderer as (1, H, W, 3) and how it is shown.
const shownLayer = (name, layer) => {
  const [height, width, channels = 1] = layer.shape;
  if (name === "direct") return [Object.assign(layer.subarray(), { shape: [1, height, width, 3], dtype: layer.dtype }), 0];
  if (name === "albedo") return [Object.assign(layer.subarray(), { shape: [1, height, width, 3], dtype: layer.dtype }), 1];
  const out = new Float32Array(3 * height * width), index = layer.dtype === "int32";
  let top = 0;
  if (channels === 1 && !index) for (let i = 0; i < layer.length; i++) top = Math.max(top, valueAt(layer, i));
  for (let i = 0; i < height * width; i++) {
    const colour = index ? label(layer[i]) : channels === 3 ? [0, 1, 2].map((c) => 0.5 + 0.5 * valueAt(layer, 3 * i + c)) : new Array(3).fill(valueAt(layer, i) / (top || 1));
    out.set(colour, 3 * i);
  }
  return [Object.assign(out, { shape: [1, height, width, 3], dtype: "float32" }), 2];
};

// One image on a canvas. `image`: what stages.graphics.panels.Image became.
export class ImageView {
  constructor(image) {
    this.canvas = h("canvas", { class: "image" });
    this.exposure = 1;
    this.mapper = 0;
    this.layer = "image";
    this.gains = [];
    this.loaded = {};
    this.ondraw = () => {};
    if (image) this.show(image, true);
  }

  // Another image; gains and exposure stay unless `anew`.
  show(image, anew = false) {
    this.free();
    this.image = image;
    if (anew || this.gains.length !== image.lights.shape[0]) this.gains = Array.from({ length: image.lights.shape[0] }, () => [1, 1, 1]);
    if (anew) this.exposure = image.exposure;
    if (this.layer !== "image" && !(this.layer in image.layers)) this.layer = "image";
    this.draw();
  }

  free() { for (const [loaded] of Object.values(this.loaded)) painter?.free(loaded); this.loaded = {}; }

  draw() {
    if (!this.image) return;
    const name = this.layer;
    if (!(name in this.loaded)) {
      const [pixels, kind] = name === "image" ? [this.image.lights, 0] : shownLayer(name, this.image.layers[name]);
      this.loaded[name] = [paint().upload(pixels), kind];
    }
    const [texture, kind] = this.loaded[name];
    const picture = paint().draw(texture, name === "image" ? this.gains : [[1, 1, 1]], { exposure: this.exposure, mapper: this.mapper, kind });
    this.canvas.width = picture.width;
    this.canvas.height = picture.height;
    this.canvas.getContext("2d", { willReadFrequently: true }).putImageData(picture, 0, 0);
    this.ondraw();
  }

  // What is at a pixel, in words.
  at(x, y) {
    const [count, height, width] = this.image.lights.shape, i = y * width + x;
    if (x < 0 || y < 0 || x >= width || y >= height) return "";
    const sum = [0, 1, 2].map((c) => {
      let total = 0;
      for (let l = 0; l < count; l++) total += this.gains[l][c] * valueAt(this.image.lights, 3 * (l * height * width + i) + c);
      return number(+total.toPrecision(4));
    });
    const more = ["depth", "triangle", "object"].filter((name) => name in this.image.layers).map((name) => `${name} ${number(+valueAt(this.image.layers[name], i).toPrecision(4))}`);
    return [`x ${x}, y ${y}`, `radiance ${sum.join(" ")}`, ...more].join(" · ");
  }
}

const PRESETS = { none: "none (clamp)", pbr_neutral: "PBR neutral" };

// Exposure, tone mapper, layer, and a slider and colour for each light.
export const imageControls = (view, { lights = true, changed = () => {} } = {}) => {
  const redraw = () => { view.draw(); changed(); };
  const stops = (v) => `${v > 0 ? "+" : ""}${+v.toFixed(2)} EV`;
  const box = h("div", { class: "controls" });
  const exposure = slider("Exposure", { min: -10, max: 10, step: 0.25, value: Math.log2(view.exposure), show: stops, id: "exposure",
    on: (v) => { view.exposure = 2 ** v; redraw(); } });
  const names = ["image", ...Object.keys(view.image?.layers ?? {})];
  box.append(exposure,
    choice("Tone mapper", MAPPERS.map((name) => [name, PRESETS[name] ?? name]), MAPPERS[view.mapper], (name) => { view.mapper = MAPPERS.indexOf(name); redraw(); }, "mapper"));
  if (names.length > 1) box.append(choice("Layer", names.map((name) => [name, name === "image" ? "image, all lights" : name]), view.layer, (name) => { view.layer = name; redraw(); }, "layer"));
  if (lights && view.gains.length > 0) box.append(lightControls(view.gains.length, (light, gain) => { view.gains[light] = gain; redraw(); }, (l) => view.gains[l]));
  return box;
};

// A slider (0 to 4) and a colour for each light; set(light, [r, g, b]).
export const lightControls = (count, set, get) => {
  const rows = [];
  const list = h("fieldset", { class: "lights" }, h("legend", {}, count === 1 ? "Light" : `${count} lights`));
  for (let l = 0; l < count; l++) {
    const now = get(l), most = Math.max(...now);
    let gain = most, colour = most > 0 ? now.map((v) => v / most) : [1, 1, 1];
    const send = () => set(l, colour.map((v) => v * gain));
    const amount = slider(`Light ${l}`, { max: 4, step: 0.01, value: gain, show: (v) => `× ${v.toFixed(2)}`, id: `light-${l}`, on: (v) => { gain = v; send(); } });
    const pick = h("input", { type: "color", "aria-label": `Colour of light ${l}`, id: `colour-${l}`,
      value: hex(colour.map(encode)),
      oninput: () => { colour = unhex(pick.value).map(decode); send(); } });
    const alone = h("button", { type: "button", title: `Light ${l} alone; again: all`, "aria-label": `Light ${l} alone`, onclick: () => {
      const only = rows.every((row, k) => row.gain() === (k === l ? row.gain() : 0)) && gain > 0 && count > 1;
      rows.forEach((row, k) => row.to(only ? 1 : k === l ? Math.max(row.gain(), 1) : 0));
    } }, "solo");
    rows.push({ gain: () => gain, to: (v) => { gain = v; amount.set(v); send(); } });
    list.append(h("div", { class: "light" }, amount, pick, count > 1 ? alone : null));
  }
  list.append(h("button", { type: "button", onclick: () => rows.forEach((row) => row.to(1)) }, "All lights as stored"));
  return list;
};

// One image.
export const imagePanel = (image) => imagesPanel({ [image.title]: image });

// Images of one view side by side, {caption: image}: one exposure, tone mapper and layer for all; lights for those that have them.
export const imagesPanel = (images) => {
  const views = Object.values(images).map((image) => new ImageView(image)), lead = views.find((view) => Object.keys(view.image.layers).length) ?? views[0];
  const told = h("p", { class: "told" }, " ");
  for (const view of views) {
    view.exposure = lead.exposure;
    view.draw();
    view.canvas.addEventListener("pointermove", (event) => {
      const box = view.canvas.getBoundingClientRect(), x = Math.floor(((event.clientX - box.left) / box.width) * view.canvas.width), y = Math.floor(((event.clientY - box.top) / box.height) * view.canvas.height);
      told.textContent = view.at(x, y) || " ";
    });
  }
  const follow = () => { for (const view of views) if (view !== lead) { view.exposure = lead.exposure; view.mapper = lead.mapper; view.draw(); } };
  const figures = Object.keys(images).map((caption, i) => h("figure", {}, views[i].canvas, h("figcaption", {}, caption)));
  const element = h("div", { class: "split images" }, h("div", { class: "main" }, h("div", { class: "stage" }, figures), told), imageControls(lead, { changed: follow }));
  element.style.setProperty("--panes", String(views.length));
  return Object.assign(element, { views, free: () => views.forEach((view) => view.free()) });
};
