// Runs the script of an animated page without a browser and prints what it unpacks, as JSON.
"use strict";
const fs = require("fs"), vm = require("vm");
const scripts = [...fs.readFileSync(process.argv[2], "utf8").matchAll(/<script([^>]*)>([\s\S]*?)<\/script>/g)];
const data = scripts.find(([, attributes]) => attributes.includes("json"))[2];
let parsed;
const parse = JSON.parse;
JSON.parse = (text) => {
  const found = parse(text);
  if (found.parts) parsed = found;
  return found;
};
const home = {dataset: {scene: "scene"}, appendChild: (child) => child, clientWidth: 800};
globalThis.document = {
  getElementById: () => ({textContent: data}),
  querySelectorAll: () => [home],
  // No canvas draws here: the script ends with its message after all is unpacked.
  createElement: () => ({appendChild: (child) => child, getContext: () => null}),
};
vm.runInThisContext(scripts.at(-1)[2]);
setTimeout(() => {
  for (const part of parsed.parts)
    for (const piece of part.pieces) {
      piece.places = Array.from(piece.places);
      piece.corners = Array.from(piece.corners);
    }
  process.stdout.write(JSON.stringify(parsed));
}, 500);
