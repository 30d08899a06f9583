// Curves over steps, and the graph of a store's artifacts, as SVG.
import { bytes, count, h, number, s } from "./data.js";

const COLOURS = ["#4c8dd6", "#e08a2e", "#3aa673", "#b66bd1", "#d1566a", "#8a8f2b", "#2aa7b8", "#a3765a"];
const WIDTH = 640, HEIGHT = 240, LEFT = 62, BOTTOM = 28, TOP = 10, RIGHT = 12;

const ticks = (low, high, count) => {
  const rough = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(rough)), step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
  const out = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) out.push(+v.toPrecision(12));
  return out;
};

// One quantity of one or several runs: {run: [[step, value], ..]}.
export const plot = (name, runs) => {
  const all = Object.values(runs).flat(), positive = all.every(([, v]) => v > 0);
  const values = all.map(([, v]) => v), log = positive && Math.max(...values) / Math.min(...values) > 30;
  const at = log ? Math.log10 : (v) => v;
  let [low, high] = [Math.min(...values.map(at)), Math.max(...values.map(at))];
  if (low === high) { low -= Math.abs(low) * 0.1 || 1; high += Math.abs(high) * 0.1 || 1; }
  const steps = all.map(([step]) => step);
  let [first, last] = [Math.min(...steps), Math.max(...steps)];
  if (first === last) { first -= 1; last += 1; }
  const x = (v) => LEFT + ((v - first) / (last - first)) * (WIDTH - LEFT - RIGHT), y = (v) => HEIGHT - BOTTOM - ((at(v) - low) / (high - low)) * (HEIGHT - BOTTOM - TOP);
  const grid = log ? Array.from({ length: Math.floor(high) - Math.ceil(low) + 1 }, (_, i) => 10 ** (Math.ceil(low) + i)) : ticks(low, high, 4);
  return h("figure", { class: "plot" }, h("figcaption", {}, name, log ? h("span", { class: "soft" }, " (logarithmic)") : ""),
    s("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `${name} over steps` },
      grid.map((v) => [s("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(v), y2: y(v), class: "grid" }), s("text", { x: LEFT - 6, y: y(v) + 4, "text-anchor": "end" }, number(v))]),
      ticks(first, last, 6).map((v) => s("text", { x: x(v), y: HEIGHT - 8, "text-anchor": "middle" }, number(v))),
      Object.entries(runs).map(([run, points], i) => [
        s("polyline", { points: points.map(([step, v]) => `${x(step).toFixed(1)},${y(v).toFixed(1)}`).join(" "), fill: "none", stroke: COLOURS[i % COLOURS.length], "stroke-width": 1.6 }),
        points.length < 40 ? points.map(([step, v]) => s("circle", { cx: x(step), cy: y(v), r: 2.6, fill: COLOURS[i % COLOURS.length] }, s("title", {}, `${run} step ${step}: ${number(v)}`))) : null])));
};

export const key = (runs) => h("ul", { class: "key" }, runs.map((run, i) => h("li", {}, h("span", { class: "dot", style: `background: ${COLOURS[i % COLOURS.length]}` }), run)));

// Series of one run, or of several ({run: {name: points}}): the loss and what was validated first.
export const plots = (runs) => {
  const names = [...new Set(Object.values(runs).flatMap(Object.keys))], rank = (name) => (name === "loss" ? 0 : name.startsWith("validation") ? 1 : 2);
  names.sort((a, b) => rank(a) - rank(b));
  const draw = (name) => plot(name, Object.fromEntries(Object.entries(runs).filter(([, series]) => name in series).map(([run, series]) => [run, series[name]])));
  const first = names.filter((name) => rank(name) < 2), rest = names.filter((name) => rank(name) === 2);
  return h("div", {}, Object.keys(runs).length > 1 ? key(Object.keys(runs)) : "", h("div", { class: "plots" }, first.map(draw)),
    rest.length ? h("details", {}, h("summary", {}, `${rest.length} more`), h("div", { class: "plots" }, rest.map(draw))) : "");
};

// The store's artifacts as a graph: a column for each stage, an arrow from each input that no other input was made from. `here`: an artifact; only its line is drawn.
export const lineage = (artifacts, systems, here) => {
  const byKey = new Map(artifacts.map((artifact) => [artifact.key, artifact]));
  const parents = (artifact) => Object.values(artifact.inputs).map((key) => byKey.get(key)).filter(Boolean);
  const above = new Map(), ancestors = (artifact) => { // all that it was made from
    if (!above.has(artifact)) above.set(artifact, new Set(parents(artifact).flatMap((parent) => [parent, ...ancestors(parent)])));
    return above.get(artifact);
  };
  const nearest = (artifact) => parents(artifact).filter((parent) => !parents(artifact).some((other) => ancestors(other).has(parent)));
  let shown = new Set(artifacts);
  if (here) {
    shown = new Set([here]);
    const up = [here];
    while (up.length) for (const parent of parents(up.pop())) if (!shown.has(parent)) { shown.add(parent); up.push(parent); }
    let grown = true, down = new Set([here]);
    while (grown) { grown = false; for (const a of artifacts) if (!down.has(a) && parents(a).some((p) => down.has(p))) { down.add(a); shown.add(a); grown = true; } }
  }
  const columns = systems.flatMap(({ name, stages }) => stages.map((stage) => ({ system: name, stage, artifacts: artifacts.filter((a) => shown.has(a) && a.system === name && a.stage === stage) }))).filter((column) => column.artifacts.length);
  const wide = 112, high = 50, gap = 26, room = 12, rows = Math.max(...columns.map((column) => column.artifacts.length), 1);
  const place = new Map(), height = rows * (high + room) + 24;
  columns.forEach((column, i) => column.artifacts.forEach((artifact, k) => place.set(artifact, [i * (wide + gap), 24 + k * (high + room)])));
  const arrows = [...place].flatMap(([artifact, [x, y]]) => nearest(artifact).filter((parent) => place.has(parent)).map((parent) => {
    const [px, py] = place.get(parent), a = [px + wide, py + high / 2], b = [x, y + high / 2], bend = Math.max(13, (b[0] - a[0]) / 2);
    return s("path", { d: `M${a} C${a[0] + bend},${a[1]} ${b[0] - bend},${b[1]} ${b}`, class: "arrow" + (here && (artifact === here || parent === here) ? " near" : "") });
  }));
  const boxes = [...place].map(([artifact, [x, y]]) => s("a", { href: `#/artifact/${artifact.name}`, class: artifact === here ? "here" : "" },
    s("rect", { x, y, width: wide, height: high, rx: 7 }),
    s("text", { x: x + 9, y: y + 20 }, artifact.name.split("/").pop().replace(/-[0-9a-f]{12}$/, "").replace(/^(.{12}).{2,}$/, "$1…")),
    s("text", { x: x + 9, y: y + 37, class: "small" }, artifact.items ? count(artifact.records) : bytes(artifact.bytes)),
    s("title", {}, `${artifact.name}`)));
  const heads = columns.map((column, i) => s("text", { x: i * (wide + gap) + 2, y: 14, class: "head" }, column.stage));
  const width = columns.length * (wide + gap) - gap + 2;
  return h("div", { class: "graph" }, s("svg", { viewBox: `-1 0 ${width} ${height}`, width, height, role: "img", "aria-label": "Which artifact was made from which" }, arrows, boxes, heads));
};
