// Who uses the page and what they may do: the role of the token that is shown, or of none.

import { byId, setText } from "./dom.js";
import { ask, hasToken, useToken } from "./link.js";

const ROLES = ["view", "operate", "configure"];

export const session = { name: "", role: "view" };
const listeners = [];

/** Whether the user may do what needs a role. */
export const may = (role) => ROLES.indexOf(session.role) >= ROLES.indexOf(role);

/** Call a function now and whenever the role becomes another. */
export function onRole(told) {
  listeners.push(told);
  told();
}

/** Ask for name and role; throws a `Refusal` where a token is needed. */
export async function learnRole() {
  takeRole(await ask("GET", "/api/caller"));
}

/** Take over who the user is and what that role may do. */
export function takeRole(caller) {
  Object.assign(session, caller);
  setText(byId("who"), session.name === session.role ? session.role : `${session.name}: ${session.role}`);
  setText(byId("sign"), hasToken() ? "Sign out" : "Sign in");
  byId("sign").hidden = !hasToken() && may("configure"); // there is no more to get
  for (const told of listeners) told();
}

/** Ask for a token; `problem` says why. */
export function askForToken(problem = "") {
  setText(byId("token-message"), problem);
  if (!byId("token").open) byId("token").showModal();
}

/** `changed` is called after another token was given, or none. */
export function offerTokens(changed) {
  byId("sign").addEventListener("click", () => {
    if (!hasToken()) return askForToken();
    useToken("");
    changed();
  });
  byId("token-cancel").addEventListener("click", () => byId("token").close());
  byId("token-form").addEventListener("submit", () => {
    useToken(byId("token-input").value);
    byId("token-input").value = "";
    changed();
  });
}
