// The configuration: the whole file, replaced as a whole or refused as a whole.

import { byId, setText } from "./dom.js";
import { ask, exchange } from "./link.js";

export class ConfigurationView {
  constructor() {
    this.revision = null;
    this.loading = null; // the first load: a second one would take the place of what is typed meanwhile
    byId("configuration-apply").addEventListener("click", () => this.apply());
    byId("configuration-again").addEventListener("click", () => this.load());
  }

  /** Load it at the first look; what is being edited stays. */
  async show() {
    if (this.revision !== null) return;
    this.loading ??= this.load().finally(() => (this.loading = null));
    await this.loading;
  }

  async load() {
    const found = await ask("GET", "/api/configuration");
    this.revision = found.revision;
    byId("configuration-text").value = found.text;
    setText(byId("configuration-revision"), `Revision ${found.revision}`);
    setText(byId("configuration-message"), "");
    setText(byId("configuration-done"), "");
  }

  async apply() {
    setText(byId("configuration-message"), "");
    setText(byId("configuration-done"), "");
    byId("configuration-apply").disabled = true;
    try {
      const path = `/api/configuration?${new URLSearchParams({ revision: this.revision })}`;
      const told = await exchange("POST", path, byId("configuration-text").value, "application/toml");
      this.revision = told.revision;
      setText(byId("configuration-revision"), `Revision ${told.revision}`);
      setText(byId("configuration-done"), `Applied: ${told.done.join("; ")}.`);
    } catch (error) {
      setText(byId("configuration-message"), error.told ?? error.message);
    } finally {
      byId("configuration-apply").disabled = false;
    }
  }
}
