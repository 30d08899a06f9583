// What the photos nearest to the camera know beyond the textures (residuals.py says what is computed). Files are loaded as the
// camera moves; each photo has a layer of two texture arrays until another one needs it.
import { fetched } from "./loader.js";

const LOADS = 2; // photos at a time
const AGAIN_MS = 5000; // until a file that could not be read is tried once more
const ALIKE = Math.cos(Math.PI / 4), UNLIKE = Math.cos((5 * Math.PI) / 12); // as in Python

export class Residuals {
  constructor(viewer) {
    const { gl, scene } = viewer, { sources, layers } = scene.residuals;
    Object.assign(this, { viewer, gl, about: scene.residuals, layers, on: true, loading: 0 });
    this.width = Math.max(...sources.map(({ width }) => width));
    this.height = Math.max(...sources.map(({ height }) => height));
    this.photos = sources.map((source) => ({ ...source, state: "away", layer: null, wanted: 0, again: 0, problem: null }));
    this.free = Array.from({ length: layers }, (_, layer) => layer);
    this.clock = 0;
    this.values = this.array(gl.LINEAR);
    this.depths = this.array(gl.NEAREST);
  }

  array(filter) {
    const { gl } = this, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, this.width, this.height, this.layers);
    this.viewer.clampTo(gl.TEXTURE_2D_ARRAY, filter);
    return texture;
  }

  // The photos of a pose's view, with their weights: as Residuals.chosen in Python.
  chosen({ eye, back }) {
    const { nearest, soft, off_mesh } = this.about;
    for (const photo of this.photos) {
      const cosine = -photo.matrix[2].slice(0, 3).reduce((sum, x, axis) => sum + x * back[axis], 0);
      const elsewhere = Math.min(Math.max((ALIKE - cosine) / (ALIKE - UNLIKE), 0), 1);
      photo.distance = Math.hypot(...eye.map((x, axis) => x - photo.eye[axis])) + off_mesh * elsewhere;
    }
    const order = [...this.photos].sort((a, b) => a.distance - b.distance).slice(0, nearest + 1);
    const last = order.length > nearest ? 1 / (order[nearest].distance + soft) : 0;
    const chosen = order.slice(0, nearest);
    for (const photo of chosen) photo.weight = 1 / (photo.distance + soft) - last;
    const sum = Math.max(1e-30, chosen.reduce((total, { weight }) => total + weight, 0));
    for (const photo of chosen) photo.weight /= sum;
    return chosen;
  }

  // Asks for photos that a pose's view takes and that are not here; returns those that it takes.
  step(pose) {
    const chosen = this.chosen(pose), now = performance.now();
    for (const photo of chosen) photo.wanted = ++this.clock;
    for (const photo of chosen)
      if (photo.state === "away" && photo.again <= now && this.loading < LOADS) this.load(photo, chosen);
    return chosen;
  }

  async load(photo, chosen) {
    if (!this.free.length) {
      const idle = this.photos.filter((other) => other.state === "here" && !chosen.includes(other));
      if (!idle.length) return; // layers that come will be free
      const oldest = idle.reduce((a, b) => (a.wanted < b.wanted ? a : b));
      oldest.state = "away";
      this.free.push(oldest.layer);
    }
    const { gl } = this;
    photo.layer = this.free.pop();
    photo.state = "coming";
    this.loading++;
    try {
      const read = async (name) => createImageBitmap(await (await fetched(`residuals/${name}.png`)).blob(), { premultiplyAlpha: "none", colorSpaceConversion: "none" });
      const [values, depths] = await Promise.all([read(photo.name), read(`${photo.name}.depth`)]);
      gl.activeTexture(gl.TEXTURE0);
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      for (const [texture, picture] of [[this.values, values], [this.depths, depths]]) {
        gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
        gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, photo.layer, photo.width, photo.height, 1, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        picture.close();
      }
      photo.state = "here";
      photo.problem = null;
      if (this.viewer.still) this.viewer.draw(); // nothing else draws it anew
    } catch (error) {
      photo.state = "away";
      photo.again = performance.now() + AGAIN_MS;
      photo.problem = error;
      this.free.push(photo.layer);
    }
    this.loading--;
  }

  // Whether all photos of this view are here. Throws where one cannot be read.
  settled(pose) {
    const chosen = this.step(pose), problem = chosen.find((photo) => photo.problem)?.problem;
    if (problem) throw problem;
    return chosen.every(({ state }) => state === "here");
  }

  // Binds both textures from a unit on and sets the uniforms of programs, for a pose's view.
  use(programs, unit, pose) {
    const { gl } = this, chosen = this.step(pose), count = this.about.nearest;
    const matrices = new Float32Array(16 * count), eyes = new Float32Array(3 * count), about = new Float32Array(4 * count);
    chosen.forEach((photo, k) => {
      if (!this.on || photo.state !== "here") return;
      photo.matrix.forEach((row, r) => row.forEach((value, c) => { matrices[16 * k + 4 * c + r] = value; }));
      eyes.set(photo.eye, 3 * k);
      about.set([photo.weight, photo.width, photo.height, photo.layer], 4 * k);
    });
    for (const [offset, texture] of [[0, this.values], [1, this.depths]]) {
      gl.activeTexture(gl.TEXTURE0 + unit + offset);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    }
    for (const program of programs) {
      gl.useProgram(program);
      const place = (name) => gl.getUniformLocation(program, name);
      gl.uniform1i(place("residuals"), unit);
      gl.uniform1i(place("depths"), unit + 1);
      gl.uniformMatrix4fv(place("photo_matrix"), false, matrices);
      gl.uniform3fv(place("photo_eye"), eyes);
      gl.uniform4fv(place("photo_about"), about);
    }
  }
}
