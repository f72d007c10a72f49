// The module of a simulation: its points, trends, traffic and faults, and its server.

import { FaultView } from "./faults.js";
import { PointTable } from "./points.js";
import { StatusView } from "./status.js";
import { TrafficView } from "./traffic.js";
import { Trends } from "./trends.js";

export function start({ stream }) {
  const trends = new Trends(() => {
    table.redraw();
    if (!table.followsAll) table.followVisible();
  });
  const table = new PointTable(stream, trends);
  const traffic = new TrafficView(stream);
  const faults = new FaultView();
  const status = new StatusView();
  return {
    hint: "The program that runs the simulation has printed it, or was given it in a file.",
    views: {
      trends: { setVisible: (isVisible) => trends.setVisible(isVisible) },
      traffic: { setVisible: (isVisible) => traffic.setVisible(isVisible) },
      server: { setVisible: (isVisible) => status.setVisible(isVisible) },
    },
    async load() {
      await table.load();
      trends.use(table);
      await faults.load();
    },
    take(message) {
      if (message.points) table.take(message.points, message.time);
      if (message.traffic) traffic.take(message.traffic, message.skipped);
      if (message.faults) faults.take(message.faults);
      if (message.status) status.take(message.status);
    },
  };
}
