// The page of the collector: views as tabs, the stream of values, and what the user's role permits.

import { AlarmView } from "./alarms.js";
import { showLog } from "./collector_log.js";
import { WriteDialog, showCommands } from "./commands.js";
import { ConfigurationView } from "./configuration.js";
import { DeviceView, showLinks, showSinks } from "./devices.js";
import { byId, setText } from "./dom.js";
import { showFleet } from "./fleet.js";
import { History } from "./history.js";
import { Refusal, Stream, ask, hasToken } from "./link.js";
import { askForToken, learnRole, may, offerTokens, onRole, takeRole } from "./session.js";
import { ValueTable } from "./values.js";

const VIEWS = ["values", "alarms", "devices", "links", "sinks", "fleet", "commands", "log", "configuration"];
const PERIOD = 1000;
const STATES = { waiting: "connecting", live: "live", down: "not connected" };

let view = "values";
let revision = null; // of the points that are shown; null while others are being loaded

function state(name, text = STATES[name]) {
  byId("live").dataset.state = name;
  setText(byId("live"), text);
}

const stream = new Stream(take, (name) => {
  state(name);
  if (name === "down") askAgain();
});
const past = new History((point) => table.focus(point, "c-name"));
const writing = new WriteDialog(
  () => view === "commands" && refresh(),
  (point) => table.focus(point, "c-do"),
);
const table = new ValueTable(stream, {
  history: (point) => past.show(point),
  write: (point) => writing.open(point),
});
const alarms = new AlarmView();
const devices = new DeviceView();
const configuration = new ConfigurationView();
const SHOW = {
  values: () => {},
  alarms: () => alarms.show(),
  devices: () => devices.show(),
  links: showLinks,
  sinks: showSinks,
  fleet: showFleet,
  commands: () => showCommands(table.points),
  log: showLog,
  configuration: () => configuration.show(),
};

function take(message) {
  if (message.now !== undefined && revision !== null) {
    if (message.revision === revision) table.take(message);
    else {
      revision = null; // the file was read again, or the program has begun anew: the points may be others
      begin();
    }
  }
  if (message.caller) takeRole(message.caller);
  if (message.alarms) alarms.count(message.alarms);
  if (message.command && view === "commands") refresh();
}

async function about() {
  const found = await ask("GET", "/api/collector");
  setText(byId("name"), found.name);
  setText(byId("store"), `${found.store}: ${found.samples} samples${found.lost ? `, ${found.lost} lost` : ""}${found.error ? `: ${found.error}` : ""}`);
  setText(byId("file"), fileText(found));
  byId("tab-fleet").hidden = !found.in_fleet;
}

/** How the file differs from what is in use. */
function fileText({ restart_needed: keys, refused }) {
  const lines = [];
  if (refused.length) lines.push(`The file was read again and refused, and nothing was changed: ${refused.join("; ")}.`);
  if (keys.length) lines.push(`A restart is needed: changes of ${keys.join(", ")} hold after the next start.`);
  return lines.join("\n");
}

/** Show what the view has now; what is wrong is said in its place. */
async function refresh() {
  if (document.hidden) return;
  try {
    await SHOW[view]();
    setText(byId("problem"), "");
  } catch (error) {
    setText(byId("problem"), error.message);
  }
}

async function keepUp() {
  if (!document.hidden) {
    await about().catch(() => {}); // the stream says when nothing answers
    await refresh();
  }
  setTimeout(keepUp, PERIOD);
}

/** The stream has ended or could not begin: perhaps the token is taken no longer, or permits something else now. */
async function askAgain() {
  const mine = begun;
  try {
    await learnRole();
  } catch (error) {
    if (mine !== begun || error.status !== 401) return; // begun anew, or nothing answers: the stream tries again
    stream.stop();
    state("down", error.message);
    askForToken(error.message);
  }
}

let begun = 0;

/** Points first, then the stream of their values. One that is asked for meanwhile, with another token, takes its place. */
async function begin() {
  begun += 1;
  const mine = begun;
  try {
    await learnRole();
    const found = await ask("GET", "/api/points");
    if (mine !== begun) return;
    ({ revision } = found);
    table.use(found.points);
    stream.reopen();
    await about();
  } catch (error) {
    if (mine !== begun) return;
    if (error instanceof Refusal && error.status === 401) askForToken(hasToken() ? error.message : "");
    else {
      state("down", error.message);
      setTimeout(begin, 3000);
    }
  }
}

// Views as tabs.

const visible = () => VIEWS.filter((name) => !byId(`tab-${name}`).hidden);

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
  setText(byId("problem"), "");
  table.redraw();
  refresh();
}

for (const name of VIEWS) {
  const tab = byId(`tab-${name}`);
  tab.addEventListener("click", () => show(name, true));
  tab.addEventListener("keydown", (event) => {
    const there = visible();
    const at = there.indexOf(name);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: there.length - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    show(there[(to + there.length) % there.length], true);
  });
}
for (const id of ["log-level", "log-search"]) byId(id).addEventListener("input", refresh);
onRole(() => {
  byId("tab-configuration").hidden = !may("configure");
  if (view === "configuration" && !may("configure")) show("values", false);
  else refresh();
});
offerTokens(begin);

const wanted = location.hash.slice(1);
if (VIEWS.includes(wanted) && wanted !== "configuration") show(wanted, false);
begin();
keepUp();
