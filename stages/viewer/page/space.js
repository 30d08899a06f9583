// A space: surfaces, points and cameras in panes that share one sight; a stored image over its camera; what models make of it.
import { check, choice, failure, h, pathOf, slider } from "./data.js";
import { bounds, Sight, steer, Triangles, Viewport } from "./drawing.js";
import { gradient } from "./colours.js";
import { ImageView, imageControls } from "./image.js";
import { add, dot, poseOf, sub, times } from "./linear.js";
import { Model } from "./model.js";

const lensOf = (camera) => ({ x: camera.width / 2 / camera.fx, y: camera.height / 2 / camera.fy, cx: (2 * camera.cx) / camera.width - 1,
  cy: 1 - (2 * camera.cy) / camera.height, aspect: camera.width / camera.height, stored: true });

// The edges of a camera's frustum.
const frustum = (camera, size, colour) => {
  const pose = poseOf(camera.camera_to_world), corner = (u, v) => {
    const x = (u * camera.width - camera.cx) / camera.fx, y = (camera.cy - v * camera.height) / camera.fy;
    return add(add(add(pose.eye, pose.right, size * x), pose.up, size * y), pose.back, -size);
  };
  const corners = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)], top = add(times(add(corners[0], corners[1]), 0.5), pose.up, 0.25 * size);
  return [...corners.map((c) => [pose.eye, c, colour]), ...corners.map((c, i) => [c, corners[(i + 1) % 4], colour]), [corners[0], top, colour], [top, corners[1], colour]];
};

const KEYS = [["drag, arrows", "turn around"], ["Shift + drag, Shift + arrows", "move"], ["wheel, + −", "nearer, farther"], ["[ ]", "previous, next camera"], ["0", "outside"],
  ["w", "wireframe"], ["space", "turntable"], ["r", "begin again"], ["1 2 3 4 5", "preview, stored, model, path traced, difference"], ["click", "choose an object"], ["Alt + click", "attention of a pixel"]];

export class Space {
  // page: {load(path): a Lazy's value, query: of the address, artifact, file(photo): its address}
  constructor(panel, page) {
    this.panel = panel;
    this.page = page;
    this.sight = new Sight(panel.up, panel.flat);
    this.scene = panel.scene !== null;
    this.eye = null;
    this.mode = this.scene ? "preview" : panel.flat ? "chart" : "shaded";
    this.source = panel.panes[0].eyes.some((eye) => eye.image) ? "stored" : "preview";
    this.opacity = 1;
    this.view = new ImageView();
    this.photo = h("img", { alt: "", class: "image" });
    this.over = h("div", { class: "over", hidden: true });
    this.told = h("p", { class: "told" }, " ");
    this.legend = h("div", { class: "legend", hidden: true });
    this.free = () => { this.panes.forEach((pane) => pane.viewport.free()); this.view.free(); clearInterval(this.turning); removeEventListener("keydown", this.keys); };
    this.element = h("div", { class: "space-panel" });
    this.ready = this.build();
  }

  get eyes() { return this.panel.panes[0].eyes; }

  async build() {
    const { panel } = this;
    this.panes = panel.panes.map((pane) => {
      const viewport = new Viewport(this.sight);
      const name = h("figcaption", {}, pane.name);
      return { pane, viewport, name, shown: 0, kept: new Map() };
    });
    const first = this.panes[0];
    first.viewport.canvas.setAttribute("aria-label", `${panel.title}: drag or use the arrow keys to turn`);
    this.stage = h("div", { class: "stage" }, this.panes.map(({ viewport, name }, i) =>
      h("figure", {}, h("div", { class: "frame" }, viewport.canvas, i === 0 ? this.over : null), name)));
    this.boxes = Object.fromEntries(["shows", "camera", "lights", "image", "model", "surface", "objects", "keys"].map((name) => [name, h("div", { class: `box ${name}` })]));
    this.side = h("div", { class: "controls" }, Object.values(this.boxes));
    this.element.append(h("div", { class: "split" }, h("div", { class: "main" }, this.stage, this.told, this.legend), this.side), panel.note ? h("p", { class: "soft" }, panel.note) : "");
    for (const pane of this.panes) {
      steer(pane.viewport, () => this.rest(), (x, y, event) => this.click(pane, x, y, event));
      await this.surface(pane, 0);
    }
    const all = this.panes.map((pane) => pane.triangles?.bounds).filter(Boolean), points = panel.panes[0].points;
    this.sight.home = all[0] ?? { centre: [0, 0, 0], radius: 1 };
    if (this.scene) this.sight.home = { centre: [0, 0, 0], radius: 0.75 };
    else if (this.eyes.length && !all.length) this.sight.home = bounds(this.eyes.flatMap(({ camera }) => poseOf(camera.camera_to_world).eye));
    if (all.length && !this.scene && this.eyes.length) { // a place: what the cameras see, not all of it
      const seen = bounds(this.eyes.flatMap(({ camera }) => poseOf(camera.camera_to_world).eye));
      this.sight.home = { centre: seen.centre, radius: Math.min(all[0].radius, Math.max(1.6 * seen.radius, 0.05 * all[0].radius)) };
    }
    this.sight.changed.add(() => { if (!this.sight.lens?.stored) this.overlay(); });
    if (points) this.points(first, points);
    this.frusta();
    this.sight.reset();
    this.shape();
    this.controls();
    if (this.scene) this.model = new Model(this);
    await this.recolour();
    if (panel.eye !== null) await this.look(panel.eye);
    if (this.page.query.get("model") !== null && this.model) this.use("model");
    this.keys = (event) => this.key(event);
    addEventListener("keydown", this.keys);
  }

  async surface(pane, index) {
    pane.shown = index;
    let surface = pane.pane.surfaces[index];
    if (surface === undefined) { pane.triangles = null; return; }
    if (surface.lazy !== undefined) {
      pane.name.textContent = `${pane.pane.name}: loading ..`;
      try { surface = pane.pane.surfaces[index] = await this.page.load(surface.lazy); }
      catch (error) { pane.name.replaceChildren(failure(error)); pane.triangles = null; return; }
    }
    if (!pane.kept.has(index)) pane.kept.set(index, new Triangles(surface));
    pane.triangles = pane.kept.get(index);
    pane.viewport.setTriangles(pane.triangles);
    pane.name.textContent = `${pane.pane.name}: ${surface.name === pane.pane.name ? "" : surface.name + ", "}${pane.triangles.count.toLocaleString("en")} triangles`;
  }

  async points(pane, points) {
    try {
      const values = points.lazy !== undefined ? await this.page.load(points.lazy) : points, colours = new Float32Array((4 * values.length) / 3);
      for (let i = 0; i < colours.length; i += 4) colours.set([0.95, 0.6, 0.15, 1], i);
      pane.viewport.setPoints(values, colours);
      if (!pane.triangles && !this.eyes.length) { this.sight.home = bounds(values); this.sight.reset(); }
    } catch (error) { this.told.replaceChildren(failure(error)); }
  }

  frusta() {
    if (!this.eyes.length) return;
    const between = this.eyes.length > 1 ? Math.min(...this.eyes.slice(1).map((eye, i) => Math.hypot(...sub(poseOf(eye.camera.camera_to_world).eye, poseOf(this.eyes[i].camera.camera_to_world).eye)) || Infinity)) : Infinity;
    const size = this.scene ? 0.12 : Math.min(0.5 * between, 0.1 * this.sight.home.radius) || 0.1;
    this.panes[0].viewport.setLines(this.eyes.flatMap((eye, i) => (i === this.eye ? [] : frustum(eye.camera, size, [0.29, 0.56, 0.9, 1]))));
  }

  // The picture's shape: that of the camera, or ours.
  shape() {
    const aspect = this.sight.lens?.aspect ?? (this.scene ? 1 : this.panes.length > 1 ? 1 : 1.5);
    this.element.style.setProperty("--aspect", String(aspect));
    this.element.style.setProperty("--panes", String(this.panes.length));
    for (const { viewport } of this.panes) viewport.request();
  }

  controls() {
    const { panel, boxes } = this, modes = this.panes[0].triangles?.modes(this.scene) ?? [];
    const ladder = this.panes.findIndex(({ pane }) => pane.surfaces.length > 1);
    if (ladder >= 0) {
      const pane = this.panes[ladder], most = pane.pane.surfaces.length - 1;
      boxes.surface.append(slider("Rung", { max: most, step: 1, value: 0, id: "rung", show: (v) => `${v + 1} of ${most + 1}`, on: async (v) => { await this.surface(pane, v); await this.recolour(); } }));
    }
    if (modes.length) boxes.surface.append(choice("Colours", modes.map((mode) => [mode, mode]), this.mode, (mode) => { this.mode = mode; this.recolour(); }, "mode"));
    const checks = h("div", { class: "checks" });
    if (modes.length) checks.append((this.wire = check("wireframe", panel.flat, (on) => this.panes.forEach(({ viewport }) => { viewport.wire = on; viewport.request(); }), "wire")));
    if (panel.flat) this.panes.forEach(({ viewport }) => { viewport.wire = true; });
    const toggles = [["cameras", "lines", this.eyes.length], ["points", "points", panel.panes[0].points], ["surface", "surface", modes.length && (this.eyes.length && !this.scene)]];
    for (const [text, what, there] of toggles) if (there) checks.append(check(text, true, (on) => { this.panes[0].viewport.show[what] = on; this.panes[0].viewport.request(); }, `show-${what}`));
    const buttons = h("div", { class: "buttons" }, h("button", { type: "button", onclick: () => this.outside() }, this.eyes.length ? "Outside" : "Begin again"));
    if (!panel.flat) buttons.append((this.turn = h("button", { type: "button", "aria-pressed": "false", id: "turntable", onclick: () => this.turntable() }, "Turntable")));
    boxes.surface.append(checks, buttons);
    if (this.eyes.length) {
      this.picker = choice("Camera", [["", "outside"], ...this.eyes.map((eye, i) => [String(i), eye.name + (eye.image ? "" : " (no image)")])], "", (i) => (i === "" ? this.outside() : this.look(+i)), "camera");
      this.amount = slider("Image over it", { value: 1, id: "opacity", show: (v) => `${Math.round(100 * v)} %`, on: (v) => { this.opacity = v; this.overlay(); } });
      boxes.camera.append(this.picker, this.eyes.some((eye) => eye.image) || this.scene ? this.amount : "");
    }
    this.imageBox = boxes.image;
    boxes.keys.append(h("details", {}, h("summary", {}, "Keys and mouse"), h("dl", { class: "keys" }, KEYS.map(([key, what]) => [h("dt", {}, key), h("dd", {}, what)]))));
  }

  async recolour() {
    for (const pane of this.panes) {
      const { triangles, viewport } = pane;
      if (!triangles) continue;
      const { values } = triangles.surface;
      let mode = triangles.modes(this.scene).includes(this.mode) ? this.mode : "shaded", extra = null;
      if (this.attention && pane === this.panes[0]) { extra = this.attention; mode = "attention"; }
      if (values[mode]?.lazy !== undefined) {
        this.told.textContent = `${mode}: computing ..`;
        try { values[mode] = await this.page.load(values[mode].lazy); this.told.textContent = " "; }
        catch (error) { this.told.replaceChildren(failure(error)); continue; }
      }
      viewport.shading = mode === "preview" ? 2 : mode === "shaded" ? 1 : 0;
      const [colours, range] = triangles.colours(mode === "preview" ? "diffuse" : mode, extra);
      if (mode === "preview") this.model ? this.model.paint(colours) : this.lit(colours);
      viewport.setColours(colours);
      if (pane === this.panes[0]) this.explain(mode, range);
    }
  }

  lit(colours) { // before there is a model
    const light = this.panes[0].triangles.surface.labels.light;
    for (let f = 0; f < light.length; f++) if (light[f] >= 0) colours[3 * f] = -1;
  }

  explain(mode, range) {
    this.legend.hidden = !range;
    if (range) this.legend.replaceChildren(h("span", {}, (+range[0].toPrecision(3)).toString()), h("span", { class: "bar", style: `background: ${gradient}` }), h("span", {}, (+range[1].toPrecision(3)).toString()),
      h("span", { class: "soft" }, mode === "area" ? "area (logarithmic), squared units" : mode === "smallest angle" ? "smallest angle, degrees" : mode === "attention" ? "weight (its square root as colour)" : mode));
  }

  // -- cameras and images

  async look(index) {
    const eye = this.eyes[index];
    this.eye = index;
    this.picker.select.value = String(index);
    const pose = poseOf(eye.camera.camera_to_world), ahead = dot(sub(this.sight.home.centre, pose.eye), times(pose.back, -1));
    this.sight.through(pose, lensOf(eye.camera), Math.max(ahead, 0.2 * this.sight.home.radius));
    this.shape();
    this.frusta();
    this.stored = null;
    this.overlay();
    if (eye.image) {
      try {
        const image = (eye.loaded ??= await this.page.load(eye.image.lazy));
        if (this.eye !== index) return;
        this.stored = image;
        if (this.scene && this.source === "stored") this.show(image);
        else if (image.kind === "photo") { this.photo.src = this.page.photo(image); await this.photo.decode().catch(() => {}); }
      } catch (error) { this.told.replaceChildren(failure(error)); }
    }
    this.overlay();
    await this.model?.rested();
  }

  // An HDR image over the surface, with its controls.
  show(image) {
    const anew = !this.view.image;
    if (anew) this.view.exposure = image.exposure;
    this.view.show(image);
    if (this.model) this.model.gainsOf(image);
    else this.view.draw();
    const layers = Object.keys(image.layers).join();
    if (this.layers !== layers || anew) {
      this.layers = layers;
      this.imageBox.replaceChildren(imageControls(this.view, { lights: false, changed: () => this.preview() }));
    }
    this.preview();
  }

  preview() { if (this.model) { this.model.expose(this.view.exposure); } }

  overlay() {
    const inside = this.sight.lens?.stored && this.eye !== null;
    let content = null;
    if (this.scene && this.model && this.source !== "stored" && this.source !== "preview") content = this.model.over();
    else if (this.source === "stored" && inside && this.stored) content = this.stored.kind === "photo" ? this.photo : this.view.image === this.stored ? this.view.canvas : null;
    this.over.hidden = content === null || this.opacity === 0;
    this.over.style.opacity = String(this.opacity);
    if (content && this.over.firstChild !== content) this.over.replaceChildren(content);
    if (!inside && this.eye !== null) { this.eye = null; if (this.picker) this.picker.select.value = ""; this.frusta(); }
  }

  outside() {
    this.eye = null;
    this.stored = null;
    if (this.picker) this.picker.select.value = "";
    this.sight.reset();
    this.shape();
    this.frusta();
    this.overlay();
    this.model?.rested();
  }

  // What is shown over the surface: preview, stored, model, traced or difference.
  use(source) {
    this.source = source;
    this.model?.chosen(source);
    if (source === "stored" && this.stored && this.stored.kind !== "photo") this.show(this.stored);
    this.overlay();
    return this.model?.rested();
  }

  rest() { this.overlay(); this.model?.rested(); }

  click(pane, x, y, event) {
    if (this.model && pane === this.panes[0]) this.model.clicked(x, y, event);
    else {
      const hit = pane.viewport.pick(x, y);
      if (hit) this.told.textContent = `triangle ${hit.face} · area ${(+pane.triangles.area[hit.face].toPrecision(3)).toString()} · smallest angle ${pane.triangles.angle[hit.face].toFixed(1)}°`;
    }
  }

  turntable() {
    const on = !this.turning;
    clearInterval(this.turning);
    this.turning = on ? setInterval(() => this.sight.orbit(0.02, 0), 33) : null;
    this.turn.setAttribute("aria-pressed", String(on));
    if (!on) this.rest();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA|BUTTON|SUMMARY|A)$/.test(document.activeElement?.tagName ?? "")) return;
    if (!this.element.isConnected || document.querySelector(".space-panel") !== this.element) return; // the first of a page
    const camera = (step) => { if (this.eyes.length) this.look(((this.eye ?? (step > 0 ? -1 : 0)) + step + this.eyes.length) % this.eyes.length); };
    const keys = { "[": () => camera(-1), "]": () => camera(1), 0: () => this.outside(), w: () => this.wire?.input.click(), " ": () => !this.panel.flat && this.turntable(),
      r: () => this.outside(), 1: () => this.use("preview"), 2: () => this.use("stored"), 3: () => this.use("model"), 4: () => this.use("traced"), 5: () => this.use("difference") };
    if (!(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  }
}

