// The course of chosen points, drawn by uPlot.
//
// 1. A row is kept for each moment at which one of the points changed; the others stand there as they were.
// 2. Each unit of measure has an axis: the first on the left, the others on the right.
// 3. It is drawn at most five times a second, and only while it can be seen.

import uPlot from "/uplot/uPlot.esm.js";
import { axis } from "./charts.js";
import { byId, clockSeconds, element, setText } from "./dom.js";
import { onTheme } from "./theme.js";

const MOST_POINTS = 8;
export const FULL = `At most ${MOST_POINTS} points fit into the chart.`;
const MOST_ROWS = 20000;
const PAUSE = 200;
const AXIS = 58; // pixels of an axis with its label; all axes together take at most half of the width
const TICKS = 40;
const LIGHT = ["#0f6e84", "#b3541e", "#5b4ab8", "#1c7a45", "#a8326e", "#7a6a00", "#3f6fd1", "#666d72"];
const DARK = ["#55bfd6", "#f2a065", "#a99bff", "#6ed29a", "#f08fc0", "#dccb55", "#86aefc", "#b7c0c6"];
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3], [5, 5], [12, 5], [3, 6], [6, 2]];

export class Trends {
  constructor(changedChoice) {
    this.changedChoice = changedChoice;
    this.points = [];
    this.times = [];
    this.columns = [];
    this.latest = new Map();
    this.isVisible = false;
    this.chart = null;
    byId("trend-add").addEventListener("submit", (event) => {
      event.preventDefault();
      this.add();
    });
    byId("trend-name").addEventListener("input", () => this.propose());
    byId("span").addEventListener("change", () => this.schedule());
    new ResizeObserver(() => this.fit()).observe(byId("chart"));
    onTheme(() => this.redraw());
  }

  use(table) {
    this.table = table;
    this.points = [];
    this.times = [];
    this.columns = [];
    this.propose();
    const kept = JSON.parse(sessionStorage.getItem("busway-trends") || "[]");
    for (const key of kept) {
      const point = table.byKey.get(key);
      if (point && !this.has(point)) this.toggle(point);
    }
    this.show();
  }

  has(point) {
    return this.points.includes(point);
  }

  toggle(point) {
    setText(byId("trend-message"), "");
    const at = this.points.indexOf(point);
    if (at >= 0) {
      this.points.splice(at, 1);
      this.columns.splice(at, 1);
    } else if (this.isFull) {
      setText(byId("trend-message"), FULL);
      return;
    } else {
      this.points.push(point);
      this.columns.push(new Array(this.times.length).fill(null));
      this.row(Date.now() / 1000);
    }
    if (!this.points.length) this.times = [];
    sessionStorage.setItem("busway-trends", JSON.stringify(this.points.map((one) => one.key)));
    this.rebuild();
    this.show();
    this.changedChoice();
  }

  add() {
    const point = this.table?.byKey.get(byId("trend-name").value.trim());
    if (!point) {
      setText(byId("trend-message"), this.table ? "There is no point of this name." : "The points are still being loaded.");
      return;
    }
    byId("trend-name").value = "";
    if (!this.has(point)) this.toggle(point);
  }

  propose() {
    const typed = byId("trend-name").value.toLowerCase();
    const found = [];
    for (const point of this.table?.points ?? []) {
      if (found.length >= 30) break;
      if (point.text.includes(typed)) found.push(element("option", { value: point.key }));
    }
    byId("trend-names").replaceChildren(...found);
  }

  changed(point, number, time) {
    if (this.points.includes(point)) this.row(time);
  }

  /** Whether one more point fits. */
  get isFull() {
    return this.points.length >= MOST_POINTS;
  }

  /** Keep how all chosen points stand at a moment. */
  row(time) {
    const last = this.times.length - 1;
    const isSame = last >= 0 && time <= this.times[last];
    if (!isSame) this.times.push(time);
    const at = this.times.length - 1;
    this.points.forEach((point, place) => {
      const value = typeof point.value === "boolean" ? Number(point.value) : point.value;
      this.columns[place][at] = typeof value === "number" ? value : null;
    });
    if (this.times.length > MOST_ROWS) {
      const gone = MOST_ROWS / 4;
      this.times.splice(0, gone);
      for (const column of this.columns) column.splice(0, gone);
    }
    this.schedule();
  }

  setVisible(isVisible) {
    this.isVisible = isVisible;
    if (isVisible) {
      if (!this.chart) this.rebuild();
      this.fit();
      this.schedule();
    }
  }

  // Drawing.

  schedule() {
    if (!this.isVisible || this.waiting) return;
    this.waiting = setTimeout(() => {
      this.waiting = 0;
      requestAnimationFrame(() => this.draw());
    }, PAUSE);
  }

  draw() {
    if (!this.chart || !this.isVisible) return;
    const to = Date.now() / 1000;
    const from = to - Number(byId("span").value);
    this.chart.batch(() => {
      this.chart.setData([this.times, ...this.columns], false);
      this.chart.setScale("x", { min: from, max: to });
    });
  }

  fit() {
    const { clientWidth, clientHeight } = byId("chart");
    if (!this.chart || !clientWidth) return;
    const legend = this.chart.root.querySelector(".u-legend")?.offsetHeight ?? 0;
    this.chart.setSize({ width: clientWidth, height: Math.max(clientHeight - legend, 160) });
  }

  rebuild() {
    this.chart?.destroy();
    this.chart = null;
    const place = byId("chart");
    if (!this.points.length || !place.clientWidth) return;
    const isDark = getComputedStyle(document.documentElement).colorScheme === "dark";
    const measures = [...new Set(this.points.map((point) => point.unit_of_measure))];
    const most = Math.max(Math.floor(place.clientWidth / 2 / AXIS), 2);
    const spare = Math.min(Math.max(place.clientWidth / 2 / measures.length - AXIS, 0), 12); // keeps figures off the label
    const options = {
      width: place.clientWidth,
      height: Math.max(place.clientHeight - 40, 160),
      scales: { x: { time: true } },
      axes: [
        axis({ values: (_, moments) => moments.map(clockSeconds), space: 80 }),
        ...measures.slice(0, most).map((measure, at) =>
          axis({
            scale: `y-${measure}`,
            label: measure || (measures.length > 1 ? "no unit" : undefined),
            labelSize: AXIS - TICKS,
            size: TICKS + spare,
            side: at ? 1 : 3,
            ...(at && { grid: { show: false } }),
          }),
        ),
      ],
      series: [
        { label: "Time", value: (_, moment) => (moment === null ? "–" : clockSeconds(moment)) },
        ...this.points.map((point, at) => ({
          label: point.key,
          scale: `y-${point.unit_of_measure}`,
          stroke: (isDark ? DARK : LIGHT)[at],
          dash: DASHES[at],
          width: 2,
          spanGaps: false,
          paths: uPlot.paths.stepped({ align: 1 }),
          points: { show: false },
          value: (_, value) => (value === null ? "–" : `${Number(value.toPrecision(7))} ${point.unit_of_measure}`),
        })),
      ],
    };
    this.chart = new uPlot(options, [this.times, ...this.columns], place);
    requestAnimationFrame(() => this.fit()); // its legend has a height only now
    this.schedule();
  }

  show() {
    const isDark = getComputedStyle(document.documentElement).colorScheme === "dark";
    const namespace = "http://www.w3.org/2000/svg";
    byId("chosen").replaceChildren(
      ...this.points.map((point, at) => {
        const mark = document.createElementNS(namespace, "svg");
        mark.setAttribute("viewBox", "0 0 14 14");
        mark.setAttribute("aria-hidden", "true");
        const dot = document.createElementNS(namespace, "circle");
        dot.setAttribute("cx", "7");
        dot.setAttribute("cy", "7");
        dot.setAttribute("r", "6");
        dot.setAttribute("fill", (isDark ? DARK : LIGHT)[at]);
        mark.append(dot);
        return element(
          "li",
          {},
          mark,
          point.key,
          element("button", { type: "button", class: "quiet", "aria-label": `Take ${point.key} out`, onclick: () => this.toggle(point) }, "✕"),
        );
      }),
    );
    byId("trend-empty").hidden = this.points.length > 0;
    byId("chart").hidden = this.points.length === 0;
    if (this.points.length && this.isVisible && !this.chart) this.rebuild();
  }

  redraw() {
    this.rebuild();
    this.show();
  }
}
