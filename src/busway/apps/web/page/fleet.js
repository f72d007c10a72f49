// The module of a fleet: the zone of a collector: who owns what, how far behind, and when nothing was owned.

import { byId, fill, percent, setText } from "./dom.js";
import { ask } from "./link.js";

export const start = () => ({ views: { fleet: { refresh: showFleet } } });

const seconds = (hole) => ((hole.end - hole.begin) / 1000).toFixed(1);

async function showFleet() {
  const found = await ask("GET", "/api/fleet");
  const away = found.is_complete ? "" : "The coordinator is away; this is what was known last. ";
  const file = found.revision ? `Configuration: revision ${found.revision}, ${found.configuration}` : "No configuration was applied.";
  setText(byId("fleet-message"), away + file);
  const state = (each) => (each.problem ? `${each.state}: ${each.problem}` : each.state);
  fill("fleet-collector-rows", found.collectors, (each) => each.name, (each) => [each.name, each.host, state(each), each.shards, percent(each.load), each.behind, each.revision], [3, 4, 5, 6]);
  const from = (each) => (each.was_silent ? `${each.before}, which fell silent` : each.before);
  fill("hole-rows", found.holes, (each) => `${each.shard} ${each.epoch}`, (each) => [each.shard, new Date(each.end).toLocaleTimeString(), seconds(each), from(each), each.after, each.epoch], [2]);
  byId("no-holes").hidden = found.holes.length > 0;
  byId("hole-table").hidden = found.holes.length === 0;
  fill("shard-rows", found.shards, (each) => each.shard, (each) => [each.shard, each.owner || "free", each.epoch, percent(each.load)], [3]);
  fill("fleet-sink-rows", found.sinks, (each) => each.name, (each) => [each.name, each.behind ?? "not known", each.taken], [1, 2]);
  byId("no-fleet-sinks").hidden = found.sinks.length > 0;
  byId("fleet-sink-table").hidden = found.sinks.length === 0;
}
