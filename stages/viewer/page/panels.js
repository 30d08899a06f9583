// Panels, as stages.graphics.panels has them, as elements. `page` says what they belong to.
import { failure, h, number, slider } from "./data.js";
import { imagePanel, imagesPanel } from "./image.js";
import { plots } from "./plots.js";
import { Space } from "./space.js";

const plain = (value) => (typeof value === "number" ? number(value) : value === null ? "–" : String(value));
const simple = (value) => value === null || typeof value !== "object" || (Array.isArray(value) && value.length <= 16 && value.every((v) => v === null || typeof v !== "object"));

const many = (value) => {
  const n = Object.keys(value).length;
  return `${n.toLocaleString("en")} ${Array.isArray(value) ? (n === 1 ? "entry" : "entries") : n === 1 ? "value" : "values"}`;
};

// Nested JSON as lists of names and values; long ones are folded.
const facts = (values, depth = 0) => {
  if (simple(values)) return h("span", {}, Array.isArray(values) ? values.map(link).flatMap((v, i) => (i ? [", ", v] : [v])) : link(values));
  if (!Object.keys(values).length) return h("span", { class: "soft" }, "none");
  const entries = Object.entries(values), shown = entries.slice(0, 200), rest = entries.length - shown.length;
  return h("dl", { class: "facts" }, shown.map(([name, value]) => {
    const inner = simple(value) || !Object.keys(value).length ? facts(value) : h("details", { open: depth === 0 && Object.keys(value).length <= 8 }, h("summary", {}, many(value)), lazily(() => facts(value, depth + 1)));
    return [h("dt", {}, name), h("dd", {}, inner)];
  }), rest > 0 ? [h("dt", {}, "…"), h("dd", {}, `${rest.toLocaleString("en")} more`)] : "");
};
const link = (value) => (typeof value === "string" && value.startsWith("#/") ? h("a", { href: value }, value.split("/").pop().replace(/\?.*/, "")) : plain(value));

// What is inside a closed <details> is made when it is opened.
const lazily = (make) => {
  const place = h("div", {});
  queueMicrotask(() => {
    const details = place.parentElement, fill = () => { if (details.open && !place.firstChild) place.append(make()); };
    details?.addEventListener("toggle", fill);
    if (details) fill();
  });
  return place;
};

const pictures = ({ sources, slider: one }, page) => {
  const entries = Object.entries(sources), figure = ([caption, name]) => h("figure", { class: "shot" }, h("a", { href: page.source(name), target: "_blank" }, h("img", { src: page.source(name), alt: caption, loading: "lazy" })), h("figcaption", {}, caption));
  if (!one || entries.length < 2) return h("div", { class: "gallery" }, entries.map(figure));
  const image = h("img", { src: page.source(entries.at(-1)[1]), alt: "" }), last = entries.length - 1;
  return h("div", {}, slider("Step", { max: last, step: 1, value: last, show: (i) => entries[i][0], on: (i) => { image.src = page.source(entries[i][1]); } }), h("figure", { class: "shot" }, image));
};

const spaceOf = (panel, page) => {
  const space = new Space(panel, page);
  space.ready = space.ready.catch((error) => { space.element.replaceChildren(failure(error)); });
  page.spaces.push(space);
  return Object.assign(space.element, { free: space.free });
};

const KINDS = {
  facts: ({ values }) => facts(values),
  words: ({ text }) => h("pre", {}, text),
  pictures,
  page: ({ file }, page) => h("div", {}, h("p", {}, h("a", { href: page.source(file), target: "_blank" }, "Open in a tab of its own")),
    h("iframe", { src: page.source(file), title: file, loading: "lazy", sandbox: "allow-scripts" })),
  video: ({ file }, page) => h("video", { src: page.source(file), controls: true, loop: true, preload: "metadata" }),
  curves: ({ title, series }) => plots({ [title]: series }),
  image: imagePanel,
  images: ({ images }, page) => {
    const box = h("div", {}, h("p", { class: "soft" }, "loading .."));
    const load = async () => {
      const loaded = Object.fromEntries(await Promise.all(Object.entries(images).map(async ([caption, { lazy }]) => [caption, await page.load(lazy)])));
      const element = imagesPanel(loaded);
      page.freed.push(element.free);
      box.replaceChildren(element);
      box.views = element.views;
    };
    page.pending.push(load().catch((error) => box.replaceChildren(failure(error))));
    return box;
  },
  space: (panel, page) => {
    if (!page.spaces.length) return spaceOf(panel, page);
    const box = h("div", { class: "waiting" }, h("p", { class: "soft" }, "loading ..")); // drawn when it is scrolled to
    const watcher = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      watcher.disconnect();
      const element = spaceOf(panel, page);
      page.freed.push(element.free);
      box.replaceWith(element);
    });
    watcher.observe(box);
    return Object.assign(box, { free: () => watcher.disconnect() });
  },
};
const FOLDED = ["facts", "words"]; // below the pictures, closed where there are pictures

// The elements of all panels.
export const drawPanels = (panels, page) => panels.map((panel) => {
  const box = h("section", { class: "panel" });
  const fill = (panel) => {
    const make = () => { try { return KINDS[panel.kind]?.(panel, page) ?? failure(new Error(`a panel of kind ${panel.kind} is not known to this page`)); } catch (error) { return failure(error); } };
    if (FOLDED.includes(panel.kind) && panels.length > 1) box.replaceChildren(h("details", { open: panel.kind === "facts" && panels.length < 4 && JSON.stringify(panel.values).length < 1500 }, h("summary", {}, h("h2", {}, panel.title)), lazily(make)));
    else { const element = make(); if (element.free) page.freed.push(element.free); box.replaceChildren(h("h2", {}, panel.title), element); }
  };
  if (panel.lazy === undefined) fill(panel);
  else {
    box.append(h("p", { class: "soft" }, "loading .."));
    page.pending.push(page.load(panel.lazy).then(fill).catch((error) => box.replaceChildren(failure(error))));
  }
  return box;
});

export { facts };
