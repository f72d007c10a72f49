// The table of values: thousands of points, of which only the rows that can be seen exist.
// It takes the messages of the stream and tells it which points are shown.

import { Course, Sparkline } from "./course.js";
import { byId, eachFrame, element, keyed, numberOf, setText, valueText } from "./dom.js";
import { may, onRole } from "./session.js";
import { onTheme } from "./theme.js";

const BEYOND = 4;
const MOST_SHOWN = 200;
const QUALITY_UNREAD = "none";

/** How long ago, in words; times in milliseconds. */
export function ago(now, then) {
  if (!then) return "–";
  const seconds = Math.max(now - then, 0) / 1000;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

export class ValueTable {
  constructor(stream, actions) {
    this.stream = stream;
    this.actions = actions;
    this.points = [];
    this.fits = [];
    this.reasons = { 0: ["good", ""] };
    this.clock = 0;
    this.shown = "";
    this.sparks = new WeakMap(); // by row
    this.redraw = eachFrame(() => this.draw());
    byId("search").addEventListener("input", () => this.filter());
    byId("quality").addEventListener("change", () => this.filter());
    byId("value-grid").addEventListener("scroll", this.redraw);
    new ResizeObserver(this.redraw).observe(byId("value-grid"));
    setInterval(() => document.hidden || this.redraw(), 1000);
    onRole(this.redraw);
    onTheme(this.redraw);
  }

  /** Show these points from now on, without values until they come. */
  use(points) {
    this.points = points.map((point, place) => ({
      ...point,
      place,
      key: `${point.device}/${point.point}`,
      labels: new Map(Object.entries(point.enumeration).map(([name, number]) => [number, name])),
      flags: Object.entries(point.flags),
      text: `${point.device}/${point.point}`.toLowerCase(),
      value: null,
      reason: 0,
      time: 0,
      raw: "",
      course: null,
    }));
    this.shown = "";
    byId("value-rows").replaceChildren(); // the rows have names and buttons of the points before
    this.filter();
  }

  take(message) {
    const { points } = this;
    this.clock = message.now - Date.now();
    Object.assign(this.reasons, message.reasons);
    for (const [first, values, reasons] of message.changed) {
      for (let at = 0; at < values.length; at += 1) {
        const point = points[first + at];
        point.value = values[at];
        point.reason = typeof reasons === "number" ? reasons : reasons[at];
      }
    }
    const { read } = message;
    for (let at = 0; at < read.length; at += 3) {
      for (let place = read[at]; place < read[at] + read[at + 1]; place += 1) {
        const point = points[place];
        point.time = read[at + 2];
        if (typeof point.value === "number" || typeof point.value === "boolean") (point.course ??= new Course()).push(numberOf(point.value));
      }
    }
    for (const [place, raw] of Object.entries(message.raw ?? {})) points[place].raw = raw;
    if (byId("quality").value) this.filter();
    else this.redraw();
  }

  quality(point) {
    return point.time || point.reason ? this.reasons[point.reason]?.[0] ?? "" : QUALITY_UNREAD;
  }

  filter() {
    const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const quality = byId("quality").value;
    this.fits = this.points.filter((point) => words.every((word) => point.text.includes(word)) && (!quality || this.quality(point) === quality));
    const { length } = this.points;
    setText(byId("count"), `${this.fits.length === length ? "" : `${this.fits.length} of `}${length} points`);
    this.redraw();
  }

  draw() {
    const grid = byId("value-grid");
    if (!grid.offsetParent) return;
    const height = parseFloat(getComputedStyle(document.documentElement).getPropertyValue("--row"));
    const head = grid.querySelector(".head").offsetHeight;
    const first = Math.max(Math.floor((grid.scrollTop - head) / height) - BEYOND, 0);
    const last = Math.min(first + Math.ceil(grid.clientHeight / height) + 2 * BEYOND, this.fits.length);
    const rows = this.fits.slice(first, last).map((point, at) => ({ point, at: first + at }));
    byId("value-rows").style.height = `${this.fits.length * height}px`;
    grid.setAttribute("aria-rowcount", this.fits.length + 1);
    const now = Date.now() + this.clock;
    keyed(
      byId("value-rows"),
      rows,
      ({ point }) => point.place,
      ({ point }) => this.row(point),
      (row, item) => this.update(row, item, height, now),
    );
    this.tell(rows.slice(0, MOST_SHOWN).map(({ point }) => point.place));
  }

  /** Tell the stream what is shown, once it is something else. */
  tell(places) {
    const wanted = places.join();
    if (wanted === this.shown || !this.points.length) return;
    this.shown = wanted;
    clearTimeout(this.telling);
    this.telling = setTimeout(() => this.stream.want({ shown: places }), 150);
  }

  /** Put the focus on a button of the point's row: its name, or what writes it. The row may have been made anew. */
  focus({ key }, button) {
    const place = this.points.findIndex((point) => point.key === key);
    byId("value-rows").querySelector(`[data-key="${place}"] .${button} button`)?.focus();
  }

  row(point) {
    const cell = (name, ...children) => element("span", { role: "cell", class: name }, ...children);
    const open = element("button", { type: "button", class: "quiet", onclick: () => this.actions.history(point) }, point.key);
    const write = element("button", { type: "button", class: "quiet", "aria-label": `Write ${point.key}`, onclick: () => this.actions.write(point) }, "Write");
    const spark = new Sparkline();
    const made = element(
      "div",
      { role: "row", class: "row" },
      cell("c-name", open),
      cell("c-value"),
      cell("c-quality"),
      cell("c-raw"),
      cell("c-age"),
      cell("c-spark", spark.canvas),
      cell("c-do", write),
    );
    this.sparks.set(made, spark);
    return made;
  }

  update(row, { point, at }, height, now) {
    const [, value, quality, raw, age, , act] = row.children;
    row.style.transform = `translateY(${at * height}px)`;
    row.setAttribute("aria-rowindex", at + 2);
    const measure = point.unit_of_measure && point.value !== null ? ` ${point.unit_of_measure}` : "";
    setText(value, valueText(point.value, point) + measure);
    const name = this.quality(point);
    const reason = this.reasons[point.reason]?.[1];
    setText(quality, name === QUALITY_UNREAD ? "not read yet" : name + (reason ? `: ${reason}` : ""));
    if (quality.dataset.quality !== name) quality.dataset.quality = name;
    if (quality.title !== quality.textContent) quality.title = quality.textContent;
    setText(raw, point.raw);
    setText(age, ago(now, point.time));
    this.sparks.get(row).draw(point.course);
    act.firstChild.hidden = !(point.writable && may("operate"));
  }
}
