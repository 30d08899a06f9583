// Answers of the server, and elements of the page.

const ARRAYS = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int16: Int16Array, int32: Int32Array,
  float16: Uint16Array, float32: Float32Array }; // half floats stay as their bits

// What stages.graphics.panels.pack wrote: arrays become typed arrays with `shape` and `dtype`.
export const unpack = (buffer) => {
  const length = new DataView(buffer).getUint32(0, true);
  const value = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const rich = (value) => {
    if (Array.isArray(value)) return value.map(rich);
    if (value === null || typeof value !== "object") return value;
    if ("$" in value) {
      const [at, dtype, shape] = value.$;
      const array = new ARRAYS[dtype](buffer, 4 + length + at, shape.reduce((a, b) => a * b, 1));
      return Object.assign(array, { shape, dtype });
    }
    return Object.fromEntries(Object.entries(value).map(([name, v]) => [name, rich(v)]));
  };
  return rich(value);
};

const answered = async (response) => {
  const packed = response.headers.get("Content-Type") === "application/octet-stream";
  const value = packed ? unpack(await response.arrayBuffer()) : await response.json();
  if (!response.ok) throw new Error(value.error ?? `the server answers ${response.status}`);
  return value;
};

const reach = async (...words) => {
  try {
    return await fetch(...words);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("The viewer does not answer: it was stopped, or this machine is asleep. Start `lightmill view` again.");
  }
};

export const ask = async (name, query = {}) => answered(await reach(`/api/${name}?${new URLSearchParams(query)}`));

export const act = async (system, name, values) =>
  answered(await reach(`/api/act/${system}/${name}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values) }));

// h("a", {href: "#/"}, "store"): an element. Names that begin with "on" are listeners, others attributes or properties.
export const h = (tag, properties = {}, ...children) => {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && typeof value !== "string") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
};

// New content of an element.
export const put = (element, ...children) =>
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false && child !== ""));

const SVG = "http://www.w3.org/2000/svg";
export const s = (tag, properties = {}, ...children) => {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(properties))
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== null) element.setAttribute(name, value);
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
};

export const pathOf = (name) => name.split("/").map(encodeURIComponent).join("/");

export const bytes = (n) => {
  for (const unit of ["B", "kB", "MB", "GB"]) {
    if (n < 1000) return `${n < 10 && unit !== "B" ? n.toFixed(1) : Math.round(n)} ${unit}`;
    n /= 1000;
  }
  return `${n.toFixed(1)} TB`;
};

export const count = (n) => `${n.toLocaleString("en")} ${n === 1 ? "record" : "records"}`;

export const duration = (seconds) => {
  if (seconds < 90) return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} days`;
};

export const number = (n) => (Number.isInteger(n) ? n.toLocaleString("en") : Math.abs(n) >= 1e5 || (n !== 0 && Math.abs(n) < 1e-3) ? n.toExponential(3) : String(+n.toPrecision(5)));

export const failure = (error) => h("p", { class: "failure", role: "alert" }, error.message ?? String(error));

// A slider with its name and value: on(value) while it moves, done(value) when it is let go.
export const slider = (name, { min = 0, max = 1, step = 0.01, value = 0, show = (v) => number(v), on = () => {}, done = () => {}, id }) => {
  const text = h("output", {}, show(value));
  const input = h("input", { type: "range", min: String(min), max: String(max), step: String(step), id, "aria-label": name,
    oninput: () => { text.textContent = show(+input.value); on(+input.value); }, onchange: () => done(+input.value) });
  input.value = value;
  const element = h("label", { class: "slider" }, h("span", {}, name), input, text);
  return Object.assign(element, { input, set: (v) => { input.value = v; text.textContent = show(v); } });
};

export const choice = (name, options, value, on, id) => {
  const select = h("select", { id, onchange: () => on(select.value), "aria-label": name },
    options.map(([key, text]) => h("option", { value: key, selected: key === value }, text)));
  return Object.assign(h("label", { class: "choice" }, h("span", {}, name), select), { select });
};

export const check = (name, value, on, id) => {
  const input = h("input", { type: "checkbox", checked: value, id, onchange: () => on(input.checked) });
  return Object.assign(h("label", { class: "check" }, input, h("span", {}, name)), { input });
};
