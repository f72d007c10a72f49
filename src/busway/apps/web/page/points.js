// The table of points: only the rows that can be seen are there, and only what has changed is written.
//
// 1. Messages go into arrays; the next animation frame looks at the rows that are visible, and at no others.
// 2. The table is one stop of the Tab key; within it the arrows choose a row, Enter opens it, T puts it among the trends.
// 3. A value is set in two steps: what is about to happen is said before it happens.

import { Course, Sparkline } from "./course.js";
import { byId, colour, eachFrame, element, numberOf, setText, valueText } from "./dom.js";
import { ask, pointPath } from "./link.js";
import { onTheme } from "./theme.js";
import { FULL } from "./trends.js";
import { isInexact, typedNumber } from "./typed.js";

const SPARE = 4; // rows above and below what can be seen
const PAGE = 2000; // points of one request
const MOST = 5000; // that are followed all at once; of more, only those that can be seen

export class PointTable {
  constructor(stream, trends) {
    this.stream = stream;
    this.trends = trends;
    this.points = [];
    this.byKey = new Map();
    this.shown = []; // numbers of the points that fit the filter
    this.pool = new Map(); // row elements by place in `shown`
    this.active = 0;
    this.changed = new Set();
    this.grid = byId("grid");
    this.rows = byId("rows");
    this.draw = eachFrame(() => this.render());
    this.dialog = new PointDialog(this);
    this.grid.addEventListener("scroll", () => this.place(), { passive: true });
    this.grid.addEventListener("keydown", (event) => this.key(event));
    this.grid.addEventListener("focus", () => this.mark());
    this.rows.addEventListener("click", (event) => this.click(event));
    new ResizeObserver(() => this.resize()).observe(this.grid);
    onTheme(() => this.redraw());
    for (const id of ["search", "unit", "writable"]) byId(id).addEventListener("input", () => this.filter());
  }

  async load() {
    this.points = [];
    const units = (await ask("GET", "/api/units")).units.filter((one) => one.points);
    const names = new Map(units.map((one) => [one.unit, one.name]));
    for (;;) {
      const part = await ask("GET", `/api/points?limit=${PAGE}&skip=${this.points.length}`);
      this.points.push(...part.points.map((point) => known(point, names.get(point.unit) ?? "")));
      if (this.points.length >= part.total || part.points.length === 0) break;
    }
    this.byKey = new Map(this.points.map((point) => [point.key, point]));
    this.followsAll = this.points.length <= MOST;
    byId("unit").replaceChildren(
      element("option", { value: "" }, "All units"),
      ...units.map(({ unit, name }) => element("option", { value: unit }, name ? `Unit ${unit}, ${name}` : `Unit ${unit}`)),
    );
    byId("unit-choice").hidden = units.length < 2;
    this.filter();
    if (this.followsAll) this.stream.want({ points: "all" });
  }

  /** Take what has changed. */
  take(changes, time) {
    for (const [index, value, raw, at, writer, held] of changes) {
      const point = this.points[index];
      if (!point) continue;
      point.value = value;
      point.raw = raw;
      point.changed_at = at;
      point.last_writer = writer;
      point.held = held;
      const number = numberOf(value);
      point.course.push(number);
      this.changed.add(index);
      this.trends.changed(point, number, time);
    }
    this.draw();
    this.dialog.refresh();
  }

  // Which points, and where.

  filter() {
    const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const unit = byId("unit").value;
    const writable = byId("writable").checked;
    this.shown = [];
    for (const point of this.points) {
      if (unit && String(point.unit) !== unit) continue;
      if (writable && point.access !== "read-write") continue;
      if (words.every((word) => point.text.includes(word))) this.shown.push(point.index);
    }
    this.active = 0;
    const total = this.points.length;
    setText(byId("count"), this.shown.length === total ? `${total} points` : `${this.shown.length} of ${total} points`);
    this.grid.setAttribute("aria-rowcount", this.shown.length + 1);
    for (const row of this.pool.values()) row.element.remove();
    this.pool.clear();
    this.grid.scrollTop = 0;
    this.resize();
  }

  resize() {
    this.rowHeight = parseFloat(colour("--row"));
    this.headHeight = this.grid.querySelector(".head").offsetHeight;
    this.height = this.grid.clientHeight;
    this.rows.style.height = `${this.shown.length * this.rowHeight}px`;
    this.place();
  }

  /** Make sure that the rows that can be seen are there, and no others. */
  place() {
    if (!this.height) return;
    const first = Math.max(Math.floor(this.grid.scrollTop / this.rowHeight) - SPARE, 0);
    const last = Math.min(Math.ceil((this.grid.scrollTop + this.height) / this.rowHeight) + SPARE, this.shown.length);
    const free = [];
    for (const [at, row] of this.pool) {
      if (at < first || at >= last) {
        this.pool.delete(at);
        free.push(row);
      }
    }
    for (let at = first; at < last; at++) {
      if (this.pool.has(at)) continue;
      const row = free.pop() ?? new Row(this.rows);
      row.show(this.points[this.shown[at]], at, this.rowHeight);
      this.pool.set(at, row);
    }
    for (const row of free) row.element.remove();
    if (this.rowHeight !== this.placedHeight) {
      this.placedHeight = this.rowHeight;
      for (const [at, row] of this.pool) row.move(at, this.rowHeight);
    }
    this.mark();
    this.draw();
    if (!this.followsAll) this.followVisible();
  }

  followVisible() {
    clearTimeout(this.following);
    this.following = setTimeout(() => {
      const wanted = new Set([...this.pool.values()].map((row) => row.point.index));
      for (const point of this.trends.points) wanted.add(point.index);
      this.stream.want({ points: [...wanted] });
    }, 150);
  }

  render() {
    const trends = this.trends;
    for (const row of this.pool.values()) {
      if (row.isFresh || this.changed.has(row.point.index)) row.draw(trends.has(row.point));
    }
    this.changed.clear();
  }

  /** Draw everything anew: the colours have changed, or what stands among the trends. */
  redraw() {
    for (const row of this.pool.values()) row.isFresh = true;
    this.draw();
  }

  // Keys and clicks.

  mark() {
    for (const [at, row] of this.pool) row.element.setAttribute("aria-selected", at === this.active);
    const row = this.pool.get(this.active);
    if (row) this.grid.setAttribute("aria-activedescendant", row.element.id);
    else this.grid.removeAttribute("aria-activedescendant");
  }

  key(event) {
    if (event.target !== this.grid || event.ctrlKey || event.metaKey || event.altKey) return;
    const page = Math.max(Math.floor(this.height / this.rowHeight) - 1, 1);
    const last = this.shown.length - 1;
    const to = {
      ArrowDown: this.active + 1,
      ArrowUp: this.active - 1,
      PageDown: this.active + page,
      PageUp: this.active - page,
      Home: 0,
      End: last,
    }[event.key];
    if (to !== undefined) {
      this.choose(Math.min(Math.max(to, 0), last));
    } else if (event.key === "Enter" || event.key === " ") {
      this.open(this.active);
    } else if (event.key === "t" || event.key === "T") {
      const point = this.points[this.shown[this.active]];
      if (point) this.trends.toggle(point);
    } else return;
    event.preventDefault();
  }

  choose(at) {
    if (at < 0) return;
    this.active = at;
    const top = at * this.rowHeight;
    const space = this.height - this.headHeight - this.rowHeight;
    if (top < this.grid.scrollTop) this.grid.scrollTop = top;
    else if (top > this.grid.scrollTop + space) this.grid.scrollTop = top - space;
    this.place();
  }

  click(event) {
    const found = event.target.closest(".row");
    if (!found) return;
    this.active = Number(found.dataset.at);
    this.mark();
    const point = this.points[this.shown[this.active]];
    const act = event.target.closest("button")?.dataset.act;
    if (act === "trend") this.trends.toggle(point);
    else this.open(this.active);
  }

  open(at) {
    const point = this.points[this.shown[at]];
    if (point) this.dialog.open(point);
  }
}

/** A point as it came, with what the page keeps of it. */
function known(point, unitName) {
  return {
    ...point,
    unitName,
    labels: new Map(Object.entries(point.enumeration).map(([name, number]) => [number, name])),
    text: `${point.key} ${unitName} ${point.address} ${point.description} ${point.unit_of_measure} ${point.table}`.toLowerCase(),
    course: new Course(),
  };
}

/** One row of the table; shows one point after the other. */
class Row {
  static made = 0;

  constructor(parent) {
    this.name = element("span", { class: "c-name", role: "rowheader" });
    this.label = document.createTextNode("");
    this.where = element("small");
    this.name.append(this.label, this.where);
    this.value = element("span", { class: "c-value", role: "gridcell" });
    this.number = document.createTextNode("");
    this.measure = element("small");
    this.value.append(this.number, this.measure);
    this.raw = element("span", { class: "c-raw", role: "gridcell" });
    this.writer = element("span", { class: "c-writer", role: "gridcell" });
    this.spark = new Sparkline();
    this.trend = element("button", { type: "button", class: "quiet", tabindex: "-1", "data-act": "trend" }, "Trend");
    this.set = element("button", { type: "button", class: "quiet", tabindex: "-1", "data-act": "set", "data-needs": "operate" }, "Set");
    this.element = element(
      "div",
      { class: "row", role: "row", id: `row-${(Row.made += 1)}` },
      this.name,
      this.value,
      this.raw,
      this.writer,
      element("span", { class: "c-spark", role: "gridcell" }, this.spark.canvas),
      element("span", { class: "c-do", role: "gridcell" }, this.trend, this.set),
    );
    parent.append(this.element);
  }

  show(point, at, height) {
    this.point = point;
    this.isFresh = true;
    this.move(at, height);
    this.label.data = point.key;
    this.where.textContent = point.unitName ? `${point.address}, ${point.unitName}` : point.address;
    this.measure.textContent = point.unit_of_measure ? ` ${point.unit_of_measure}` : "";
    this.element.title = point.description;
    this.set.setAttribute("aria-label", `Set ${point.key}`);
    this.trend.setAttribute("aria-label", `Trend of ${point.key}`);
  }

  move(at, height) {
    this.element.dataset.at = at;
    this.element.setAttribute("aria-rowindex", at + 2);
    this.element.style.transform = `translateY(${at * height}px)`;
  }

  draw(isTrend) {
    const point = this.point;
    this.isFresh = false;
    const text = valueText(point.value, point);
    if (this.number.data !== text) this.number.data = text;
    setText(this.raw, point.raw);
    setText(this.writer, point.last_writer);
    this.element.classList.toggle("held", point.held);
    this.trend.setAttribute("aria-pressed", isTrend);
    this.spark.draw(point.course);
  }
}

/** Shows one point with all that is known of it, and sets it. */
class PointDialog {
  constructor(table) {
    this.table = table;
    this.point = null;
    this.asked = undefined; // the value that waits for its confirmation
    this.box = byId("point");
    byId("point-close").addEventListener("click", () => this.box.close());
    byId("point-back").addEventListener("click", () => this.step(undefined));
    byId("point-release").addEventListener("click", () => this.release());
    byId("point-trend").addEventListener("click", () => this.toggleTrend());
    byId("point-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.submit();
    });
    this.box.addEventListener("close", () => {
      this.point = null;
      this.table.grid.focus({ preventScroll: true });
    });
  }

  open(point) {
    this.point = point;
    setText(byId("point-name"), point.key);
    setText(byId("point-description"), point.description);
    const facts = [
      ["Unit", point.unitName ? `${point.unit}, ${point.unitName}` : String(point.unit)],
      ["Address", `${point.address}, ${point.table.replace("_", " ")}`],
      ["Type", [point.type, point.order && point.type !== "bit" ? point.order : "", point.scale !== 1 ? `× ${point.scale}` : ""].filter(Boolean).join(" ")],
      ["Modbus may", point.access === "read-write" ? "read and write" : "read"],
      ["Behaviour", point.behaviour],
      ["Range", rangeText(point)],
    ];
    this.writer = element("dd");
    byId("point-facts").replaceChildren(
      ...facts.filter(([, text]) => text).flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]),
      element("dt", {}, "Last writer"),
      this.writer,
    );
    this.input = inputFor(point);
    byId("point-field").replaceChildren(this.input);
    setText(byId("point-hint"), hintFor(point));
    setText(byId("point-error"), "");
    this.step(undefined);
    this.refresh();
    this.box.showModal();
    this.input.focus();
    this.input.select?.();
  }

  refresh() {
    const point = this.point;
    if (!point) return;
    setText(byId("point-value"), withMeasure(valueText(point.value, point), point));
    setText(byId("point-raw"), point.raw);
    setText(this.writer, point.last_writer + (point.held ? ", held" : ""));
    byId("point-trend").setAttribute("aria-pressed", this.table.trends.has(point));
    byId("point-trend").hidden = this.asked !== undefined;
    byId("point-release").hidden = !(point.held && point.behaviour) || this.asked !== undefined;
  }

  toggleTrend() {
    const trends = this.table.trends;
    const fits = trends.has(this.point) || !trends.isFull;
    setText(byId("point-error"), fits ? "" : FULL);
    if (fits) trends.toggle(this.point);
    this.refresh();
  }

  /** Ask for a value (undefined), or for its confirmation. */
  step(value) {
    this.asked = value;
    const asks = value !== undefined;
    byId("point-edit").hidden = asks;
    byId("point-question").hidden = !asks;
    byId("point-back").hidden = !asks;
    setText(byId("point-set"), asks ? "Yes, set it" : "Set");
    if (asks) {
      const point = this.point;
      const words = withMeasure(typeof value === "string" ? value : valueText(value, point), point);
      setText(byId("point-question"), `Set ${point.key} from ${withMeasure(valueText(point.value, point), point)} to ${words}?`);
    }
    if (this.box.open) (asks ? byId("point-set") : this.input).focus();
    this.refresh();
  }

  async submit() {
    setText(byId("point-error"), "");
    if (this.asked === undefined) {
      try {
        this.step(valueFrom(this.input, this.point));
      } catch (error) {
        this.complain(error);
      }
      return;
    }
    try {
      const point = this.point;
      this.take(await ask("PUT", pointPath(point), { value: this.asked }));
      this.box.close();
    } catch (error) {
      this.step(undefined);
      this.complain(error);
    }
  }

  async release() {
    try {
      this.take(await ask("POST", pointPath(this.point, "release")));
      this.refresh();
    } catch (error) {
      this.complain(error);
    }
  }

  take(answer) {
    this.table.take(
      [[answer.index, answer.value, answer.raw, answer.changed_at, answer.last_writer, answer.held]],
      Date.now() / 1000,
    );
  }

  complain(error) {
    setText(byId("point-error"), error.message);
    this.input.focus();
  }
}

const withMeasure = (text, point) => (point.unit_of_measure ? `${text} ${point.unit_of_measure}` : text);

function rangeText(point) {
  if (point.minimum === null && point.maximum === null) return "";
  if (point.minimum === null) return `at most ${point.maximum}`;
  return point.maximum === null ? `at least ${point.minimum}` : `${point.minimum} … ${point.maximum}`;
}

function inputFor(point) {
  const names = Object.keys(point.enumeration);
  if (point.type === "bit") {
    return element(
      "select",
      { id: "point-input" },
      element("option", { value: "true", selected: point.value === true }, "on"),
      element("option", { value: "false", selected: point.value !== true }, "off"),
    );
  }
  if (names.length) {
    return element(
      "select",
      { id: "point-input" },
      ...names.map((name) =>
        element("option", { value: name, selected: point.enumeration[name] === point.value }, `${name} (${point.enumeration[name]})`),
      ),
    );
  }
  const made = element("input", { id: "point-input", autocomplete: "off", spellcheck: "false" });
  if (typeof point.value === "number") made.inputMode = "decimal";
  made.value = Array.isArray(point.value) ? point.value.join(", ") : (point.value ?? "");
  return made;
}

function hintFor(point) {
  const range = rangeText(point);
  const what = point.unit_of_measure ? `In ${point.unit_of_measure}` : "";
  return [what, range && `${what ? "from " : ""}${range}`].filter(Boolean).join(", ");
}

/** What was typed, as the point needs it; throws what is wrong with it. */
function valueFrom(input, point) {
  const text = input.value.trim();
  if (point.type === "bit") return text === "true";
  if (Object.keys(point.enumeration).length) return text;
  if (/^(u?int|float|bcd)/.test(point.type)) {
    if (["NaN", "Infinity", "-Infinity"].includes(text) && point.type.startsWith("float")) return text;
    if (text === "") throw new Error("Type a value.");
    const number = typedNumber(text);
    if (point.minimum !== null && number < point.minimum) throw new Error(`It must be at least ${point.minimum}.`);
    if (point.maximum !== null && number > point.maximum) throw new Error(`It must be at most ${point.maximum}.`);
    return isInexact(text) ? text : number;
  }
  if (Array.isArray(point.value)) return text.split(",").map((one) => (one.trim() === "on" ? true : one.trim() === "off" ? false : Number(one)));
  return text;
}
