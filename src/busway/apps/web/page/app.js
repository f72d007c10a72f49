// The shell of every page: the modules that the program has, their views, who the user is, and the stream.
//
// A module is a file with `start(shell)`, which gives what the shell needs of it, all of it optional:
//   views   by the id of a section: `refresh`, asked for each second, and `setVisible`
//   load    asks for what the stream does not send, before the stream begins
//   take    gets each message of the stream
//   about   asks for what stands above the views, each second
//   hint    where the user finds a token

import { byId, setText } from "./dom.js";
import { Refusal, Stream, hasToken } from "./link.js";
import { askForToken, learnRole, offerTokens, onRole, session, takeRole } from "./session.js";
import { Views } from "./views.js";
import "./theme.js";

const PERIOD = 1000;
const AGAIN = 3000;
const STATES = { waiting: "connecting", live: "live", down: "not connected" };

let begun = 0;

function state(name, text = STATES[name]) {
  byId("live").dataset.state = name;
  setText(byId("live"), text);
}

const stream = new Stream(
  (message) => {
    if (message.caller) takeRole(message.caller);
    for (const one of modules) one.take?.(message);
  },
  (name) => {
    state(name);
    if (name === "down") askAgain();
  },
);

/** Everything that is loaded first, then the stream. What is begun meanwhile, with another token, takes its place. */
async function begin() {
  begun += 1;
  const mine = begun;
  try {
    await learnRole();
    for (const one of modules) {
      await one.load?.(() => mine === begun);
      if (mine !== begun) return;
    }
    stream.reopen();
    await about();
  } catch (error) {
    if (mine !== begun) return;
    if (error instanceof Refusal && error.status === 401) askForToken(hasToken() ? error.message : "");
    else {
      state("down", error.message);
      setTimeout(() => mine === begun && begin(), AGAIN);
    }
  }
}

/** The stream has ended or could not begin: perhaps the token is taken no longer, or permits something else now. */
async function askAgain() {
  const mine = begun;
  try {
    await learnRole();
  } catch (error) {
    if (mine !== begun || error.status !== 401) return; // begun anew, or nothing answers: the stream tries again
    stream.stop();
    state("down", error.message);
    askForToken(error.message);
  }
}

const about = () => Promise.all(modules.map((one) => one.about?.()));

async function keepUp() {
  if (!document.hidden) {
    await about().catch(() => {}); // the stream says when nothing answers
    await views.refresh();
  }
  setTimeout(keepUp, PERIOD);
}

const names = document.body.dataset.modules.split(" ");
const views = new Views(); // first: the modules look for the badges of their tabs
const shell = { stream, begin, refresh: (id) => views.shown === id && views.refresh() };
const modules = (await Promise.all(names.map((name) => import(`/${name}.js`)))).map((module) => module.start(shell));
views.use(Object.assign({}, ...modules.map((one) => one.views)));
setText(byId("token-hint"), modules.find((one) => one.hint)?.hint ?? "");
onRole(() => (document.body.dataset.role = session.role));
offerTokens(begin);
begin();
setTimeout(keepUp, PERIOD);
