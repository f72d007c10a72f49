// The server: its listeners with their status indicators, its connections, what it counts; and the head of the page.

import { byId, bytesText, duration, element, fill, keyed, setText } from "./dom.js";
import { ask } from "./link.js";

const INDICATORS = [
  ["communication", "Communication"],
  ["error", "Error"],
  ["device_status", "Device status"],
];

export class StatusView {
  constructor() {
    this.isVisible = false;
    byId("reset").addEventListener("click", () => ask("POST", "/api/counters/reset").catch(() => {}));
    byId("pause").addEventListener("click", () => this.pause());
  }

  setVisible(isVisible) {
    this.isVisible = isVisible;
    if (isVisible && this.status) this.draw();
  }

  take(status) {
    this.status = status;
    const simulation = status.simulation;
    setText(byId("name"), simulation.name);
    if (document.title !== `${simulation.name} – busway simulator`) document.title = `${simulation.name} – busway simulator`;
    const speed = simulation.speed !== 1 ? `, ${simulation.speed} × speed` : "";
    const clock = ` · ${duration(Math.floor(simulation.time))}${speed}${simulation.paused ? ", paused" : ""}`;
    setText(byId("summary"), simulation.endpoints.join("  ") + clock);
    byId("pause").hidden = false;
    setText(byId("pause"), simulation.paused ? "Resume plant" : "Pause plant");
    if (this.isVisible) this.draw();
  }

  async pause() {
    const paused = !this.status.simulation.paused;
    this.status.simulation = await ask("PATCH", "/api/simulation", { paused });
    this.take(this.status);
  }

  draw() {
    const { lines, connections, counters } = this.status;
    keyed(byId("lines"), lines, (line) => line.endpoint, makeLine, updateLine);
    fill("connection-rows", connections, (one) => `${one.listener} ${one.peer}`, connectionCells, [2, 3, 4, 5]);
    byId("connections").hidden = connections.length === 0;
    byId("connections-empty").hidden = connections.length > 0;
    counts(byId("counters"), counters);
  }
}

function makeLine(line) {
  return element(
    "article",
    { class: "card" },
    element("h2", {}, line.endpoint),
    element(
      "ul",
      { class: "indicators" },
      ...INDICATORS.map(([key, name]) =>
        element(
          "li",
          { "data-indicator-of": key },
          element("span", { class: key === "error" ? "indicator fault" : "indicator", "aria-hidden": "true" }),
          element("span", {}, name, ": ", element("span", { class: "state" })),
        ),
      ),
    ),
    element("dl", { class: "counters" }),
  );
}

function updateLine(card, line) {
  for (const [key] of INDICATORS) {
    const item = card.querySelector(`[data-indicator-of="${key}"]`);
    const indicator = item.querySelector(".indicator");
    if (indicator.dataset.indicator !== line.indicators[key]) indicator.dataset.indicator = line.indicators[key];
    setText(item.querySelector(".state"), line.indicators[key]);
  }
  const { requests, foreign, damaged, abandoned, echoes, event_count, listen_only, is_open } = line;
  counts(card.querySelector("dl"), { open: is_open, listen_only, requests, foreign, damaged, abandoned, echoes, event_count, ...line.counters });
}

function connectionCells(one) {
  const who = one.role ? `${one.peer} (${one.role})` : one.peer;
  return [who, one.state, one.requests, bytesText(one.received), bytesText(one.sent), duration(Math.floor(one.age))];
}

/** Counters as a list; what they hold themselves stands behind their name. */
function counts(list, counters) {
  const flat = [];
  for (const [name, value] of Object.entries(counters)) {
    if (value !== null && typeof value === "object") {
      for (const [inner, number] of Object.entries(value)) flat.push([`${name} ${inner}`, number]);
    } else flat.push([name, value]);
  }
  keyed(
    list,
    flat,
    ([name]) => name,
    ([name]) => element("div", {}, element("dt", {}, name.replaceAll("_", " ")), element("dd")),
    (item, [, value]) => setText(item.lastElementChild, typeof value === "boolean" ? (value ? "yes" : "no") : String(value)),
  );
}
