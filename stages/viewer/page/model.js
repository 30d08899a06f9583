// A scene that can be changed, and what models make of it: predictions, path-traced truth, difference, metrics, attention.
import { act, choice, failure, h, slider } from "./data.js";
import { decode, encode, hex, unhex } from "./colours.js";
import { bounds } from "./drawing.js";
import { ImageView, lightControls } from "./image.js";
import { add, cross, length, matrixOf, moved, placed, sub, times, unit } from "./linear.js";

const GAIN = 5; // of the difference
const SIZES = [64, 128, 256, 512];
const SHOWS = [["preview", "Preview"], ["stored", "Stored"], ["model", "Model"], ["traced", "Path traced"], ["difference", "Difference"]];

const sizeOf = ({ lights: { shape } }) => `${shape[2]} x ${shape[1]}`;

export class Model {
  constructor(space) {
    this.space = space;
    this.scene = space.panel.scene;
    this.system = space.page.system;
    this.viewport = space.panes[0].viewport;
    this.triangles = space.panes[0].triangles;
    this.original = { corners: this.triangles.corners.slice(), normals: this.triangles.normals.slice() };
    const { object, light } = this.triangles.surface.labels;
    this.object = object;
    this.light = light;
    this.count = Math.max(-1, ...light) + 1;
    this.objects = space.panel.objects.length ? space.panel.objects : Array.from({ length: Math.max(-1, ...object) + 1 }, (_, i) => ({ name: `object ${i}`, kind: "object" }));
    this.edits = { objects: {}, materials: {} };
    this.placing = {}; // object -> {degrees, shift}
    this.gains = Array.from({ length: this.count }, () => [1, 1, 1]);
    this.chosenObject = null;
    this.size = 256;
    this.spp = 64;
    this.predicted = new ImageView();
    this.traced = new ImageView();
    this.difference = document.createElement("canvas");
    this.difference.className = "image";
    this.asked = 0; // requests so far: an answer to an older one is dropped
    this.busy = 0;
    this.told = h("p", { class: "told", "aria-live": "polite", id: "model-told" }, " ");
    this.scores = h("dl", { class: "scores" });
    this.exposure = this.guess();
    this.build();
  }

  build() {
    this.shows = h("div", { class: "shows", role: "radiogroup", "aria-label": "What is shown" }, SHOWS.map(([key, text], i) =>
      h("button", { type: "button", role: "radio", "aria-checked": String(key === this.space.source), "data-show": key, title: `key ${i + 1}`, disabled: key === "stored" && !this.space.eyes.some((eye) => eye.image), onclick: () => this.space.use(key) }, text)));
    const { boxes } = this.space;
    boxes.shows.append(this.shows, this.told);
    this.checkpoint = h("div", {});
    const lights = this.count ? lightControls(this.count, (l, gain) => { this.gains[l] = gain; this.relight(); }, (l) => this.gains[l]) : null;
    lights?.addEventListener("change", () => this.rested()); // let go
    lights?.addEventListener("click", (event) => { if (event.target.tagName === "BUTTON") this.rested(); });
    this.editor = h("fieldset", { class: "editor" }, h("legend", {}, "Objects"));
    this.part = choice("Object", [["", "click one, or choose"], ...this.objects.map((o, i) => [String(i), `${o.name} (${o.kind})`])], "", (i) => this.choose(i === "" ? null : +i), "object");
    this.sliders = h("div", {});
    this.editor.append(this.part, this.sliders);
    if (lights) boxes.lights.append(lights);
    const middle = h("button", { type: "button", title: "Alt + click asks for any other pixel", onclick: () => this.look(0.5, 0.5) }, "Attention of the middle pixel");
    boxes.model.append(this.checkpoint, h("div", { class: "buttons" }, middle), this.scores);
    boxes.objects.append(this.editor);
    this.start();
  }

  async start() {
    try {
      const all = await act(this.system, "checkpoints", {});
      const wanted = this.space.page.query.get("model");
      this.model = all.find(({ id }) => id === wanted)?.id ?? all[0]?.id;
      if (!all.length) { this.checkpoint.replaceChildren(h("p", { class: "soft" }, "No model: train one, or give --checkpoint.")); return; }
      const pixels = choice("Pixels per side", SIZES.map((n) => [String(n), String(n)]), String(this.size), (n) => { this.size = +n; this.rested(); }, "size");
      const trained = () => { // the picture is as large as those that the model was trained with
        const { resolution } = all.find(({ id }) => id === this.model);
        this.size = SIZES.reduce((a, b) => (Math.abs(b - resolution) < Math.abs(a - resolution) ? b : a));
        pixels.select.value = String(this.size);
      };
      trained();
      this.checkpoint.replaceChildren(
        choice("Model", all.map(({ id, name }) => [id, name]), this.model, (id) => { this.model = id; trained(); this.rested(); }, "checkpoint"),
        pixels,
        choice("Paths per pixel", [16, 64, 256, 1024].map((n) => [String(n), String(n)]), String(this.spp), (n) => { this.spp = +n; this.rested(); }, "spp"));
      this.known = true;
      await this.rested();
    } catch (error) { this.checkpoint.replaceChildren(failure(error)); }
  }

  // -- the scene as it is now

  // Exposure of the preview where no image tells one.
  guess() {
    const seen = [], lights = this.lamps();
    const middle = (f) => times(add(add(this.triangles.corner(f, 0), this.triangles.corner(f, 1)), this.triangles.corner(f, 2)), 1 / 3);
    for (let f = 0; f < this.triangles.count; f += Math.max(1, Math.floor(this.triangles.count / 400))) {
      if (this.light[f] >= 0) continue;
      const at = middle(f), n = [0, 1, 2].map((c) => this.triangles.flat[9 * f + c]);
      seen.push(lights.reduce((sum, { place, power }) => { const to = sub(place, at), r = length(to) || 1; return sum + (power[1] * Math.abs(to[0] * n[0] + to[1] * n[1] + to[2] * n[2])) / r ** 3 / Math.PI; }, 0));
    }
    seen.sort((a, b) => a - b);
    const typical = seen[Math.floor(seen.length * 0.6)];
    return typical > 0 ? 0.7 / typical : 1;
  }

  // Lights of the preview: one for each light of the scene.
  lamps() {
    const lamps = [], { emission } = this.triangles.surface.colours;
    for (let l = 0; l < this.count; l++) {
      let place = [0, 0, 0], direction = [0, 0, 0], power = [0, 0, 0], area = 0;
      for (let f = 0; f < this.triangles.count; f++) {
        if (this.light[f] !== l) continue;
        const [a, b, c] = [0, 1, 2].map((k) => this.triangles.corner(f, k)), n = cross(sub(b, a), sub(c, a)), size = length(n) / 2;
        place = add(place, add(add(a, b), c), size / 3);
        direction = add(direction, n);
        power = power.map((p, k) => p + size * emission[3 * f + k] * this.gains[l][k]);
        area += size;
      }
      if (area) lamps.push({ place: times(place, 1 / area), direction: unit(direction), power });
    }
    return lamps;
  }

  // Colours of the preview: materials as they were changed; a light is negative.
  paint(colours) {
    for (let f = 0; f < this.triangles.count; f++) {
      const material = this.edits.materials[this.object[f]];
      if (material?.diffuse) colours.set(material.diffuse, 3 * f);
      if (this.light[f] >= 0) colours[3 * f] = -1;
    }
    this.lamp();
  }

  lamp() {
    const { viewport } = this, lamps = this.lamps();
    viewport.lights = lamps;
    viewport.ambient = [0, 1, 2].map((k) => 0.12 * lamps.reduce((sum, { power }) => sum + power[k], 0) / 4);
    viewport.exposure = this.exposure;
    viewport.request();
  }

  expose(exposure) {
    this.exposure = exposure;
    this.lamp();
    for (const view of [this.predicted, this.traced]) { view.exposure = exposure; view.mapper = this.space.view.mapper; if (view.image) view.draw(); }
    this.subtract();
  }

  gainsOf() { this.relight(); }

  // Lights have changed: stored and path-traced images follow exactly, light by light.
  relight() {
    for (const view of [this.space.view, this.traced])
      if (view.image && view.image.lights.shape[0] === this.count) { view.gains = this.gains; view.draw(); }
    this.lamp();
    this.subtract();
  }

  apply() { // objects have moved
    const { corners, normals } = this.triangles;
    corners.set(this.original.corners);
    normals.set(this.original.normals);
    for (let f = 0; f < this.triangles.count; f++) {
      const matrix = this.edits.objects[this.object[f]];
      if (!matrix) continue;
      const m = matrix.flat();
      for (let i = 9 * f; i < 9 * f + 9; i += 3) {
        corners.set(moved(m, corners.slice(i, i + 3)), i);
        normals.set(moved(m, normals.slice(i, i + 3), 0), i);
      }
    }
    for (let f = 0; f < this.triangles.count; f++) if (this.edits.objects[this.object[f]]) this.triangles.measure(f);
    this.viewport.setTriangles(this.triangles);
    this.lamp();
  }

  // -- one object

  clicked(x, y, event) {
    if (event?.altKey) { this.look(x, y); return; }
    const hit = this.viewport.pick(x, y);
    if (!hit) return;
    this.told.textContent = `triangle ${hit.face} of ${this.objects[this.object[hit.face]]?.name ?? "an object"}`;
    this.choose(this.object[hit.face]);
  }

  choose(index) {
    this.chosenObject = index;
    this.part.select.value = index === null ? "" : String(index);
    this.sliders.replaceChildren();
    if (index === null) return;
    const place = (this.placing[index] ??= { degrees: [0, 0, 0], shift: [0, 0, 0] });
    const faces = [...this.object.keys()].filter((f) => this.object[f] === index), first = faces[0], { diffuse, specular } = this.triangles.surface.colours;
    const corners = faces.flatMap((f) => [...this.original.corners.subarray(9 * f, 9 * f + 9)]), centre = bounds(corners).centre;
    const still = () => { this.overlayOff(); };
    const set = () => {
      const matrix = placed(place.degrees, place.shift, centre);
      this.edits.objects[index] = [0, 4, 8, 12].map((r) => matrix.slice(r, r + 4));
      this.apply();
      still();
    };
    const done = () => this.rested();
    const axes = ["x", "y", "z"];
    this.sliders.append(
      ...axes.map((axis, i) => slider(`Move ${axis}`, { min: -1, max: 1, step: 0.01, value: place.shift[i], id: `move-${axis}`, show: (v) => v.toFixed(2), on: (v) => { place.shift[i] = v; set(); }, done })),
      ...[2, 0, 1].map((i) => slider(`Turn about ${axes[i]}`, { min: -180, max: 180, step: 1, value: place.degrees[i], id: `turn-${axes[i]}`, show: (v) => `${v}°`, on: (v) => { place.degrees[i] = v; set(); }, done })));
    if (this.light[first] < 0) {
      const material = this.edits.materials[index] ?? {}, edit = (name, value) => { (this.edits.materials[index] ??= {})[name] = value; this.space.recolour(); still(); };
      const now = material.diffuse ?? [0, 1, 2].map((k) => diffuse[3 * first + k]);
      const colour = h("input", { type: "color", value: hex(now.map(encode)), id: "diffuse", oninput: () => edit("diffuse", unhex(colour.value).map(decode)), onchange: done });
      this.sliders.append(h("label", { class: "choice" }, h("span", {}, "Diffuse colour"), colour),
        slider("Specular", { value: material.specular?.[0] ?? specular[3 * first], id: "specular", show: (v) => v.toFixed(2), on: (v) => edit("specular", [v, v, v]), done }),
        slider("Roughness", { min: 0.01, value: material.roughness ?? this.triangles.surface.values.roughness[first], id: "roughness", show: (v) => v.toFixed(2), on: (v) => edit("roughness", v), done }));
    }
    this.sliders.append(h("button", { type: "button", onclick: () => { delete this.edits.objects[index]; delete this.edits.materials[index]; delete this.placing[index]; this.apply(); this.space.recolour(); this.choose(index); this.rested(); } }, "As stored"));
  }

  overlayOff() { this.space.over.hidden = true; this.fresh = null; } // the preview alone follows a drag

  // -- pictures of the model

  chosen(source) {
    for (const button of this.shows.children) button.setAttribute("aria-checked", String(button.dataset.show === source));
  }

  over() {
    if (this.fresh !== this.wanted()) return null;
    const { source } = this.space;
    if (source === "model") return this.predicted.image ? this.predicted.canvas : null;
    if (source === "traced") return this.traced.image ? this.traced.canvas : null;
    return this.predicted.image && this.traced.image ? this.difference : null;
  }

  // What decides a picture, but for its size.
  request() {
    const { pose, lens, fov } = this.space.sight;
    return { scene: this.scene, checkpoint: this.model, edits: { ...this.edits, lights: Object.fromEntries(this.gains.map((gain, l) => [l, gain])) },
      camera: { camera_to_world: matrixOf(pose), fov_deg: lens ? (2 * Math.atan(lens.y) * 180) / Math.PI : fov, aspect: lens?.aspect ?? 1 } };
  }

  wanted() { const { scene, edits: { objects, materials }, camera } = this.request(); return JSON.stringify([scene, objects, materials, camera]); }

  settled() { return this.busy === 0; }

  // The camera or an edit came to rest: render what is shown, coarse first.
  async rested() {
    const { source } = this.space, turn = ++this.asked;
    this.scores.replaceChildren();
    if (!this.known || (source !== "model" && source !== "traced" && source !== "difference")) { this.space.overlay(); return; }
    const request = this.request(), wanted = this.wanted();
    this.busy++;
    try {
      if (source !== "traced") {
        const sizes = [...SIZES.filter((n) => n < this.size && n >= this.size / 4), this.size];
        for (const resolution of sizes) {
          if (resolution === sizes[0]) this.told.textContent = "the model renders ..";
          const answer = await act(this.system, "predict", { ...request, resolution });
          if (turn !== this.asked) return;
          this.fresh = wanted;
          this.put(this.predicted, answer.image);
          this.told.textContent = `model: ${sizeOf(answer.image)} in ${answer.seconds.toFixed(2)} s${answer.notes.map((note) => ` · ${note}`).join("")}`;
          this.space.overlay();
        }
      }
      if (source !== "model") {
        this.told.textContent += " · path tracing ..";
        const answer = await act(this.system, "trace", { ...request, resolution: this.size, spp: this.spp });
        if (turn !== this.asked) return;
        this.fresh = wanted;
        this.traced.gains = this.gains;
        this.put(this.traced, answer.image);
        this.told.textContent = `path traced: ${sizeOf(answer.image)}, ${this.spp} samples per pixel in ${answer.seconds.toFixed(1)} s`;
        this.space.overlay();
        if (source === "difference") {
          const scores = await act(this.system, "compare", { ...request, resolution: this.size });
          if (turn !== this.asked) return;
          this.scores.replaceChildren(...Object.entries(scores).flatMap(([name, text]) => [h("dt", {}, name), h("dd", {}, text)]));
          this.told.textContent += ` · difference of the two pictures x${GAIN}`;
        }
      }
    } catch (error) {
      if (turn === this.asked) this.told.replaceChildren(failure(error));
    } finally { this.busy--; }
  }

  put(view, image) {
    if (!this.space.view.image && !view.image) { this.exposure = image.exposure; this.lamp(); }
    view.exposure = this.exposure;
    view.mapper = this.space.view.mapper;
    view.show(image);
    if (!this.space.view.image) this.plainControls(view);
    this.subtract();
  }

  // Exposure and tone mapper where no image is stored.
  plainControls(view) {
    if (this.plain) return;
    this.plain = slider("Exposure", { min: -10, max: 10, step: 0.25, value: Math.log2(view.exposure), id: "exposure", show: (v) => `${v > 0 ? "+" : ""}${v.toFixed(2)} EV`, on: (v) => this.expose(2 ** v) });
    this.space.imageBox.replaceChildren(this.plain);
  }

  subtract() {
    const [a, b] = [this.predicted.canvas, this.traced.canvas];
    if (!this.predicted.image || !this.traced.image || a.width !== b.width || a.height !== b.height) return;
    const { width, height } = a, [p, q] = [a, b].map((canvas) => canvas.getContext("2d", { willReadFrequently: true }).getImageData(0, 0, width, height));
    for (let i = 0; i < p.data.length; i++) p.data[i] = i % 4 === 3 ? 255 : GAIN * Math.abs(p.data[i] - q.data[i]);
    this.difference.width = width;
    this.difference.height = height;
    this.difference.getContext("2d").putImageData(p, 0, 0);
  }

  // What a pixel attends to, on the triangles, layer by layer.
  async look(x, y) {
    this.told.textContent = "attention ..";
    this.busy++;
    try {
      const { weights, registers } = await act(this.system, "attention", { ...this.request(), resolution: this.size, pixel: [x, y] });
      const [layers, faces] = weights.shape;
      const show = (layer) => {
        this.space.attention = weights.subarray(layer * faces, (layer + 1) * faces);
        this.told.textContent = `layer ${layer + 1} of ${layers}: ${(100 * registers[layer]).toFixed(1)} % of the attention on registers`;
        this.space.recolour();
      };
      this.layer?.remove();
      this.layer = h("div", {}, slider("Attention, layer", { min: 1, max: layers, step: 1, value: layers, id: "attention-layer", on: (v) => show(v - 1) }),
        h("button", { type: "button", onclick: () => { this.space.attention = null; this.layer.remove(); this.space.recolour(); } }, "Without attention"));
      this.space.boxes.model.append(this.layer);
      await this.space.use("preview");
      show(layers - 1);
    } catch (error) { this.told.replaceChildren(failure(error)); }
    finally { this.busy--; }
  }
}

