// Small things that every view needs: elements, numbers in words, and work that waits for the next frame.
// Nothing here makes HTML of text.

/** The element of an id. */
export const byId = (id) => document.getElementById(id);

/** A new element with attributes and children; texts become text, never HTML. */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "class") made.className = value;
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

/** Set a text only where it differs: what does not change costs nothing. */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

/** A value as people read it. */
export function valueText(value, point) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "on" : "off";
  if (Array.isArray(value)) return value.map((one) => valueText(one, null)).join(", ");
  if (typeof value === "number") {
    const label = point?.labels.get(value);
    if (label !== undefined) return `${label} (${value})`;
    const set = (point?.flags ?? []).filter(([, bit]) => isSet(value, bit)).map(([name]) => name);
    if (set.length) return `${set.join(", ")} (${value})`;
    return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(7)));
  }
  return String(value);
}

/** Whether a bit of a whole number is set, also beyond the 32 bits of the operators of this language, and below zero. */
const isSet = (value, bit) => Math.abs(Math.floor(value / 2 ** bit) % 2) === 1;

/** A value as a number for charts; NaN for what is none. */
export function numberOf(value) {
  if (typeof value === "number") return value;
  if (typeof value === "boolean") return value ? 1 : 0;
  return NaN;
}

/** Seconds in words: 3.2 ms, 4 s, 1 h 02 min. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 0.9995) return `${(seconds * 1000).toFixed(seconds < 0.01 ? 1 : 0)} ms`;
  if (seconds < 60) return `${seconds.toFixed(seconds < 10 && !Number.isInteger(seconds) ? 1 : 0)} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes} min ${String(Math.floor(seconds % 60)).padStart(2, "0")} s`;
  return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

/** A moment of the clock, to the second. */
export function clockSeconds(seconds) {
  const date = new Date(seconds * 1000);
  return [date.getHours(), date.getMinutes(), date.getSeconds()].map((part) => String(part).padStart(2, "0")).join(":");
}

/** A moment of the clock, to the millisecond. */
export function clockTime(seconds) {
  return `${clockSeconds(seconds)}.${String(Math.floor((seconds % 1) * 1000)).padStart(3, "0")}`;
}

/** Bytes in words. */
export function bytesText(count) {
  if (count < 1000) return `${count} B`;
  return count < 1e6 ? `${(count / 1e3).toFixed(1)} kB` : `${(count / 1e6).toFixed(1)} MB`;
}

/** A colour by its name in style.css. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Work that is done once in the next animation frame, however often it is asked for. */
export function eachFrame(work) {
  let asked = false;
  return () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      work();
    });
  };
}

/** Update the children of `parent` to `items`, keeping those whose key stays. */
export function keyed(parent, items, keyOf, make, update) {
  const known = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  let at = parent.firstElementChild;
  for (const item of items) {
    const key = String(keyOf(item));
    let child = known.get(key);
    if (child) known.delete(key);
    else {
      child = make(item);
      child.dataset.key = key;
    }
    if (child === at) at = at.nextElementSibling;
    else parent.insertBefore(child, at);
    update(child, item);
  }
  for (const child of known.values()) child.remove();
}

/** Fill a table; `cells` gives the texts of an item. */
export function fill(id, items, keyOf, cells, numbers) {
  const make = (item) =>
    element("tr", {}, ...cells(item).map((_, at) => element(at ? "td" : "th", { class: numbers.includes(at) ? "number" : false, scope: at ? false : "row" })));
  const update = (row, item) => cells(item).forEach((text, at) => setText(row.children[at], String(text)));
  keyed(byId(id), items, keyOf, make, update);
}

/** A part of a whole in words. */
export const percent = (part) => `${(100 * part).toFixed(1)} %`;
