// The way to the program: requests by HTTP, and the stream by WebSocket, which comes back by itself.
// It knows the token; the token stands behind # in the address, is taken from there, and goes nowhere else.

const KEPT_TOKEN = "busway-token";
const FIRST_PAUSE = 500;
const LONGEST_PAUSE = 10000;

/** What the program has refused: a sentence, the status, and the sentence as it came. */
export class Refusal extends Error {
  constructor(sentence, status, told = sentence) {
    super(sentence);
    this.status = status;
    this.told = told;
  }
}

let token = takeToken();

function takeToken() {
  const found = /^#token=(.+)$/.exec(location.hash);
  if (found) {
    const given = decodeURIComponent(found[1]);
    sessionStorage.setItem(KEPT_TOKEN, given);
    history.replaceState(null, "", location.pathname);
    return given;
  }
  return sessionStorage.getItem(KEPT_TOKEN) || "";
}

export function useToken(given) {
  token = given.trim();
  sessionStorage.setItem(KEPT_TOKEN, token);
}

/** Whether a token is shown. */
export const hasToken = () => token !== "";

/** Ask by HTTP; gives the JSON of the answer, throws a `Refusal` with the program's sentence. */
export const ask = (method, path, body) =>
  exchange(method, path, body === undefined ? undefined : JSON.stringify(body), "application/json");

/** As `ask`, with a body of another type. */
export async function exchange(method, path, body, kind) {
  const headers = {};
  if (token) headers.Authorization = `Bearer ${token}`;
  if (body !== undefined) headers["Content-Type"] = kind;
  let response;
  try {
    response = await fetch(path, { method, headers, body });
  } catch {
    throw new Refusal("The program does not answer.", 0);
  }
  let content = null;
  try {
    content = await response.json();
  } catch {
    content = null;
  }
  if (!response.ok) {
    const told = content?.error ?? `status ${response.status}`;
    throw new Refusal(sentence(told), response.status, told);
  }
  return content;
}

const sentence = (text) => text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?…]$/.test(text) ? "" : ".");

/** The path of a point. */
export const pointPath = (point, what = "points") => `/api/units/${point.unit}/${what}/${encodeURIComponent(point.name)}`;

/** The stream. `told` gets each message, `state` gets "waiting", "live" or "down". */
export class Stream {
  constructor(told, state) {
    this.told = told;
    this.state = state;
    this.wish = {};
    this.pause = FIRST_PAUSE;
    this.socket = null;
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const protocols = token ? ["busway", `bearer.${token}`] : ["busway"];
    const socket = new WebSocket(`${scheme}://${location.host}/stream`, protocols);
    this.socket = socket;
    this.state("waiting");
    socket.addEventListener("open", () => {
      this.pause = FIRST_PAUSE;
      this.state("live");
      if (Object.keys(this.wish).length) socket.send(JSON.stringify(this.wish));
    });
    socket.addEventListener("message", (event) => {
      if (this.socket === socket) this.told(JSON.parse(event.data));
    });
    socket.addEventListener("close", () => {
      if (this.socket !== socket) return;
      this.state("down");
      this.again = setTimeout(() => this.open(), this.pause * (0.75 + Math.random() / 2));
      this.pause = Math.min(this.pause * 2, LONGEST_PAUSE);
    });
  }

  /** Connect anew: another token is used, or everything has to come again. */
  reopen() {
    this.stop();
    this.open();
  }

  /** Stay without a connection until `reopen`. */
  stop() {
    clearTimeout(this.again);
    const before = this.socket;
    this.socket = null;
    before?.close();
  }

  /** Say what is wanted from now on; it is said again after each new connection. */
  want(wish) {
    Object.assign(this.wish, wish);
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(wish));
  }

  /** Remember up to which frame everything came, for the next connection. */
  seen(number) {
    this.wish.after = number;
  }
}
