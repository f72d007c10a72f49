// The frames that pass, the newest first.
//
// 1. Frames come only while they are looked at: on another view, and while it is paused, none are sent.
// 2. A page shows so many; a filter looks at all that are kept.

import { byId, clockTime, duration, eachFrame, element, setText } from "./dom.js";

const KEPT = 1000;
const SHOWN = 200;

export class TrafficView {
  constructor(stream) {
    this.stream = stream;
    this.frames = [];
    this.fresh = [];
    this.skipped = 0;
    this.isPaused = false;
    this.isVisible = false;
    this.list = byId("frames");
    this.draw = eachFrame(() => this.render());
    byId("hold").addEventListener("click", () => this.setPaused(!this.isPaused));
    byId("clear").addEventListener("click", () => {
      this.frames = [];
      this.fresh = [];
      this.all();
    });
    byId("frame-filter").addEventListener("input", () => this.all());
    byId("frame-kind").addEventListener("change", () => this.all());
    this.all();
  }

  take(frames, skipped) {
    this.skipped = skipped;
    if (this.isPaused || !this.isVisible) return;
    for (const frame of frames) {
      this.frames.push(frame);
      this.fresh.push(frame);
    }
    if (frames.length) this.stream.seen(frames[frames.length - 1].number);
    if (this.frames.length > KEPT) this.frames.splice(0, this.frames.length - KEPT);
    this.draw();
  }

  setVisible(isVisible) {
    if (this.isVisible === isVisible) return;
    this.isVisible = isVisible;
    this.want();
  }

  setPaused(isPaused) {
    this.isPaused = isPaused;
    byId("hold").setAttribute("aria-pressed", isPaused);
    this.want();
    this.count();
  }

  want() {
    const traffic = this.isVisible && !this.isPaused;
    const last = this.frames.at(-1)?.number;
    this.stream.want(traffic && last !== undefined ? { traffic, after: last } : { traffic });
  }

  // What is shown.

  filter() {
    const words = byId("frame-filter").value.toLowerCase().split(/\s+/).filter(Boolean);
    const kind = byId("frame-kind").value;
    return (frame) => {
      if (kind === "wrong" ? !isWrong(frame) : kind && frame.direction !== kind) return false;
      if (!words.length) return true;
      const text = `unit ${frame.unit} ${frame.peer} ${frame.text} ${frame.raw}`.toLowerCase();
      return words.every((word) => text.includes(word));
    };
  }

  all() {
    this.fresh = [];
    const fits = this.filter();
    const found = this.frames.filter(fits).slice(-SHOWN).reverse();
    this.list.replaceChildren(...found.map(entry));
    this.count();
  }

  render() {
    const fits = this.filter();
    const added = this.fresh.filter(fits).slice(-SHOWN).reverse();
    this.fresh = [];
    if (added.length) {
      const atTop = this.list.scrollTop < 4;
      const before = this.list.scrollHeight;
      this.list.prepend(...added.map(entry));
      while (this.list.childElementCount > SHOWN) this.list.lastElementChild.remove();
      // A reader further down is not pushed away.
      if (!atTop) this.list.scrollTop += this.list.scrollHeight - before;
    }
    this.count();
  }

  count() {
    const parts = [`${this.frames.length} frames`];
    if (this.skipped) parts.push(`${this.skipped} skipped`);
    if (this.isPaused) parts.push("paused");
    setText(byId("frame-count"), parts.join(", "));
    byId("frames-empty").hidden = this.list.childElementCount > 0;
    setText(byId("frames-empty"), this.frames.length ? "No frame fits the filter." : "Nothing has passed yet.");
  }
}

const isWrong = (frame) => frame.exception || frame.direction === "damaged" || frame.problems.length > 0;

function entry(frame) {
  const way = frame.direction === "request" ? "→" : frame.direction === "reply" ? "←" : "✕";
  const words = frame.direction === "request" ? "request" : frame.direction;
  const addressed = frame.unit === null ? "" : `unit ${frame.unit} · `;
  const summary = element(
    "summary",
    {},
    element("span", { class: "f-time" }, clockTime(frame.at)),
    element("span", { class: "f-way", title: words, "aria-label": words }, way),
    element("span", { class: "f-peer", title: frame.peer }, frame.peer),
    element("span", { class: "f-text" }, addressed + frame.text),
    element("span", { class: "f-took" }, frame.seconds === null ? "" : duration(frame.seconds)),
  );
  const made = element("details", { class: `${frame.direction}${isWrong(frame) ? " wrong" : ""}` }, summary);
  // The fields are made when the row is opened: most never are.
  made.addEventListener("toggle", () => made.childElementCount === 1 && made.append(more(frame)), { once: true });
  return made;
}

function more(frame) {
  const fields = frame.fields.flatMap((field) => [
    element("span", { class: "hint" }, field.name),
    element("span", { class: "raw" }, field.data),
    element("span", { class: field.problem ? "error" : "" }, field.problem || field.text),
  ]);
  const facts = [frame.transaction === null ? "" : `transaction ${frame.transaction}`, `PDU ${frame.raw}`].filter(Boolean);
  return element(
    "div",
    { class: "f-more" },
    ...fields,
    element("span", { class: "raw f-whole" }, facts.join(" · ")),
    ...frame.problems.map((problem) => element("span", { class: "error f-whole" }, problem)),
  );
}
