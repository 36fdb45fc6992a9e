"use strict";
// Shows what page.py packs: models beside each other, seen alike, turned, scrubbed, and muscles switched on and off.
(function () {
const VERTEX = `attribute vec3 place, normal; uniform mat4 view; uniform mat3 turn; varying vec3 facing;
void main() { facing = turn * normal; gl_Position = view * vec4(place, 1.0); }`;
const FRAGMENT = `precision mediump float; varying vec3 facing; uniform vec3 colour;
void main() { vec3 n = normalize(facing); float lit = max(dot(n, vec3(-0.3, 0.39, 0.87)), 0.0);
float gloss = pow(max(dot(n, vec3(-0.155, 0.2, 0.967)), 0.0), 24.0);
gl_FragColor = vec4(colour * (0.42 + 0.62 * lit) + 0.1 * gloss, 1.0); }`;

const element = (kind, parent, words) => parent.appendChild(Object.assign(document.createElement(kind), words));
const add = (a, b, share) => a.map((x, k) => x + share * b[k]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function unpack(data, bytes) {
  let at = 0;
  function whole(count, size) {
    const found = size === 2 ? new Int16Array(count) : new Int32Array(count);
    for (let place = 0; place < size; place++, at += count)
      for (let k = 0; k < count; k++) found[k] |= bytes[at + k] << (8 * place);
    return found;
  }
  function sum(values, lag, block) {
    for (let k = lag; k < values.length; k++) if (k % block >= lag || block === Infinity) values[k] += values[k - lag];
  }
  for (const part of data.parts)
    for (const piece of part.pieces) {
      const all = whole(piece.frames * piece.points * 3, 2), row = piece.points * 3;
      sum(all, 3, row); sum(all, row, Infinity); sum(all, row, Infinity);
      piece.places = Float32Array.from(all, (x, k) => x * data.step + data.origin[k % 3]);
      const corners = whole(piece.faces * 3, 4);
      sum(corners, 1, Infinity);
      piece.corners = new Uint32Array(corners);
    }
}

function normals(places, corners) {
  const found = new Float32Array(places.length);
  for (let f = 0; f < corners.length; f += 3) {
    const [a, b, c] = [3 * corners[f], 3 * corners[f + 1], 3 * corners[f + 2]];
    const u = [0, 1, 2].map((k) => places[b + k] - places[a + k]);
    const n = cross(u, [0, 1, 2].map((k) => places[c + k] - places[a + k]));
    for (let k = 0; k < 3; k++) { found[a + k] += n[k]; found[b + k] += n[k]; found[c + k] += n[k]; }
  }
  return found;
}

class Scene {
  constructor(home, data) {
    this.data = data; this.frame = 0; this.zoom = 1; this.shift = [0, 0]; this.home = home;
    this.stage = element("div", home, {className: "stage"});
    this.canvas = element("canvas", this.stage, {});
    const gl = this.gl = this.canvas.getContext("webgl2", {antialias: true, preserveDrawingBuffer: true});
    if (!gl) throw new Error("this browser draws no WebGL 2");
    const program = this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    gl.linkProgram(program); gl.useProgram(program); gl.enable(gl.DEPTH_TEST); gl.enable(gl.SCISSOR_TEST);
    for (const part of data.parts) {
      part.shown = true; part.buffers = [0, 1, 2].map(() => gl.createBuffer());
      part.rgb = [1, 3, 5].map((k) => parseInt(part.colour.slice(k, k + 2), 16) / 255);
    }
    data.panels.forEach((name) => name && element("span", this.stage, {className: "title", textContent: name}));
    // Where it is narrow, models stand below each other.
    const width = home.clientWidth, panels = data.panels.length;
    if (width < 600 && panels > 1) home.style.height = `${(0.75 * panels * width + 180).toFixed()}px`;
    this.build(); this.listen(); this.look(data.direction); this.show(data.captions.length - 1);
    new ResizeObserver(() => this.draw()).observe(this.stage);
  }

  build() {
    const data = this.data, bar = element("div", this.home, {className: "bar"}), last = data.captions.length - 1;
    this.play = element("button", bar, {type: "button", textContent: "▶ Play", hidden: last < 1});
    this.slider = element("input", bar, {type: "range", min: 0, max: last, value: 0, ariaLabel: "frame", hidden: last < 1});
    this.caption = element("span", bar, {className: "caption"});
    const views = element("div", bar, {className: "views"});
    for (const [name, way] of Object.entries({motion: data.direction, ...data.views}))
      element("button", views, {type: "button", textContent: name, onclick: () => this.look(way)});
    const names = element("div", this.home, {className: "names"}), groups = new Map();
    for (const part of data.parts) {
      const group = part.panel < 0 ? "bones" : part.group;
      if (!groups.has(group)) groups.set(group, new Map());
      if (!groups.get(group).has(part.name)) groups.get(group).set(part.name, []);
      groups.get(group).get(part.name).push(part);
    }
    for (const [group, members] of groups) this.switches(element("fieldset", names, {}), group, members);
  }

  switches(field, group, members) {
    const boxes = [], all = element("legend", field, {});
    if (group && members.size > 1) {
      const label = element("label", all, {}), box = element("input", label, {type: "checkbox", checked: true});
      label.append(group);
      box.onchange = () => boxes.forEach((other) => { other.checked = box.checked; other.onchange(); });
    }
    for (const [name, parts] of members) {
      const label = element("label", field, {}), box = element("input", label, {type: "checkbox", checked: true});
      element("i", label, {}).style.background = parts[0].colour;
      label.append(name.replaceAll("_", " "));
      box.onchange = () => {
        parts.forEach((part) => { part.shown = box.checked; });
        document.querySelectorAll(`[data-muscle="${CSS.escape(name)}"]`).forEach((line) => {
          line.style.display = box.checked ? "" : "none"; });
        this.draw();
      };
      boxes.push(box);
    }
  }

  listen() {
    const fingers = new Map(), canvas = this.canvas;
    canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); };
    canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
    canvas.onpointermove = (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      if (fingers.size > 1) {
        const other = [...fingers.values()].find((one) => one.pointerId !== event.pointerId);
        const far = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
        this.zoom *= far(event) / Math.max(far(before), 1);
      } else if (event.shiftKey || event.buttons & 2) this.shift = add(this.shift, [dx, -dy], 1);
      else { this.azimuth -= 0.008 * dx; this.height = Math.max(-1.5, Math.min(1.5, this.height + 0.008 * dy)); }
      fingers.set(event.pointerId, event);
      this.draw();
    };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault(); this.zoom *= Math.exp(-0.0012 * event.deltaY); this.draw(); }, {passive: false});
    canvas.ondblclick = () => this.look(this.data.direction);
    this.slider.oninput = () => this.show(Number(this.slider.value));
    this.play.onclick = () => {
      const {captions, rate} = this.data, next = () => this.show((this.frame + 1) % captions.length);
      this.timer = this.timer ? clearInterval(this.timer) : setInterval(next, 1000 / rate);
      this.play.textContent = this.timer ? "❚❚ Stop" : "▶ Play";
    };
  }

  // Seen from a direction along the body's axes: left, posterior, superior.
  look([x, y, z]) {
    this.azimuth = x || y ? Math.atan2(y, x) : Math.sign(z) * Math.PI / 2; this.height = Math.atan2(z, Math.hypot(x, y));
    this.zoom = 1; this.shift = [0, 0]; this.box = this.bounds(this.axes()); this.draw();
  }

  axes() {
    const [c, s, rise, flat] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.sin(this.height), Math.cos(this.height)];
    const axes = [[-s, c, 0], [-c * rise, -s * rise, flat], [c * flat, s * flat, rise]];
    return axes.map((axis) => [0, 1, 2].map((k) => axis.reduce((sum, x, j) => sum + x * this.data.body[j][k], 0)));
  }

  // Middle and half sizes of all muscles in all frames.
  bounds(axes) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const part of this.data.parts) if (part.panel >= 0) for (const {places} of part.pieces)
      for (let k = 0; k < places.length; k += 3) {
        const point = [places[k], places[k + 1], places[k + 2]];
        axes.forEach((axis, j) => { const x = dot(axis, point);
          if (x < low[j]) low[j] = x; if (x > high[j]) high[j] = x; });
      }
    const middle = add(low, high, 1).map((x) => x / 2);
    return {centre: axes.reduce((sum, axis, j) => add(sum, axis, middle[j]), [0, 0, 0]),
      wide: (high[0] - low[0]) / 2, tall: (high[1] - low[1]) / 2, deep: Math.hypot(...add(high, low, -1))};
  }

  show(frame) {
    const gl = this.gl;
    this.frame = frame; this.slider.value = frame; this.caption.textContent = this.data.captions[frame];
    for (const part of this.data.parts) {
      let k = frame, piece = part.pieces[0];
      if (part.panel >= 0) for (piece of part.pieces) { if (k < piece.frames) break; k -= piece.frames; }
      else if (part.count) continue;
      const start = part.panel < 0 ? 0 : 3 * k * piece.points;
      const places = piece.places.subarray(start, start + 3 * piece.points);
      [places, normals(places, piece.corners)].forEach((values, j) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, part.buffers[j]); gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW); });
      if (part.piece !== piece) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.buffers[2]);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, piece.corners, gl.STATIC_DRAW);
      }
      part.piece = piece; part.count = piece.corners.length;
    }
    this.draw();
  }

  draw() {
    const gl = this.gl, {stage, canvas, box} = this, panels = this.data.panels.length;
    const [width, height] = [stage.clientWidth, stage.clientHeight], fine = window.devicePixelRatio || 1;
    if (!width || !height || !box) return;
    canvas.width = Math.round(width * fine); canvas.height = Math.round(height * fine);
    const titles = [...stage.querySelectorAll(".title")], strip = (w) => titles.reduce((most, title) => {
      title.style.width = `${w}px`; return Math.max(most, title.offsetHeight); }, 0);
    let columns = panels, size = 0;
    for (let n = 1; n <= panels; n++) {
      const fits = Math.min(width / n / box.wide, (height / Math.ceil(panels / n) - strip(width / n)) / box.tall);
      if (fits > size) [size, columns] = [fits, n];
    }
    const w = width / columns, above = strip(w), h = height / Math.ceil(panels / columns) - above;
    for (let k = 0; k < panels; k++) {
      const x = (k % columns) * w, y = Math.floor(k / columns) * (h + above);
      const place = [x, height - y - above - h, w, h].map((value) => Math.round(value * fine));
      gl.viewport(...place); gl.scissor(...place);
      gl.clearColor(1, 1, 1, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      if (titles[k]) Object.assign(titles[k].style, {left: `${x}px`, top: `${y}px`});
      this.panel(k, w, h, 0.44 * size);
    }
  }

  panel(number, w, h, size) {
    const gl = this.gl, axes = this.axes(), {box, program} = this, scale = size * this.zoom;
    const place = (name) => gl.getUniformLocation(program, name);
    for (const part of this.data.parts) {
      if (!part.shown || (part.panel >= 0 && part.panel !== number)) continue;
      const poses = part.poses || [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]], pose = poses[Math.min(this.frame, poses.length - 1)];
      const [shift, ...columns] = [3, 0, 1, 2].map((k) => [pose[k], pose[k + 4], pose[k + 8]]);
      const rows = axes.map((axis) => columns.map((column) => dot(axis, column)));
      const at = axes.map((axis) => dot(axis, add(shift, box.centre, -1)));
      const factors = [2 * scale / w, 2 * scale / h, -1 / (4 * box.deep)];
      const view = [0, 1, 2].flatMap((k) => [...rows.map((row, j) => factors[j] * row[k]), 0]);
      view.push(factors[0] * at[0] + 2 * this.shift[0] / w, factors[1] * at[1] + 2 * this.shift[1] / h,
        factors[2] * at[2], 1);
      gl.uniformMatrix4fv(place("view"), false, view);
      gl.uniformMatrix3fv(place("turn"), false, [0, 1, 2].flatMap((k) => rows.map((row) => row[k])));
      gl.uniform3fv(place("colour"), part.rgb);
      ["place", "normal"].forEach((name, j) => {
        const slot = gl.getAttribLocation(program, name);
        gl.bindBuffer(gl.ARRAY_BUFFER, part.buffers[j]); gl.enableVertexAttribArray(slot);
        gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
      });
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, part.buffers[2]);
      gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0);
    }
  }
}

async function mount(home) {
  try {
    const data = JSON.parse(document.getElementById(home.dataset.scene).textContent);
    unpack(data, await inflate(data.bytes));
    home.scene = new Scene(home, data);
  } catch (error) {
    element("p", home, {textContent: `The moving picture needs a browser with WebGL 2 (${error.message}).`});
  }
}
document.querySelectorAll("[data-scene]").forEach(mount);
})();
