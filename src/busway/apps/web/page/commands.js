// Writes: a value is armed, confirmed by the sentence that the program makes of it, and its outcome shown; and the list
// of what was written.

import { byId, clockSeconds, element, keyed, setText, valueText } from "./dom.js";
import { ask } from "./link.js";
import { isInexact, typedNumber } from "./typed.js";

const STATES = { on: true, true: true, 1: true, off: false, false: false, 0: false };
const OUTCOMES = { done: "Written", failed: "Not written", refused: "Refused", expired: "Expired, nothing was sent", unknown: "It is not known whether it was written" };

/** A value as it was typed; throws a sentence. */
export function typedValue(text, kind) {
  const typed = text.trim();
  if (!typed) throw new Error("Type a value.");
  if (kind === "text") return typed;
  if (kind === "state") {
    const state = STATES[typed.toLowerCase()];
    if (state === undefined) throw new Error(`${typed} is no state: type on or off.`);
    return state;
  }
  if (isInexact(typed)) throw new Error(`A browser cannot send ${typed} exactly; use the API.`);
  return typedNumber(typed);
}

/** The values of a point that are chosen rather than typed, by what the list says; empty for a point of any number. */
function choicesOf(point) {
  if (point.labels.size) return new Map([...point.labels].map(([number, name]) => [`${name} (${number})`, name]));
  return new Map(point.kind === "state" ? [["on", true], ["off", false]] : []);
}

export class WriteDialog {
  constructor(done, closed) {
    this.done = done;
    byId("write-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.arm();
    });
    this.choices = new Map();
    byId("write-value").addEventListener("input", () => this.forget());
    byId("write-choice").addEventListener("change", () => this.forget());
    byId("write-confirm").addEventListener("click", () => this.confirm());
    for (const id of ["write-cancel", "write-back", "write-close"]) byId(id).addEventListener("click", () => byId("write").close());
    byId("write").addEventListener("close", () => {
      this.forget();
      closed(this.point);
    });
  }

  open(point) {
    this.point = point;
    setText(byId("write-title"), `Write ${point.key}`);
    const measure = point.unit_of_measure ? ` ${point.unit_of_measure}` : "";
    setText(byId("write-now"), `Now: ${valueText(point.value, point)}${point.value === null ? "" : measure}`);
    setText(byId("write-label"), point.unit_of_measure ? `New value in ${point.unit_of_measure}` : "New value");
    this.offer(choicesOf(point));
    this.forget();
    byId("write").showModal();
    this.field().focus();
  }

  /** Show the list of values, or, where there is none, the field to type one. */
  offer(choices) {
    this.choices = choices;
    byId("write-value").value = "";
    byId("write-value").hidden = choices.size > 0;
    byId("write-choice").hidden = choices.size === 0;
    const option = (text) => element("option", { value: text }, text || "Choose a value");
    byId("write-choice").replaceChildren(...["", ...choices.keys()].map(option));
    byId("write-label").htmlFor = this.field().id;
  }

  field() {
    return byId(this.choices.size ? "write-choice" : "write-value");
  }

  /** The value that was chosen or typed; throws a sentence. */
  value() {
    const { value } = this.field();
    if (!this.choices.size) return typedValue(value, this.point.kind);
    if (!this.choices.has(value)) throw new Error("Choose a value.");
    return this.choices.get(value);
  }

  /** Whether another value can be chosen or typed. */
  lock(isLocked) {
    byId("write-value").readOnly = isLocked;
    byId("write-choice").disabled = isLocked;
  }

  /** Another value: what was armed no longer counts. */
  forget() {
    this.armed = null;
    this.asked = (this.asked ?? 0) + 1;
    clearTimeout(this.expiring);
    setText(byId("write-message"), "");
    setText(byId("write-outcome"), "");
    byId("write-question").hidden = true;
    byId("write-arm").hidden = false;
    byId("write-done").hidden = true;
    this.lock(false);
  }

  async arm() {
    this.forget();
    const mine = this.asked;
    try {
      const value = this.value();
      const { device, point } = this.point;
      const armed = await ask("POST", "/api/commands/arm", { device, point, value });
      if (mine !== this.asked) return; // another value was typed meanwhile, or another point opened
      this.armed = armed;
      setText(byId("write-sentence"), armed.confirm);
      byId("write-arm").hidden = true;
      byId("write-question").hidden = false;
      byId("write-confirm").focus();
      this.expiring = setTimeout(() => this.expire(), Math.min(Math.max(armed.expires * 1000 - Date.now(), 0), 600000));
    } catch (error) {
      if (mine === this.asked) setText(byId("write-message"), error.message);
    }
  }

  expire() {
    this.forget();
    setText(byId("write-message"), "It was not confirmed in time, and nothing was sent. Ask again.");
    this.field().focus();
  }

  async confirm() {
    const armed = this.armed;
    if (!armed) return;
    this.armed = null; // once, however often the button is pressed
    const mine = this.asked;
    clearTimeout(this.expiring);
    byId("write-question").hidden = true;
    this.lock(true);
    setText(byId("write-outcome"), "It is being written…");
    let text;
    try {
      const told = await ask("POST", `/api/commands/${encodeURIComponent(armed.key)}/confirm`, {});
      const back = told.read_back === null || told.read_back === undefined ? "" : ` The device now has ${valueText(told.read_back, this.point)}.`;
      text = `${OUTCOMES[told.state] ?? told.state}.${back}${told.reason ? ` ${told.reason}` : ""}`;
    } catch (error) {
      text = error.status ? error.message : `${OUTCOMES.unknown}. ${error.message} Look at the list of commands before you try again.`;
    }
    this.done();
    if (mine !== this.asked) return; // the dialog is about another write by now; the list of commands has this one
    setText(byId("write-outcome"), text);
    byId("write-done").hidden = false;
    byId("write-close").focus();
  }
}

/** The list of what was written, the newest first; values have the names that their points give them now. */
export async function showCommands(points) {
  const { commands: list } = await ask("GET", "/api/commands?limit=200");
  byId("no-commands").hidden = list.length > 0;
  byId("command-table").hidden = list.length === 0;
  const described = new Map(points.map((point) => [point.key, point]));
  const text = (value, each) => valueText(value, described.get(`${each.device}/${each.point}`));
  const cells = (each) => [
    moment(each.at),
    each.by,
    each.origin,
    `${each.device}/${each.point}`,
    text(each.old, each),
    text(each.value, each),
    each.state,
    each.reason ?? "",
  ];
  keyed(
    byId("command-rows"),
    list,
    (each) => each.key,
    (each) => element("tr", {}, ...cells(each).map(() => element("td"))),
    (row, each) => cells(each).forEach((cell, at) => setText(row.children[at], String(cell))),
  );
}

/** A moment as date and time of day, from seconds since 1970. */
export function moment(seconds) {
  if (seconds === null || seconds === undefined) return "";
  return `${new Date(seconds * 1000).toLocaleDateString()} ${clockSeconds(seconds)}`;
}
