// Alarms: those that are active or not acknowledged, and the journal.

import { moment as momentOf } from "./commands.js";
import { byId, element, keyed, setText, valueText } from "./dom.js";
import { ask } from "./link.js";
import { may } from "./session.js";

const moment = (at) => momentOf(at === null ? null : at / 1000);
const LIMITS = { HH: "far too high (HH)", H: "high (H)", L: "low (L)", LL: "far too low (LL)" };

export class AlarmView {
  constructor() {
    this.busy = false;
  }

  async show() {
    const found = await ask("GET", "/api/alarms");
    const key = (each) => `${each.device}/${each.point} ${each.limit}`;
    byId("no-alarms").hidden = found.active.length > 0;
    byId("alarm-table").hidden = found.active.length === 0;
    keyed(byId("alarm-rows"), found.active, key, (each) => this.row(each), (row, each) => this.update(row, each));
    const told = (each) => [moment(each.at), `${each.device}/${each.point}`, LIMITS[each.limit] ?? each.limit, each.event, valueText(each.value, null), each.by ?? ""];
    keyed(
      byId("journal-rows"),
      found.journal,
      (each) => `${each.at} ${key(each)} ${each.event}`,
      (each) => element("tr", {}, ...told(each).map(() => element("td"))),
      (row, each) => told(each).forEach((text, at) => setText(row.children[at], String(text))),
    );
    this.count({ active: found.active.filter((each) => !each.cleared).length, unacknowledged: found.active.filter((each) => each.needs_acknowledgement).length });
  }

  /** The number beside the tab, from the stream or from what was asked for. */
  count({ active, unacknowledged }) {
    byId("alarm-count").hidden = !active && !unacknowledged;
    setText(byId("alarm-count"), String(active));
    byId("alarm-count").dataset.waiting = unacknowledged > 0;
    byId("tab-alarms").setAttribute("aria-label", active || unacknowledged ? `Alarms: ${active} active, ${unacknowledged} not acknowledged` : "Alarms");
  }

  row(alarm) {
    const name = `${alarm.device}/${alarm.point} ${alarm.limit}`;
    const button = element("button", { type: "button", "aria-label": `Acknowledge ${name}`, onclick: () => this.acknowledge(alarm) }, "Acknowledge");
    return element("tr", {}, element("th", { scope: "row" }), ...Array.from({ length: 5 }, () => element("td")), element("td", {}, button));
  }

  update(row, alarm) {
    const acknowledged = alarm.acknowledged ? `by ${alarm.acknowledged.by}, ${moment(alarm.acknowledged.at)}` : alarm.needs_acknowledgement ? "no" : "";
    const texts = [`${alarm.device}/${alarm.point}`, LIMITS[alarm.limit] ?? alarm.limit, valueText(alarm.value, null), moment(alarm.since), alarm.cleared ? `over since ${moment(alarm.cleared)}` : [alarm.text || "active", alarm.quality === "good" ? "" : `${alarm.quality}: ${alarm.reason}`].filter(Boolean).join("; "), acknowledged];
    texts.forEach((text, at) => setText(row.children[at], text));
    row.dataset.active = !alarm.cleared;
    row.lastChild.firstChild.hidden = !alarm.needs_acknowledgement || !may("operate");
  }

  async acknowledge({ device, point, limit }) {
    try {
      await ask("POST", "/api/alarms/acknowledge", { device, point, limit });
      setText(byId("alarm-message"), "");
      await this.show();
    } catch (error) {
      setText(byId("alarm-message"), error.message);
    }
  }
}
