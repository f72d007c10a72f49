// The module of a collector: values, alarms, devices, links, sinks, commands, log and configuration.

import { AlarmView } from "./alarms.js";
import { showLog } from "./collector_log.js";
import { WriteDialog, showCommands } from "./commands.js";
import { ConfigurationView } from "./configuration.js";
import { DeviceView, showLinks, showSinks } from "./devices.js";
import { byId, setText } from "./dom.js";
import { History } from "./history.js";
import { ask } from "./link.js";
import { ValueTable } from "./values.js";

export function start({ stream, begin, refresh }) {
  let revision = null; // of the points that are shown; null while others are being loaded
  const past = new History((point) => table.focus(point, "c-name"));
  const writing = new WriteDialog(
    () => refresh("commands"),
    (point) => table.focus(point, "c-do"),
  );
  const table = new ValueTable(stream, {
    history: (point) => past.show(point),
    write: (point) => writing.open(point),
  });
  const alarms = new AlarmView();
  const devices = new DeviceView();
  const configuration = new ConfigurationView();
  for (const id of ["log-level", "log-search"]) byId(id).addEventListener("input", () => refresh("log"));
  return {
    hint: "The file page-tokens in the folder of the store has one for each role: view, operate, configure.",
    views: {
      values: { setVisible: () => table.redraw() },
      alarms: { refresh: () => alarms.show() },
      devices: { refresh: () => devices.show() },
      links: { refresh: showLinks },
      sinks: { refresh: showSinks },
      commands: { refresh: () => showCommands(table.points) },
      log: { refresh: showLog },
      configuration: { refresh: () => configuration.show() },
    },
    async load(isWanted) {
      const found = await ask("GET", "/api/points");
      if (!isWanted()) return;
      ({ revision } = found);
      table.use(found.points);
    },
    async about() {
      const found = await ask("GET", "/api/collector");
      setText(byId("name"), found.name);
      document.title = `${found.name} – busway collector`;
      setText(byId("summary"), `${found.store}: ${found.samples} samples${found.lost ? `, ${found.lost} lost` : ""}${found.error ? `: ${found.error}` : ""}`);
      setText(byId("notes"), fileText(found));
    },
    take(message) {
      if (message.now !== undefined && revision !== null) {
        if (message.revision === revision) table.take(message);
        else {
          revision = null; // the file was read again, or the program has begun anew: the points may be others
          begin();
        }
      }
      if (message.alarms) alarms.count(message.alarms);
      if (message.command) refresh("commands");
    },
  };
}

/** How the file differs from what is in use. */
function fileText({ restart_needed: keys, refused }) {
  const lines = [];
  if (refused.length) lines.push(`The file was read again and refused, and nothing was changed: ${refused.join("; ")}.`);
  if (keys.length) lines.push(`A restart is needed: changes of ${keys.join(", ")} hold after the next start.`);
  return lines.join("\n");
}
