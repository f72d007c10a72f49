// Asks the search of the built site as its pages do: its own worker, its own index, one query after the other.
// usage: node site_search.js SITE QUERY…   prints, as JSON, the addresses that each query finds, best first
"use strict";

const fs = require("node:fs");
const path = require("node:path");
const vm = require("node:vm");

const [site, ...queries] = process.argv.slice(2);
const folder = path.join(site, "assets", "javascripts", "workers");
const [worker] = fs.readdirSync(folder).filter((name) => /^search\..*\.js$/.test(name));
const index = JSON.parse(fs.readFileSync(path.join(site, "search.json"), "utf8"));
const answers = [];
const self = { postMessage: (data) => answers.push(data) };
vm.runInNewContext(fs.readFileSync(path.join(folder, worker), "utf8"), { self, Intl });

async function ask(message) {
  self.onmessage({ data: structuredClone(message) }); // as between a page and its worker
  while (!answers.length) await new Promise((resolve) => setImmediate(resolve));
  return answers.pop();
}

// What the page's own script sends when nothing is chosen beside the words.
const filter = {
  input: { type: "operator", data: { operator: "and", operands: [] } },
  aggregation: { input: [{ type: "term", data: { field: "tags" } }] },
};

(async () => {
  await ask({ type: 0, data: index });
  const found = {};
  for (const input of queries) {
    const { data } = await ask({ type: 2, data: { input, filter } });
    found[input] = data.items.map(({ id }) => index.items[id].location);
  }
  console.log(JSON.stringify(found));
})();
