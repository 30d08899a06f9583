// The viewer's pages, by the address behind #: the store, an artifact, a record, a reject, runs, a file.
import { ask, bytes, count, duration, failure, h, pathOf, put } from "./data.js";
import { drawPanels, facts } from "./panels.js";
import { lineage, plots } from "./plots.js";

const main = document.querySelector("main"), trail = document.querySelector("#trail");
let page = null; // what is shown: {freed, pending, spaces}
let turn = 0; // pages so far: an answer to an older one is dropped
let start = null;

const nameParts = (name) => { const parts = name.split("/"); return { folder: parts.pop(), place: parts.join("/") }; };
const artifactLink = (name, text) => h("a", { href: `#/artifact/${name}` }, text ?? name);
const recordLink = (name, id) => h("a", { href: `#/record/${name}/${id}` }, id);

const crumbs = (...links) => trail.replaceChildren(...links.flatMap((link, i) => (i ? [h("span", { class: "soft" }, "/"), link] : [link])));
const home = () => h("a", { href: start.store ? "#/" : "#/file" }, start.store ? "store" : start.file);

const fresh = (query) => ({ freed: [], pending: [], spaces: [], query });
const pageOf = (query, artifact, record) => ({
  ...fresh(query),
  artifact,
  system: artifact && artifact.split("/").length === 3 ? artifact.split("/")[0] : "renderformer",
  load: (path) => ask("lazy", { artifact: artifact ?? "", record: record ?? "", path }),
  source: (name) => (record ? `/member/${pathOf(artifact)}/${record}/${name}` : `/files/${start.word}/${pathOf(artifact)}/${pathOf(name)}`),
  photo: (photo) => `/member/${pathOf(photo.artifact)}/${photo.record}/${photo.member}`,
});

// -- the store

const rejectCount = (rejects) => Object.values(rejects).reduce((a, b) => a + b, 0);

const card = (artifact) => {
  const { folder } = nameParts(artifact.name), lost = rejectCount(artifact.rejects);
  return h("a", { class: "card", href: `#/artifact/${artifact.name}` },
    h("strong", {}, folder.replace(/-[0-9a-f]{12}$/, "")), h("code", {}, artifact.key.slice(0, 12)),
    h("span", {}, artifact.items ? count(artifact.records) : "files"),
    lost ? h("span", { class: "bad" }, `${lost.toLocaleString("en")} rejected`) : "",
    h("span", { class: "soft" }, `${bytes(artifact.bytes)}, ${duration(artifact.age_s)} ago${artifact.pinned ? ", pinned" : ""}`));
};

const progress = (state) => {
  const total = state.total ?? 0, done = state.done ?? 0, running = state.state === "running";
  const rate = state.seconds ? (done - (state.reused ?? 0)) / state.seconds : 0;
  const words = total ? `${done.toLocaleString("en")} of ${total.toLocaleString("en")} items${running && rate > 0 ? `, ${duration((total - done) / rate)} left` : ""}` : state.line ?? `${state.parts_done} parts`;
  const lost = Object.entries(state.rejects ?? {}).map(([reason, count]) => `${count} ${reason}`).join(", ");
  return h("div", { class: `run ${state.state}` }, h("strong", {}, state.place), h("code", {}, state.key.slice(0, 12)),
    h("span", { class: running ? "good" : "bad" }, running ? `running, process ${state.holder?.pid}` : state.state === "stopped" ? "stopped" : "not running: its process ended without a word"),
    total ? h("progress", { max: total, value: done, "aria-label": `${state.place}: items done` }) : "", h("span", {}, words), lost ? h("span", { class: "bad" }, `rejected: ${lost}`) : "",
    state.line && total ? h("span", { class: "soft" }, state.line) : "",
    (state.failures ?? []).slice(0, 5).map((failed) => h("span", { class: "bad" }, `${failed.item}: ${failed.error}`)),
    state.items?.length ? h("span", { class: "soft" }, "now: " + state.items.slice(0, 4).map(({ item, seconds }) => `${item} (${duration(seconds)})`).join(", ")) : "",
    state.message ? h("span", { class: "bad" }, state.message) : "", !running && state.command ? h("span", { class: "soft" }, "go on: ", h("code", {}, state.command)) : "");
};

const storePage = async (mine) => {
  const overview = await ask("store");
  if (mine !== turn) return;
  crumbs(home(), h("span", { class: "soft" }, overview.store));
  page = fresh();
  const runs = h("div", { class: "runs", "aria-live": "polite", id: "runs" }, overview.states.map(progress));
  const of = (system, stage) => overview.artifacts.filter((a) => a.system === system && a.stage === stage).reverse();
  put(main, 
    h("h1", {}, "Store"), runs,
    overview.damaged.map((name) => h("p", { class: "failure" }, `${name} is damaged: `, h("code", {}, `lightmill repair ${name}`), " makes it anew")),
    overview.artifacts.length ? h("p", {}, h("a", { href: "#/runs" }, "Compare trainings")) : h("p", { class: "soft" }, "The store is empty. ", h("code", {}, "make data"), " fills it."),
    overview.systems.filter(({ name, stages }) => stages.some((stage) => of(name, stage).length)).map(({ name, stages }) => h("section", { class: "panel" }, h("h2", {}, name),
      h("table", { class: "stages" }, h("tbody", {}, stages.map((stage, i) => h("tr", {}, h("th", { scope: "row" }, h("span", { class: "soft" }, String(i).padStart(2, "0")), " ", stage), h("td", {}, h("div", { class: "cards" }, of(name, stage).map(card))))))))),
    overview.artifacts.length ? h("section", { class: "panel" }, h("h2", {}, "What was made from what"), overview.systems.map(({ name, stages }) => {
      const own = overview.artifacts.filter((a) => a.system === name);
      return own.length ? lineage(own, [{ name, stages }]) : "";
    })) : "");
  watch(overview, runs);
};

// A run's progress, live; when an artifact was made, the page again.
const watch = (overview, runs) => {
  const mine = turn;
  let before = JSON.stringify(overview.states.map(({ key }) => key));
  const look = async () => {
    if (mine !== turn) return;
    try {
      const states = await ask("states"), now = JSON.stringify(states.map(({ key }) => key));
      if (mine !== turn) return;
      if (now !== before) { show(); return; }
      put(runs, ...states.map(progress));
      setTimeout(look, states.some(({ state }) => state === "running") ? 1000 : 4000);
    } catch (error) { put(runs, failure(error)); setTimeout(look, 5000); }
  };
  setTimeout(look, 1000);
};

// -- an artifact

const pager = (total, start, size, go) => total <= size ? "" : h("div", { class: "buttons" },
  h("button", { type: "button", disabled: start === 0, onclick: () => go(Math.max(0, start - size)) }, "Previous"),
  h("span", { class: "soft" }, `${(start + 1).toLocaleString("en")} to ${Math.min(total, start + size).toLocaleString("en")} of ${total.toLocaleString("en")}`),
  h("button", { type: "button", disabled: start + size >= total, onclick: () => go(start + size) }, "Next"));

const recordList = (name) => {
  const box = h("div", {}), find = h("input", { type: "search", placeholder: "find a record", "aria-label": "Find a record", oninput: () => { clearTimeout(find.waits); find.waits = setTimeout(() => fill(0), 200); } });
  const fill = async (start) => {
    try {
      const { total, records } = await ask("records", { artifact: name, start, find: find.value });
      put(box, h("ul", { class: "ids" }, records.map((row) => h("li", {}, recordLink(name, row.id), row.group ? h("span", { class: "soft" }, row.group) : "", h("span", { class: "soft" }, bytes(row.bytes))))),
        total ? "" : h("p", { class: "soft" }, "no record has that in its name"), pager(total, start, 100, fill));
    } catch (error) { put(box, failure(error)); }
  };
  fill(0);
  return h("div", {}, find, box);
};

const rejectList = (about) => {
  const box = h("div", {}), reasons = Object.entries(about.rejects);
  const fill = async (reason, start = 0) => {
    for (const button of buttons.children) button.setAttribute("aria-pressed", String(button.dataset.reason === reason));
    try {
      const { total, rejects } = await ask("rejects", { artifact: about.name, reason, start });
      put(box, h("div", { class: "wide" }, h("table", {}, h("tbody", {}, rejects.map((row) => h("tr", {}, h("td", {}, h("a", { href: `#/reject/${about.name}/${encodeURIComponent(row.item)}` }, row.item)), h("td", {}, row.reason), h("td", { class: "soft" }, row.detail)))))), pager(total, start, 100, (at) => fill(reason, at)));
    } catch (error) { put(box, failure(error)); }
  };
  const buttons = h("div", { class: "buttons" }, reasons.map(([reason, count]) => h("button", { type: "button", "data-reason": reason, title: about.reasons[reason] ?? "", onclick: () => fill(reason) }, `${reason} ${count.toLocaleString("en")}`)));
  fill(reasons[0][0]);
  return h("div", {}, h("p", { class: "soft" }, reasons.map(([reason]) => (about.reasons[reason] ? `${reason}: ${about.reasons[reason]}. ` : ""))), buttons, box);
};

const artifactPage = async (mine, name, query) => {
  const [about, overview] = await Promise.all([ask("artifact", { artifact: name }), ask("store")]);
  if (mine !== turn) return;
  const { place, folder } = nameParts(name);
  crumbs(home(), h("span", {}, place), h("span", {}, folder));
  page = pageOf(query, name);
  const lost = rejectCount(about.rejects), here = overview.artifacts.find((a) => a.name === name);
  const place0 = h("div", {}, h("p", { class: "soft" }, "loading .."));
  put(main, 
    h("h1", {}, `${about.stage}: ${folder.replace(/-[0-9a-f]{12}$/, "")}`),
    h("dl", { class: "tiles" }, [["records", about.items ? `${about.records.toLocaleString("en")} of ${about.items.toLocaleString("en")}` : "none, files alone"], ["rejected", lost.toLocaleString("en")], ["size", bytes(about.bytes)], ["made in", duration(about.made.seconds)]].map(([k, v]) => h("div", {}, h("dt", {}, k), h("dd", {}, v)))),
    lineage(overview.artifacts.filter((a) => a.system === about.system), overview.systems.filter((system) => system.name === about.system), here),
    about.records ? h("section", { class: "panel" }, h("h2", {}, "Records"), recordList(name)) : "",
    lost ? h("section", { class: "panel" }, h("h2", {}, "Rejects"), rejectList(about)) : "",
    place0,
    h("section", { class: "panel" }, h("details", {}, h("summary", {}, h("h2", {}, "How it was made")), facts({ key: about.key, digest: about.digest, path: about.path, ...about.made, settings: about.params, inputs: about.inputs, summary: about.summary, files: Object.fromEntries(Object.entries(about.files).map(([file, size]) => [file, bytes(size)])) }))));
  try {
    const panels = await ask("panels", { artifact: name });
    if (mine === turn) put(place0, ...drawPanels(panels, page));
  } catch (error) { put(place0, failure(error)); }
};

// -- a record, a reject, a file

const recordPage = async (mine, name, id, query) => {
  const about = await ask("record", { artifact: name, record: id });
  if (mine !== turn) return;
  const { place, folder } = nameParts(name);
  crumbs(home(), artifactLink(name, `${place}/${folder}`), h("span", {}, id));
  page = pageOf(query, name, id);
  const body = h("div", {}, h("p", { class: "soft" }, "loading .."));
  const step = (to, text, key) => h("a", { class: "step", rel: text, href: to ? `#/record/${name}/${to}` : undefined, "aria-disabled": String(!to), title: `key ${key}` }, text === "previous" ? "← previous" : "next →");
  put(main, 
    h("div", { class: "head" }, h("h1", {}, id), h("span", { class: "soft" }, `${(about.number + 1).toLocaleString("en")} of ${about.total.toLocaleString("en")}${about.group ? `, ${about.group}` : ""}`), step(about.previous, "previous", "p"), step(about.next, "next", "n"),
      about.inputs.length ? h("span", {}, h("span", { class: "soft" }, "made from "), about.inputs.flatMap(({ artifact, stage }, i) => [i ? ", " : "", h("a", { href: `#/record/${artifact}/${id}` }, stage)])) : ""),
    body,
    h("section", { class: "panel" }, h("details", {}, h("summary", {}, h("h2", {}, "Bytes")), h("dl", { class: "facts" }, Object.entries(about.members).flatMap(([member, size]) => [h("dt", {}, h("a", { href: page.source(member), download: `${id}.${member}` }, member)), h("dd", {}, bytes(size))]), h("dt", {}, "part"), h("dd", {}, h("code", {}, about.part)), h("dt", {}, "digest"), h("dd", {}, h("code", {}, about.digest))))));
  const panels = await ask("panels", { artifact: name, record: id }).catch((error) => error);
  if (mine !== turn) return;
  put(body, ...(panels instanceof Error ? [failure(panels)] : drawPanels(panels, page)));
};

const rejectPage = async (mine, name, item) => {
  const reject = await ask("reject", { artifact: name, item });
  if (mine !== turn) return;
  const { place, folder } = nameParts(name), source = reject.inputs[0];
  crumbs(home(), artifactLink(name, `${place}/${folder}`), h("span", {}, item));
  page = source ? pageOf(new URLSearchParams(), source.artifact, item) : fresh();
  const body = h("div", {});
  put(main, h("h1", {}, item), h("section", { class: "panel" }, h("p", {}, h("strong", { class: "bad" }, reject.reason), reject.meaning ? `: ${reject.meaning}` : ""), h("p", {}, reject.detail || "nothing more is known")),
    source ? h("p", {}, "What it would have been made from: ", recordLink(source.artifact, item), h("span", { class: "soft" }, ` (${source.stage})`)) : h("p", { class: "soft" }, "It has no record in an input that could be shown: it was rejected as it came."), body);
  if (!source) return;
  const panels = await ask("panels", { artifact: source.artifact, record: item }).catch((error) => error);
  if (mine === turn) put(body, ...(panels instanceof Error ? [failure(panels)] : drawPanels(panels, page)));
};

const filePage = async (mine, query) => {
  crumbs(home());
  page = pageOf(query);
  put(main, h("h1", {}, start.file ?? "file"), h("p", { class: "soft" }, "loading .."));
  const panels = await ask("panels");
  if (mine === turn) put(main, h("h1", {}, start.file), ...drawPanels(panels, page));
};

// -- runs side by side

const runsPage = async (mine, query) => {
  const runs = await ask("runs");
  if (mine !== turn) return;
  crumbs(home(), h("span", {}, "trainings"));
  page = fresh();
  const chosen = new Set(query.get("of")?.split(",").filter(Boolean) ?? runs.slice(-4).map(({ artifact }) => artifact)), body = h("div", {});
  const draw = async () => {
    const wanted = runs.filter(({ artifact }) => chosen.has(artifact));
    const answers = await Promise.all(wanted.map((run) => ask("curves", run))).catch((error) => error);
    if (mine !== turn) return;
    put(body, answers instanceof Error ? failure(answers) : wanted.length ? plots(Object.fromEntries(answers.map(({ artifact, series }) => [artifact, series]))) : h("p", { class: "soft" }, "Choose a training."));
  };
  put(main, h("h1", {}, "Trainings"), runs.length ? h("fieldset", { class: "checks" }, h("legend", {}, "Curves of"), runs.map(({ artifact }) => h("label", { class: "check" }, h("input", { type: "checkbox", checked: chosen.has(artifact), onchange: (event) => { event.target.checked ? chosen.add(artifact) : chosen.delete(artifact); draw(); } }), artifactLink(artifact)))) : h("p", { class: "soft" }, "No training is in the store."), body);
  await draw();
};

// -- the address

const show = async () => {
  const mine = ++turn;
  page?.freed.forEach((free) => free());
  page = null;
  const [path, query] = location.hash.replace(/^#/, "").split("?"), words = path.split("/").filter(Boolean).map(decodeURIComponent), values = new URLSearchParams(query);
  const [kind, ...rest] = words;
  document.title = rest.length ? `${rest.at(-1)} · lightmill` : "lightmill";
  try {
    start ??= await ask("start");
    if (!kind && !start.store && start.start) { location.replace(start.start); return; }
    if (kind === "artifact") await artifactPage(mine, rest.join("/"), values);
    else if (kind === "record") await recordPage(mine, rest.slice(0, -1).join("/"), rest.at(-1), values);
    else if (kind === "reject") await rejectPage(mine, rest.slice(0, -1).join("/"), rest.at(-1));
    else if (kind === "runs") await runsPage(mine, values);
    else if (kind === "file") await filePage(mine, values);
    else await storePage(mine);
  } catch (error) {
    if (mine === turn) { crumbs(start ? home() : ""); put(main, h("h1", {}, "This cannot be shown"), failure(error), h("p", {}, h("button", { type: "button", onclick: show }, "Try again"))); }
  }
};

addEventListener("hashchange", () => { shown = show(); });
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(document.activeElement?.tagName ?? "")) return;
  if (event.key === "n" || event.key === "p") document.querySelector(`a.step[rel=${event.key === "n" ? "next" : "previous"}][href]`)?.click();
});

// Light or dark: as the system has it, or as a person chose.
const theme = document.querySelector("#theme"), root = document.documentElement;
const paint = (value) => { if (value) root.dataset.theme = value; else delete root.dataset.theme; theme.textContent = value ?? "auto"; theme.setAttribute("aria-label", `Colours: ${value ?? "as the system has them"}`); };
let chosen = null;
try { chosen = localStorage.getItem("theme"); } catch { /* no storage in this frame */ }
paint(chosen);
theme.addEventListener("click", () => {
  chosen = { null: "dark", dark: "light", light: null }[chosen];
  paint(chosen);
  try { if (chosen) localStorage.setItem("theme", chosen); else localStorage.removeItem("theme"); } catch { /* no storage in this frame */ }
});

// For tests and the curious: the page's spaces, and whether all of it has been loaded and drawn.
const settled = async () => {
  await shown;
  await Promise.all([...(page?.pending ?? []), ...(page?.spaces ?? []).map((space) => space.ready)]);
  return (page?.spaces ?? []).every((space) => space.model?.settled() ?? true);
};
const go = async (hash) => {
  if (location.hash !== hash) {
    const changed = new Promise((done) => addEventListener("hashchange", done, { once: true }));
    location.hash = hash;
    await changed;
  }
  return settled();
};
globalThis.lightmill = { get spaces() { return page?.spaces ?? []; }, settled, go };
let shown = show();
