// The views of a page as tabs: one for each section that a module brings, those left out that the user's role does not
// permit. The view that is shown stands behind # in the address.

import { byId, element, setText } from "./dom.js";
import { may, onRole } from "./session.js";

export class Views {
  constructor() {
    this.looks = {};
    this.sections = [...document.querySelectorAll("main > section")];
    this.shown = location.hash.slice(1);
    byId("tabs").replaceChildren(...this.sections.map((section) => this.tab(section)));
  }

  /** Begin with what the modules do for their views: `refresh` asks anew, `setVisible` is told whether it is shown. */
  use(looks) {
    this.looks = looks;
    addEventListener("hashchange", () => this.follow());
    onRole(() => {
      for (const section of this.sections) byId(`tab-${section.id}`).hidden = !isPermitted(section);
      this.show(this.permitted().includes(this.shown) ? this.shown : this.permitted()[0], false);
    });
  }

  tab({ id, dataset }) {
    const badge = dataset.badge ? [element("span", { id: dataset.badge, class: "badge", hidden: true })] : [];
    const tab = element("button", { type: "button", role: "tab", id: `tab-${id}`, "aria-controls": id }, dataset.tab, ...badge);
    byId(id).setAttribute("aria-labelledby", tab.id);
    tab.addEventListener("click", () => this.show(id, true));
    tab.addEventListener("keydown", (event) => {
      const there = this.permitted();
      const at = there.indexOf(id);
      const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: there.length - 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      this.show(there[(to + there.length) % there.length], true);
    });
    return tab;
  }

  permitted() {
    return this.sections.filter(isPermitted).map((section) => section.id);
  }

  follow() {
    const wanted = location.hash.slice(1);
    if (this.permitted().includes(wanted)) this.show(wanted, false);
  }

  show(wanted, focus) {
    if (wanted !== this.shown) setText(byId("problem"), "");
    this.shown = wanted;
    for (const { id } of this.sections) {
      const isShown = id === wanted;
      const tab = byId(`tab-${id}`);
      tab.setAttribute("aria-selected", isShown);
      tab.tabIndex = isShown ? 0 : -1;
      byId(id).hidden = !isShown;
      if (isShown && focus) tab.focus();
      this.looks[id]?.setVisible?.(isShown);
    }
    if (location.hash !== `#${wanted}`) history.replaceState(null, "", `#${wanted}`);
    this.refresh();
  }

  /** Ask anew for what the view shows; what is wrong is said above it. */
  async refresh() {
    const mine = this.shown;
    const refresh = this.looks[mine]?.refresh;
    if (!refresh || document.hidden) return;
    try {
      await refresh();
      if (mine === this.shown) setText(byId("problem"), "");
    } catch (error) {
      if (mine === this.shown) setText(byId("problem"), error.message);
    }
  }
}

const isPermitted = (section) => may(section.dataset.needs ?? "view");
