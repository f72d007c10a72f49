// Devices, links and sinks: how they do, and the maintenance of a device.

import { byId, element, fill, keyed, percent, setText } from "./dom.js";
import { ask } from "./link.js";
import { may } from "./session.js";
import { ago } from "./values.js";

export class DeviceView {
  constructor() {
    byId("maintenance-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.change(this.device, true, byId("maintenance-reason").value.trim());
    });
    byId("maintenance-cancel").addEventListener("click", () => byId("maintenance").close());
  }

  async show() {
    const [found, left] = await Promise.all([ask("GET", "/api/devices"), ask("GET", "/api/maintenance")]);
    const why = new Map(left.map((each) => [each.device, each.by ? `, by ${each.by}: ${each.reason}` : ""]));
    const since = (each) => (each.silent_since === null ? "" : ` for ${ago(found.now, each.silent_since)}`);
    const told = (each) => each.state + since(each) + (why.get(each.name) ?? "");
    const cells = (each) => [each.name, each.link, told(each), each.reads, each.failures, each.skipped, each.last_error, each.learnt.join("; ")];
    keyed(
      byId("device-rows"),
      found.devices,
      (each) => each.name,
      (each) => this.row(each, cells),
      (row, each) => {
        cells(each).forEach((text, at) => setText(row.children[at], String(text)));
        const button = row.lastChild.firstChild;
        const isOn = each.state === "maintenance";
        button.hidden = !may("operate");
        button.onclick = () => (isOn ? this.change(each.name, false, "ended on the page") : this.ask(each.name, button));
        setText(button, isOn ? "End maintenance" : "Maintenance");
        button.setAttribute("aria-label", `${isOn ? "End the" : "Begin the"} maintenance of ${each.name}`);
      },
    );
  }

  row(each, cells) {
    const made = cells(each).map((_, at) => element(at ? "td" : "th", { class: [3, 4, 5].includes(at) ? "number" : false, scope: at ? false : "row" }));
    return element("tr", {}, ...made, element("td", {}, element("button", { type: "button", class: "quiet" })));
  }

  ask(device, opener) {
    this.device = device;
    this.opener = opener;
    setText(byId("maintenance-title"), `Maintenance of ${device}`);
    byId("maintenance-reason").value = "";
    setText(byId("maintenance-message"), "");
    byId("maintenance").showModal();
  }

  async change(device, on, reason) {
    try {
      await ask("POST", `/api/devices/${encodeURIComponent(device)}/maintenance`, { on, reason });
      setText(byId("device-message"), "");
      byId("maintenance").close();
      await this.show();
    } catch (error) {
      setText(byId(on ? "maintenance-message" : "device-message"), error.message);
    }
  }
}

/** The links: planned and real load, latencies, and the reads with their cost. */
export async function showLinks() {
  const found = await ask("GET", "/api/links");
  const latency = (each) => (each.latency.map((one) => (1000 * one).toFixed(1)).join(" / "));
  const silent = (each) => each.silent.map((one) => `${one.device} for ${ago(found.now, one.since)}`).join(", ");
  fill("link-rows", found.links, (each) => each.name, (each) => [each.name, percent(each.planned), percent(each.busy), percent(each.probing), latency(each), silent(each), each.problems.join("; ")], [1, 2, 3, 4]);
  fill("read-rows", found.reads, (each) => `${each.device} ${each.poll_class} ${each.first}`, (each) => [each.device, each.link, each.poll_class, each.first, each.count, each.points, `${(1000 * each.seconds).toFixed(1)} ms`], [4, 5, 6]);
  setText(byId("more-reads"), found.more_reads ? `${found.more_reads} more are not shown.` : "");
}

/** The sinks: how far behind they are, and their last error. */
export async function showSinks() {
  const found = await ask("GET", "/api/sinks");
  fill("sink-rows", found.sinks, (each) => each.name, (each) => [each.name, each.behind, each.sent, each.lost, each.set_aside, each.error ?? ""], [1, 2, 3, 4]);
  byId("no-sinks").hidden = found.sinks.length > 0;
  byId("sink-table").hidden = found.sinks.length === 0;
  setText(byId("prometheus"), found.prometheus.length ? `Last values for Prometheus: ${found.prometheus.join(", ")}` : "");
}
