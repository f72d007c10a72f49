// The last numbers of a point, and how they are drawn in a row of a table.

import { colour, element } from "./dom.js";
import { onTheme } from "./theme.js";

const LENGTH = 60;
const WIDTH = 110;
const HEIGHT = 28;

let stroke = "";
onTheme(() => (stroke = ""));

/** The last numbers of a point; NaN for what is no number. */
export class Course {
  constructor() {
    this.numbers = new Float64Array(LENGTH).fill(NaN);
    this.pushed = 0;
  }

  push(number) {
    this.numbers[this.pushed % LENGTH] = number;
    this.pushed += 1;
  }

  /** The numbers, the oldest first. */
  *inOrder() {
    for (let at = Math.max(this.pushed - LENGTH, 0); at < this.pushed; at += 1) yield this.numbers[at % LENGTH];
  }
}

/** A small chart of a course; draws only what has become another. */
export class Sparkline {
  constructor() {
    this.canvas = element("canvas", { "aria-hidden": "true" });
  }

  draw(course) {
    const scale = window.devicePixelRatio || 1;
    stroke ||= colour("--accent");
    if (this.course === course && this.pushed === course?.pushed && this.scale === scale && this.stroke === stroke) return;
    Object.assign(this, { course, pushed: course?.pushed, scale, stroke });
    const { canvas } = this;
    canvas.width = Math.round(WIDTH * scale);
    canvas.height = Math.round(HEIGHT * scale);
    const numbers = course ? [...course.inOrder()] : [];
    const known = numbers.filter((one) => !Number.isNaN(one));
    canvas.dataset.drawn = known.length ? `${known.length} ${known.at(-1)}` : "";
    if (known.length < 2) return;
    const low = Math.min(...known);
    const high = Math.max(...known);
    const rise = (canvas.height - 4 * scale) / (high - low || 1);
    const context = canvas.getContext("2d");
    context.strokeStyle = stroke;
    context.lineWidth = 1.5 * scale;
    context.beginPath();
    numbers.forEach((number, at) => {
      if (Number.isNaN(number)) return;
      const y = high === low ? canvas.height / 2 : canvas.height - 2 * scale - (number - low) * rise;
      context.lineTo((at / (LENGTH - 1)) * (canvas.width - 2 * scale) + scale, y);
    });
    context.stroke();
  }
}
