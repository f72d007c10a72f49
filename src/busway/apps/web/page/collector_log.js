// The log: what the collector said last, by level and words.

import { byId, clockTime, element, keyed, setText } from "./dom.js";
import { ask } from "./link.js";

export async function showLog() {
  const wanted = new URLSearchParams({ limit: 300, level: byId("log-level").value, search: byId("log-search").value });
  const found = await ask("GET", `/api/log?${wanted}`);
  byId("no-log").hidden = found.lines.length > 0;
  setText(byId("log-dropped"), found.dropped ? `${found.dropped} older messages are no longer kept.` : "");
  keyed(
    byId("log-rows"),
    found.lines,
    (line) => line.number,
    (line) =>
      element("li", { "data-level": line.level }, element("time", {}, clockTime(line.at / 1000)), " ", element("strong", {}, line.level), " ", element("span", { class: "source" }, line.source), " ", line.text),
    () => {},
  );
}
