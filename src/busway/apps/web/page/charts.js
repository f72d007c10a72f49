// How all charts look that uPlot draws.

import { colour } from "./dom.js";

/** An axis in the colours of the page; `more` has options of uPlot that come on top. */
export function axis(more = {}) {
  const line = colour("--line");
  return { stroke: colour("--soft"), grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, ...more };
}
