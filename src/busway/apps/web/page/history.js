// The history of one point from the store: mean as a line, minimum and maximum as a band, gaps as gaps.

import uPlot from "/uplot/uPlot.esm.js";
import { axis } from "./charts.js";
import { byId, colour, setText } from "./dom.js";
import { ask } from "./link.js";
import { onTheme } from "./theme.js";

const AGAIN = 5000;
const HEIGHT = 260;

export class History {
  constructor(closed) {
    this.closed = closed;
    this.point = null;
    this.chart = null;
    byId("span").addEventListener("change", () => this.load());
    byId("history-close").addEventListener("click", () => this.close());
    new ResizeObserver(() => this.chart?.setSize({ width: byId("chart").clientWidth, height: HEIGHT })).observe(byId("chart"));
    onTheme(() => {
      this.remove();
      if (this.point) this.load();
    });
    setInterval(() => this.point && !document.hidden && this.load(), AGAIN);
  }

  show(point) {
    this.point = point;
    this.remove();
    setText(byId("history-name"), `${point.device}/${point.point}`);
    setText(byId("history-message"), "");
    byId("history").hidden = false;
    byId("history-name").focus();
    byId("history").scrollIntoView({ block: "nearest" });
    return this.load();
  }

  remove() {
    this.chart?.destroy();
    this.chart = null;
  }

  close() {
    const { point } = this;
    this.point = null;
    byId("history").hidden = true;
    if (point) this.closed(point);
  }

  async load() {
    const point = this.point;
    const buckets = Math.min(Math.max(Math.round(byId("chart").clientWidth), 200), 1500);
    const wanted = new URLSearchParams({ device: point.device, point: point.point, seconds: byId("span").value, buckets });
    try {
      const found = await ask("GET", `/api/trend?${wanted}`);
      if (this.point === point) this.draw(found);
    } catch (error) {
      if (this.point === point) setText(byId("history-message"), error.message);
    }
  }

  draw(found) {
    const known = found.mean.filter((one) => one !== null).length;
    setText(byId("history-message"), known ? "" : "There are no numbers in this time.");
    byId("chart").dataset.values = known;
    byId("chart").dataset.gaps = found.mean.length - known;
    const columns = [found.time, found.maximum, found.minimum, found.mean];
    this.chart ??= this.made();
    this.chart.setData(columns, false);
    this.chart.setScale("x", { min: found.begin, max: found.end });
  }

  made() {
    const edge = { stroke: "transparent", points: { show: false }, spanGaps: false };
    const options = {
      width: byId("chart").clientWidth,
      height: HEIGHT,
      scales: { x: { time: true } },
      axes: [axis(), axis({ label: this.point.unit_of_measure || undefined })],
      series: [
        { label: "Time" },
        { ...edge, label: "Maximum" },
        { ...edge, label: "Minimum" },
        { label: "Mean", stroke: colour("--accent"), width: 2, spanGaps: false },
      ],
      bands: [{ series: [1, 2], fill: colour("--accent-soft") }],
    };
    return new uPlot(options, [[], [], [], []], byId("chart"));
  }
}
