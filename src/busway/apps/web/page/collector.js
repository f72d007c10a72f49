// The page of the collector: views as tabs, asked for once a second while they can be seen.

import { byId, element, keyed, setText, valueText } from "./dom.js";
import { History } from "./history.js";
import { Refusal, ask, useToken } from "./link.js";

const VIEWS = ["values", "devices", "links", "sinks"];
const PERIOD = 1000;
const MOST_ROWS = 500;
const STATES = { waiting: "connecting", live: "live", down: "not connected" };

const history_ = new History();
let points = [];
let view = "values";

function state(name, text = STATES[name]) {
  byId("live").dataset.state = name;
  setText(byId("live"), text);
}

/** How long ago, in words; times in milliseconds. */
function ago(now, then) {
  if (then === null) return "–";
  const seconds = Math.max(now - then, 0) / 1000;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

const percent = (part) => `${(100 * part).toFixed(1)} %`;

/** Fill a table; `cells` gives the texts of an item. */
function fill(id, items, keyOf, cells, numbers) {
  const make = (item) =>
    element("tr", {}, ...cells(item).map((_, at) => element(at ? "td" : "th", { class: numbers.includes(at) ? "number" : false, scope: at ? false : "row" })));
  const update = (row, item) => cells(item).forEach((text, at) => setText(row.children[at], String(text)));
  keyed(byId(id), items, keyOf, make, update);
}

// Values.

const fits = (point, words, quality) =>
  words.every((word) => point.text.includes(word)) && (!quality || (point.quality || "none") === quality);

function makeRow(point) {
  point.button = element("button", { type: "button", class: "quiet", onclick: () => history_.show(point) }, `${point.device}/${point.point}`);
  const cell = element("th", { scope: "row" }, point.button);
  return element("tr", {}, cell, element("td", { class: "number" }), element("td"), element("td", { class: "number" }));
}

function updateRow(row, point) {
  const [, value, quality, age] = row.children;
  const measure = point.unit_of_measure && point.value !== null ? ` ${point.unit_of_measure}` : "";
  setText(value, valueText(point.value, null) + measure);
  setText(quality, (point.quality || "not read yet") + (point.reason ? `: ${point.reason}` : ""));
  quality.dataset.quality = point.quality || "none";
  setText(age, point.age);
}

function showValues() {
  const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const found = points.filter((point) => fits(point, words, byId("quality").value));
  const more = found.length > MOST_ROWS ? `, the first ${MOST_ROWS} are shown` : "";
  setText(byId("count"), `${found.length === points.length ? "" : `${found.length} of `}${points.length} points${more}`);
  keyed(byId("value-rows"), found.slice(0, MOST_ROWS), (point) => `${point.device}/${point.point}`, makeRow, updateRow);
}

async function loadPoints() {
  points = (await ask("GET", "/api/points")).points;
  for (const point of points) point.text = `${point.device}/${point.point}`.toLowerCase();
}

async function values() {
  const found = await ask("GET", "/api/values");
  if (found.value.length !== points.length) await loadPoints(); // the file was read again
  points.forEach((point, at) => {
    point.value = found.value[at] ?? null;
    point.quality = found.quality[at];
    point.reason = found.reason[at];
    point.age = ago(found.now, found.time[at] ?? null);
  });
  showValues();
}

// The other views.

async function devices() {
  const found = await ask("GET", "/api/devices");
  const told = (each) => (each.silent_since === null ? each.state : `${each.state} for ${ago(found.now, each.silent_since)}`);
  fill("device-rows", found.devices, (each) => each.name, (each) => [each.name, each.link, told(each), each.reads, each.failures, each.skipped, each.last_error, each.learnt.join("; ")], [3, 4, 5]);
}

async function links() {
  const found = await ask("GET", "/api/links");
  fill("link-rows", found.links, (each) => each.name, (each) => [each.name, percent(each.planned), percent(each.busy), percent(each.probing), each.problems.join("; ")], [1, 2, 3]);
  fill("read-rows", found.reads, (each) => `${each.device} ${each.poll_class} ${each.first}`, (each) => [each.device, each.link, each.poll_class, each.first, each.count, each.points, `${(1000 * each.seconds).toFixed(1)} ms`], [4, 5, 6]);
  setText(byId("more-reads"), found.more_reads ? `${found.more_reads} more are not shown.` : "");
}

async function sinks() {
  const found = await ask("GET", "/api/sinks");
  fill("sink-rows", found.sinks, (each) => each.name, (each) => [each.name, each.behind, each.sent, each.lost, each.set_aside, each.error ?? ""], [1, 2, 3, 4]);
  byId("no-sinks").hidden = found.sinks.length > 0;
  setText(byId("prometheus"), found.prometheus.length ? `Last values for Prometheus: ${found.prometheus.join(", ")}` : "");
}

const LOADS = { values, devices, links, sinks };

async function refresh() {
  if (document.hidden) return;
  const about = await ask("GET", "/api/collector");
  setText(byId("name"), about.name);
  setText(byId("store"), `${about.store}: ${about.samples} samples${about.lost ? `, ${about.lost} lost` : ""}${about.error ? `: ${about.error}` : ""}`);
  await LOADS[view]();
  state("live");
}

async function keepUp() {
  try {
    await refresh();
  } catch (error) {
    if (error instanceof Refusal && error.status === 401) {
      if (!byId("token").open) byId("token").showModal();
      return;
    }
    state("down", error.message);
  }
  setTimeout(keepUp, PERIOD);
}

// Views as tabs.

function show(wanted, focus) {
  view = wanted;
  for (const one of VIEWS) {
    const tab = byId(`tab-${one}`);
    tab.setAttribute("aria-selected", one === view);
    tab.tabIndex = one === view ? 0 : -1;
    byId(one).hidden = one !== view;
    if (one === view && focus) tab.focus();
  }
  if (location.hash !== `#${view}`) history.replaceState(null, "", `#${view}`);
  refresh().catch(() => {}); // keepUp says what is wrong
}

for (const [at, name] of VIEWS.entries()) {
  const tab = byId(`tab-${name}`);
  tab.addEventListener("click", () => show(name, true));
  tab.addEventListener("keydown", (event) => {
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: VIEWS.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    show(VIEWS[(to + VIEWS.length) % VIEWS.length], true);
  });
}
byId("search").addEventListener("input", showValues);
byId("quality").addEventListener("change", showValues);
byId("token-form").addEventListener("submit", () => {
  useToken(byId("token-input").value);
  keepUp();
});

const wanted = location.hash.slice(1);
if (VIEWS.includes(wanted)) show(wanted, false);
keepUp();
