// Keeps those tiles of a scene on the device that lie near the camera, each at the levels that its pixels ask for. The viewer
// knows nothing of it: it draws one mesh with one set of textures, and here both are refilled as the camera moves.
import { expandCodes, fetched } from "./loader.js";
import "./viewer.js"; // which is done when its viewer stands

const LOADS = 4; // files at a time
const FULL = 0.9; // of the pool's rows are asked for: images need rows side by side
const KEPT = 1.1; // tiles go at so many times the distance at which they come, or one at the border would come and go
const WIDE = 1024; // of the table of places
const AGAIN_MS = 5000; // until a file that could not be read is tried once more

const joined = (kind, arrays, grown = null) => { // one after the other; grown: what each array's numbers grow by
  const out = new kind(arrays.reduce((sum, array) => sum + array.length, 0));
  let at = 0;
  arrays.forEach((array, index) => {
    out.set(grown ? array.map((value) => value + grown[index]) : array, at);
    at += array.length;
  });
  return out;
};
const before = (counts) => counts.map((_, index) => counts.slice(0, index).reduce((a, b) => a + b, 0));

class Tiles {
  constructor(viewer) {
    const { gl, scene } = viewer;
    const { width, columns, height } = scene.tiles; // images of that width lie one below the other in columns
    Object.assign(this, { viewer, gl, scene, width, columns, height, rows: columns * height });
    if (Math.max(columns * width, height) > viewer.largest)
      throw new Error(`The tiles need a texture of ${columns * width} x ${height}; this browser takes ${viewer.largest}. Bake with a smaller bake.reach_m`);
    this.tiles = scene.tiles.each.map((about, number) => ({ ...about, number, geometry: null, pieces: [] }));
    for (const tile of this.tiles)
      tile.pieces = tile.rows.map((rows, level) => ({ tile, level, rows, state: "away", from: 0, data: null, places: null, problem: null, again: 0 }));
    this.spans = []; // pieces that have rows of the pool, by their first row
    this.drawn = [];
    this.loading = this.fetches = this.fetched = 0;
    this.stale = false; // what the viewer drew last is not what is here
    this.lacking = 0; // levels of tiles that this view asks for and the pool has no room for
    this.problem = null; // why a piece that this view needs is not here
    this.half = scene.expand === "fp16";
    this.maps = Array.from({ length: scene.textures }, () => this.pool(this.half ? gl.RGBA16F : gl.RGBA8, gl.LINEAR));
    this.codes = scene.quantized ? this.pool(gl.R16UI, gl.NEAREST) : null;
    this.places = gl.createTexture();
    this.maps.forEach((map, index) => this.replace(`mesh${index}`, map));
    if (this.codes) this.replace("codes", this.codes);
    viewer.textures.push([viewer.mesh, "places", gl.TEXTURE_2D, this.places]);
    this.buffers = Object.fromEntries(["position", "uv", "chart"].map((name) => [name, gl.createBuffer()]));
    viewer.vertices = gl.createVertexArray();
    gl.bindVertexArray(viewer.vertices);
    for (const [name, size] of [["position", 3], ["uv", 2], ["chart", 1]]) {
      const place = gl.getAttribLocation(viewer.mesh, name);
      if (place < 0) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
    }
    gl.bindVertexArray(null);
    this.sendGeometry();
    this.sendPlaces();
  }

  pool(inside, filter) {
    const { gl } = this, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, inside, this.columns * this.width, this.height);
    this.viewer.clampTo(gl.TEXTURE_2D, filter);
    return texture;
  }

  replace(name, texture) {
    const entry = this.viewer.textures.find(([program, other]) => program === this.viewer.mesh && other === name);
    this.gl.deleteTexture(entry[3]);
    entry[3] = texture;
  }

  // Bytes on the device: the pool, the skyboxes, vertices and faces.
  memory() {
    const { scene, drawn } = this, { count, side } = scene.skyboxes, texel = scene.textures * (this.half ? 8 : 4);
    const sum = (of) => drawn.reduce((total, { geometry }) => total + of(geometry).byteLength, 0);
    return {
      pool: this.width * this.rows * (texel + (this.codes ? 2 : 0)),
      skyboxes: 6 * count * side * side * texel,
      buffers: sum((g) => g.position) + sum((g) => g.uv) + sum((g) => g.chart) + 3 * sum((g) => g.faces), // faces, and their edges
    };
  }

  // The least side of what a pixel shows of a surface at distance 1, as tiles.py has it.
  pixel() {
    const { lens, canvas } = this.viewer;
    const slope = (axis) => (1 + Math.abs(lens[2 + axis])) / lens[axis];
    return Math.min(2 / (canvas.width * lens[0]), 2 / (canvas.height * lens[1])) / (1 + slope(0) ** 2 + slope(1) ** 2);
  }

  // Pieces that this view needs, the most urgent first, as many as the pool has room for. Sets the tiles' distances.
  wanted() {
    const { eye } = this.viewer.camera(), pixel = this.pixel();
    for (const tile of this.tiles)
      tile.distance = Math.hypot(...eye.map((x, axis) => Math.max(tile.low[axis] - x, x - tile.high[axis], 0)));
    const near = this.tiles.filter((tile) => tile.distance <= this.scene.tiles.reach).sort((a, b) => a.distance - b.distance);
    const wanted = new Set();
    let left = FULL * this.rows;
    this.lacking = 0;
    const add = (piece) => {
      if (piece.rows > left) return this.lacking++, false;
      left -= piece.rows;
      return wanted.add(piece);
    };
    const whole = near.filter((tile) => add(tile.pieces.at(-1))); // something of everything first
    for (const { density, distance, pieces } of whole) {
      const finest = Math.max(0, Math.floor(Math.log2(Math.max(1, density * distance * pixel))));
      for (let level = pieces.length - 2; level >= finest && add(pieces[level]); level--);
    }
    return wanted;
  }

  // Drops what is far, asks for what is missing.
  step() {
    const wanted = this.wanted(), now = performance.now();
    let changed = false;
    for (const tile of this.tiles) {
      const here = tile.pieces.filter((piece) => piece.state === "here");
      if (!here.length || tile.distance <= KEPT * this.scene.tiles.reach) continue;
      here.forEach((piece) => this.free(piece));
      tile.geometry = null;
      changed = true;
    }
    this.problem = [...wanted].find((piece) => piece.problem)?.problem ?? null;
    for (const piece of wanted) {
      if (this.loading >= LOADS) break;
      if (piece.state !== "away" || piece.again > now) continue;
      if (this.reserve(piece, wanted)) this.load(piece);
      else this.lacking++;
    }
    if (changed) this.refresh();
  }

  // Whether all is here that this view needs and the pool has room for; a still picture is drawn anew then. Throws where a file
  // cannot be read.
  settled() {
    this.step();
    if (this.problem) throw this.problem;
    if (this.loading) return false;
    if (this.stale && this.viewer.still) this.viewer.draw();
    this.stale = false;
    return true;
  }

  free(piece) {
    piece.state = "away";
    piece.data = piece.places = null;
    this.spans.splice(this.spans.indexOf(piece), 1);
  }

  // Rows of the pool for a piece, one below the other in one column. What nobody wants makes room, the farthest first. False
  // where that is not enough.
  reserve(piece, wanted) {
    const idle = this.spans.filter((other) => other.state === "here" && !wanted.has(other));
    idle.sort((a, b) => b.tile.distance - a.tile.distance || a.level - b.level);
    const kept = [...this.spans];
    let index = this.gap(piece, kept);
    for (let number = 0; index === null && number < idle.length; number++) {
      kept.splice(kept.indexOf(idle[number]), 1);
      index = this.gap(piece, kept);
    }
    if (index === null && kept.reduce((sum, other) => sum + other.rows, piece.rows) > FULL * this.rows) return false;
    this.spans.filter((other) => !kept.includes(other)).forEach((other) => this.free(other));
    if (index === null) index = this.closed(piece);
    if (index === null) return false;
    piece.state = "coming";
    this.spans.splice(index, 0, piece);
    return true;
  }

  // Moves all pieces together, so that the gaps between them become one at the end; as `gap`.
  closed(piece) {
    let from = 0, moved = false;
    for (const other of this.spans) {
      const below = from % this.height, start = below + other.rows > this.height ? from + this.height - below : from;
      if (start !== other.from) {
        other.from = start;
        moved = true;
        if (other.state === "here") this.send(other);
      }
      from = start + other.rows;
    }
    if (moved) this.refresh();
    return this.gap(piece, this.spans);
  }

  // Puts a piece where it leaves the least room beside it; which of the spans it comes before, or null.
  gap(piece, spans) {
    let from = 0, best = null, least = Infinity;
    [...spans, { from: this.rows, rows: 0 }].forEach((span, index) => {
      const below = from % this.height, start = below + piece.rows > this.height ? from + this.height - below : from;
      const left = span.from - start - piece.rows;
      if (left >= 0 && left < least) [best, least, piece.from] = [index, left, start];
      from = span.from + span.rows;
    });
    return best;
  }

  async load(piece) {
    this.loading++;
    const { tile, level } = piece, folder = `tiles/${tile.number}`;
    try {
      const files = [this.fetch(`${folder}/level_${level}.bin`)];
      if (level === tile.pieces.length - 1) files.push(this.fetch(`${folder}/geometry.glb`));
      const [packed, shape] = await Promise.all(files);
      const data = await new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
      if (shape) tile.geometry = readGeometry(await shape.arrayBuffer());
      piece.data = data; // codes are small beside what the device makes of them
      this.send(piece);
      piece.state = "here";
      piece.problem = null;
    } catch (error) {
      this.free(piece);
      piece.again = performance.now() + AGAIN_MS;
      this.problem = piece.problem = error;
    }
    this.loading--;
    this.refresh();
  }

  async fetch(name) {
    const blob = await (await fetched(name)).blob();
    this.fetches++;
    this.fetched += blob.size;
    return blob;
  }

  // Where a piece lies in the pool.
  corner({ from }) {
    return [this.width * Math.floor(from / this.height), from % this.height];
  }

  // Texels of a piece to its rows of the pool.
  send(piece) {
    const { gl, scene } = this, { data } = piece, start = 32 * piece.tile.charts, texels = this.width * piece.rows, [x, y] = this.corner(piece);
    piece.places = new Int32Array(data, 0, start / 4);
    const write = (texture, format, kind, values) => {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, this.width, piece.rows, format, kind, values);
    };
    gl.activeTexture(gl.TEXTURE0);
    let maps = this.maps.map((_, index) => new Uint8Array(data, start + (scene.quantized ? 0 : 4 * texels * index)));
    if (scene.quantized) {
      const part = { ...scene, meshCodes: new Uint16Array(data, start), skyCodes: new Uint16Array(0) };
      expandCodes(part);
      maps = part.meshMaps;
      write(this.codes, gl.RED_INTEGER, gl.UNSIGNED_SHORT, part.meshCodes);
    }
    this.maps.forEach((map, index) => write(map, gl.RGBA, this.half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE, maps[index]));
  }

  // The viewer's mesh and table follow what is here.
  refresh() {
    const drawn = this.tiles.filter((tile) => tile.geometry && tile.pieces.at(-1).state === "here");
    if (drawn.length !== this.drawn.length || drawn.some((tile, index) => tile !== this.drawn[index])) {
      this.drawn = drawn;
      this.sendGeometry();
    }
    this.sendPlaces();
    this.tell();
    this.stale = true;
  }

  sendGeometry() {
    const { gl, viewer } = this, all = this.drawn.map((tile) => tile.geometry);
    const charts = before(this.drawn.map((tile) => tile.charts)), vertices = before(all.map((one) => one.chart.length));
    const arrays = {
      position: joined(Float32Array, all.map((one) => one.position)),
      uv: joined(Float32Array, all.map((one) => one.uv)),
      chart: joined(Float32Array, all.map((one) => one.chart), charts),
    };
    for (const [name, buffer] of Object.entries(this.buffers)) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, arrays[name], gl.DYNAMIC_DRAW);
    }
    const faces = joined(Uint32Array, all.map((one) => one.faces), vertices), edges = new Uint32Array(2 * faces.length);
    for (let i = 0; i < faces.length; i += 3)
      edges.set([faces[i], faces[i + 1], faces[i + 1], faces[i + 2], faces[i + 2], faces[i]], 2 * i);
    gl.bindVertexArray(viewer.vertices);
    for (const [buffer, values] of [[viewer.triangleBuffer, faces], [viewer.edgeBuffer, edges]]) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    }
    gl.bindVertexArray(null);
    viewer.counts = { triangles: faces.length, edges: edges.length };
  }

  // Two texels for each level of each drawn tile's charts: steps from the whole level to the pool, the finest level that is here
  // and the chart; and the corners of the chart's texels in the pool.
  sendPlaces() {
    const { gl } = this, levels = this.tiles[0].pieces.length, count = this.drawn.reduce((sum, tile) => sum + tile.charts, 0);
    const high = Math.max(1, Math.ceil((2 * count * levels) / WIDE)), table = new Int32Array(4 * WIDE * high);
    let first = 0;
    for (const { charts, pieces } of this.drawn) {
      let finest = levels - 1;
      while (finest > 0 && pieces[finest - 1].state === "here") finest--;
      for (let level = 0; level < levels; level++) {
        const piece = pieces[Math.max(level, finest)]; // of levels that are not here any will do: their share is 0
        const [x, y] = this.corner(piece), { places } = piece;
        for (let chart = 0; chart < charts; chart++) {
          const [dx, dy, , number, left, top, right, bottom] = places.subarray(8 * chart, 8 * chart + 8);
          table.set([dx + x, dy + y, finest, number, left + x, top + y, right + x, bottom + y], 8 * (levels * (first + chart) + level));
        }
      }
      first += charts;
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.places);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32I, WIDE, high, 0, gl.RGBA_INTEGER, gl.INT, table);
    this.viewer.clampTo(gl.TEXTURE_2D, gl.NEAREST);
  }

  tell() {
    const megabytes = (bytes) => `${(bytes / 1e6).toFixed(1)} MB`, { pool, skyboxes, buffers } = this.memory();
    const faces = this.drawn.reduce((sum, tile) => sum + tile.faces, 0);
    document.getElementById("facts").textContent = this.problem ? this.problem.message :
      `${this.drawn.length} of ${this.tiles.length} tiles, ${faces.toLocaleString("en")} of ${this.scene.mesh.faces.toLocaleString("en")} faces; ` +
      `on the device ${megabytes(pool + skyboxes + buffers)}: textures ${megabytes(pool)}, skyboxes ${megabytes(skyboxes)}, mesh ${megabytes(buffers)}; ` +
      `${this.fetches} files fetched, ${megabytes(this.fetched)}${this.lacking ? "; memory is full, so far tiles are coarse" : ""}`;
  }
}

// Positions, texture coordinates, charts and faces of a binary glTF, in the order in which lightmill writes them.
function readGeometry(buffer) {
  const length = new DataView(buffer).getUint32(12, true);
  const { bufferViews } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const [faces, position, uv, chart] = bufferViews.map(({ byteOffset, byteLength }, index) =>
    new (index ? Float32Array : Uint32Array)(buffer, 28 + length + byteOffset, byteLength / 4));
  return { faces, position, uv, chart };
}

const viewer = window.lightmill;
try {
  viewer.tiles = new Tiles(viewer);
} catch (error) {
  document.getElementById("message").textContent = error.message;
  document.documentElement.dataset.ready = "failed";
  throw error;
}
const tick = () => {
  if (viewer.tiles.problem || !viewer.still) viewer.tiles.step();
  else viewer.tiles.settled();
  requestAnimationFrame(tick);
};
tick();
