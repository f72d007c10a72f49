// Faults as switches, and a form that puts one on. What a fault profile takes is asked of the program, not known here.

import { byId, element, keyed, setText, valueText } from "./dom.js";
import { ask } from "./link.js";
import { typedNumber } from "./typed.js";

export class FaultView {
  constructor() {
    this.fault_profiles = [];
    byId("fault-name").addEventListener("change", () => this.choose());
    byId("fault-add").addEventListener("submit", (event) => {
      event.preventDefault();
      this.add();
    });
    this.take([]);
  }

  async load() {
    const answer = await ask("GET", "/api/faults");
    this.fault_profiles = answer.fault_profiles;
    byId("fault-add").hidden = this.fault_profiles.length === 0;
    byId("fault-name").replaceChildren(
      ...this.fault_profiles.map((one) => element("option", { value: one.name }, one.name)),
    );
    this.choose();
    this.take(answer.faults);
  }

  take(faults) {
    keyed(byId("fault-list"), faults, (fault) => fault.name, (fault) => this.make(fault), update);
    byId("faults-empty").hidden = faults.length > 0;
    const on = faults.filter((fault) => fault.on).length;
    byId("faults-on").hidden = on === 0;
    setText(byId("faults-on"), String(on));
    byId("faults-on").title = `${on} on`;
  }

  make(fault) {
    const toggle = element("button", {
      type: "button",
      class: "switch",
      role: "switch",
      "aria-label": fault.name,
      onclick: () => this.act("PATCH", fault.name, { on: toggle.getAttribute("aria-checked") !== "true" }),
    });
    return element(
      "li",
      { class: "fault" },
      toggle,
      element("span", { class: "what" }, element("strong", {}, fault.name), " ", element("span", { class: "hint struck" })),
      element(
        "button",
        { type: "button", class: "quiet", "aria-label": `Take ${fault.name} off`, onclick: () => this.act("DELETE", fault.name) },
        "Take off",
      ),
      element("span", { class: "hint about" }, about(fault)),
    );
  }

  async act(method, name, body) {
    setText(byId("fault-error"), "");
    try {
      await ask(method, `/api/faults/${encodeURIComponent(name)}`, body);
      this.take((await ask("GET", "/api/faults")).faults);
    } catch (error) {
      setText(byId("fault-error"), error.message);
    }
  }

  // Putting one on.

  chosen() {
    return this.fault_profiles.find((one) => one.name === byId("fault-name").value);
  }

  choose() {
    const chosen = this.chosen();
    setText(byId("fault-happens"), chosen?.happens ?? "");
    byId("fault-options").replaceChildren(
      ...(chosen?.parameters ?? []).map((one) => {
        const hint = [one.meaning, one.range].filter(Boolean).join(", ");
        const field =
          one.kind === "bool"
            ? element(
                "select",
                { "data-name": one.name },
                element("option", { value: "" }, `as usual (${valueText(one.default)})`),
                element("option", { value: "true" }, "on"),
                element("option", { value: "false" }, "off"),
              )
            : element("input", { "data-name": one.name, placeholder: one.default === null ? "none" : valueText(one.default), inputmode: one.kind ? "decimal" : null });
        return element("label", {}, one.name.replaceAll("_", " "), " ", field, element("small", {}, hint));
      }),
    );
  }

  async add() {
    setText(byId("fault-add-error"), "");
    try {
      const wanted = { fault_profile: byId("fault-name").value, parameters: {} };
      for (const field of byId("fault-options").querySelectorAll("[data-name]")) {
        if (field.value.trim() !== "") wanted.parameters[field.dataset.name] = plain(field.value.trim());
      }
      for (const [key, label] of [["units", "Units"], ["functions", "Functions"]]) {
        const text = byId(`fault-${key}`).value.trim();
        if (text) wanted[key] = numbers(text, label);
      }
      for (const [key, label] of [["first", "First address"], ["last", "Last address"], ["probability", "Probability"]]) {
        const text = byId(`fault-${key}`).value.trim();
        if (text) wanted[key] = number(text, label);
      }
      await ask("POST", "/api/faults", wanted);
      this.take((await ask("GET", "/api/faults")).faults);
    } catch (error) {
      setText(byId("fault-add-error"), error.message);
    }
  }
}

function update(item, fault) {
  const toggle = item.querySelector(".switch");
  if (toggle.getAttribute("aria-checked") !== String(fault.on)) toggle.setAttribute("aria-checked", fault.on);
  setText(item.querySelector(".struck"), fault.struck === 1 ? "struck once" : `struck ${fault.struck} times`);
}

function about(fault) {
  const { items, ...choice } = fault.selection;
  const parts = [fault.happens];
  const list = (key, word) => choice[key] && parts.push(`${word} ${choice[key].join(", ")}`);
  if (fault.fault_profile !== fault.name) parts.unshift(fault.fault_profile);
  list("units", "unit");
  list("functions", "function");
  if (choice.first !== undefined) parts.push(`addresses ${choice.first}–${choice.last}`);
  for (const [table, ranges] of Object.entries(items ?? {})) {
    parts.push(`${table.replace("_", " ")} ${ranges.map(([first, end]) => `${first}–${end - 1}`).join(", ")}`);
  }
  if (choice.probability !== undefined) parts.push(`one in ${Number((1 / choice.probability).toPrecision(3))}`);
  for (const key of ["after", "lasts", "every"]) if (choice[key] !== undefined) parts.push(`${key} ${choice[key]} s`);
  const own = Object.entries(fault.parameters).map(([name, value]) => `${name.replaceAll("_", " ")} ${valueText(value)}`);
  return [...parts, ...own].join(" · ");
}

function plain(text) {
  if (text === "true" || text === "false") return text === "true";
  return Number.isNaN(Number(text)) ? text : Number(text);
}

function number(text, label) {
  try {
    return typedNumber(text);
  } catch (error) {
    throw new Error(`${label}: ${error.message}`);
  }
}

/** The numbers of "1, 5, 10-12". */
function numbers(text, label) {
  return text.split(",").flatMap((part) => {
    const range = /^\s*(\d+)\s*(?:[-–]\s*(\d+)\s*)?$/.exec(part);
    if (!range) throw new Error(`${label}: numbers such as 1, 5, 10-12 are needed.`);
    const first = Number(range[1]);
    const last = range[2] === undefined ? first : Number(range[2]);
    if (last < first || last > 255) throw new Error(`${label}: ${part.trim()} is not a valid range.`);
    return Array.from({ length: last - first + 1 }, (_, at) => first + at);
  });
}
