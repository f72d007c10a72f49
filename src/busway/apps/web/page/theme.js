// The colours of the page: those of the system, or light, or dark; what was chosen is kept in the browser.

import { byId, setText } from "./dom.js";

const THEMES = ["auto", "light", "dark"];
const KEPT = "busway-theme";
const listeners = [];

let theme = localStorage.getItem(KEPT);
if (!THEMES.includes(theme)) theme = "auto";

/** Call a function whenever colours become others. */
export const onTheme = (told) => listeners.push(told);

function apply() {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  setText(byId("theme"), `Theme: ${theme}`);
  for (const told of listeners) told();
}

byId("theme").addEventListener("click", () => {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  localStorage.setItem(KEPT, theme);
  apply();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
apply();
