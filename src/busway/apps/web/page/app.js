// Puts the page together: views as tabs, colours, the stream and what is done with its messages.

import { byId, setText } from "./dom.js";
import { FaultView } from "./faults.js";
import { Refusal, Stream, ask, useToken } from "./link.js";
import { PointTable } from "./points.js";
import { StatusView } from "./status.js";
import { TrafficView } from "./traffic.js";
import { Trends } from "./trends.js";

const VIEWS = ["points", "trends", "traffic", "faults", "server"];
const THEMES = ["auto", "light", "dark"];
const STATES = { waiting: "connecting", live: "live", down: "not connected" };

const stream = new Stream(take, (state) => {
  byId("live").dataset.state = state;
  setText(byId("live"), STATES[state]);
});
const trends = new Trends(() => {
  table.redraw();
  if (!table.followsAll) table.followVisible();
});
const table = new PointTable(stream, trends);
const traffic = new TrafficView(stream);
const faults = new FaultView();
const status = new StatusView();

function take(message) {
  if (message.points) table.take(message.points, message.time);
  if (message.traffic) traffic.take(message.traffic, message.skipped);
  if (message.faults) faults.take(message.faults);
  if (message.status) status.take(message.status);
}

// Views.

function show(view, focus) {
  for (const one of VIEWS) {
    const tab = byId(`tab-${one}`);
    const isShown = one === view;
    tab.setAttribute("aria-selected", isShown);
    tab.tabIndex = isShown ? 0 : -1;
    byId(one).hidden = !isShown;
    if (isShown && focus) tab.focus();
  }
  trends.setVisible(view === "trends");
  traffic.setVisible(view === "traffic");
  status.setVisible(view === "server");
  if (location.hash !== `#${view}`) history.replaceState(null, "", `#${view}`);
}

for (const [at, view] of VIEWS.entries()) {
  const tab = byId(`tab-${view}`);
  tab.addEventListener("click", () => show(view, true));
  tab.addEventListener("keydown", (event) => {
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: VIEWS.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    show(VIEWS[(to + VIEWS.length) % VIEWS.length], true);
  });
}
addEventListener("hashchange", () => {
  const wanted = location.hash.slice(1);
  if (VIEWS.includes(wanted)) show(wanted, false);
});

// Colours.

function colours(theme) {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  setText(byId("theme"), `Theme: ${theme}`);
  table.redraw();
  trends.redraw();
}

let theme = localStorage.getItem("busway-theme");
if (!THEMES.includes(theme)) theme = "auto";
byId("theme").addEventListener("click", () => {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  localStorage.setItem("busway-theme", theme);
  colours(theme);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colours(theme));

// The beginning.

byId("token-form").addEventListener("submit", () => {
  useToken(byId("token-input").value);
  begin();
});

async function begin() {
  try {
    await ask("GET", "/api/simulation");
    await table.load();
    trends.use(table);
    await faults.load();
    stream.open();
  } catch (error) {
    if (error instanceof Refusal && error.status === 401) {
      byId("token").showModal();
    } else {
      setText(byId("live"), error.message);
      byId("live").dataset.state = "down";
      setTimeout(begin, 3000);
    }
  }
}

colours(theme);
const wanted = location.hash.slice(1);
show(VIEWS.includes(wanted) ? wanted : "points", false);
begin();
