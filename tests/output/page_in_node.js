// Runs the scripts of an animated page without a browser: a document of stand-ins, a renderer that draws nothing.
// Sets the slider to each frame and prints where three.js has every vertex of every part then, as JSON.
"use strict";
const fs = require("fs"), vm = require("vm");
const page = fs.readFileSync(process.argv[2], "utf8");
const scripts = [...page.matchAll(/<script([^>]*)>([\s\S]*?)<\/script>/g)];

function element() {
  return {
    style: {}, children: [], textContent: "", clientWidth: 800, clientHeight: 600, dataset: {},
    append(...more) { this.children.push(...more); }, addEventListener() {}, removeEventListener() {},
    getBoundingClientRect() { return { left: 0, top: 0, width: 800, height: 600 }; },
    ownerDocument: { documentElement: { clientLeft: 0, clientTop: 0 } },
  };
}
const known = {};
for (const [, attributes, text] of scripts) {
  const id = /id="(\w+)"/.exec(attributes);
  if (id) known[id[1]] = { ...element(), textContent: text };
}
globalThis.window = globalThis;
globalThis.self = globalThis;
if (!globalThis.navigator) globalThis.navigator = { userAgent: "chrome" };
globalThis.devicePixelRatio = 1;
globalThis.addEventListener = () => {};
globalThis.requestAnimationFrame = () => {};
globalThis.document = {
  getElementById: (id) => (known[id] = known[id] || element()),
  createElement: element, addEventListener() {},
};
const programs = scripts.filter(([, attributes]) => !attributes.includes("type="));
vm.runInThisContext(programs[0][2]);
let drawn = 0;
THREE.WebGLRenderer = class {
  constructor() { this.domElement = element(); }
  setPixelRatio() {}
  setSize() {}
  render(scene) { drawn += 1; scene.updateMatrixWorld(); }
};
vm.runInThisContext(programs[1][2]);

function places(node) {
  const found = [], point = new THREE.Vector3(), move = new THREE.Vector3();
  const { position } = node.geometry.attributes, targets = node.geometry.morphAttributes.position || [];
  for (let v = 0; v < position.count; v++) {
    point.fromBufferAttribute(position, v);
    targets.forEach((target, k) => {
      point.addScaledVector(move.fromBufferAttribute(target, v), node.morphTargetInfluences[k]);
    });
    found.push(point.applyMatrix4(node.matrixWorld).toArray());
  }
  return found;
}
setTimeout(() => {
  const told = [];
  for (let k = 0; k < window.rbfmuscle.frames; k++) {
    known.frame.value = String(k);
    known.frame.oninput();
    const parts = {};
    window.rbfmuscle.scene.traverse((node) => { if (node.isMesh) parts[node.userData.name] = places(node); });
    told.push({ caption: known.caption.textContent, parts });
  }
  const boxes = known.names.children.map((label) => label.children[2]);
  known.names.children[0].children[0].checked = false;
  known.names.children[0].children[0].onchange();
  const hidden = [];
  window.rbfmuscle.scene.traverse((node) => { if (!node.visible) hidden.push(node.userData.name); });
  process.stdout.write(JSON.stringify({ frames: told, boxes, hidden, drawn }));
}, 200);
