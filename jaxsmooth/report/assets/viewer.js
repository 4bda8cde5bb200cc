"use strict";
// The picture of a report: two states of one mesh, drawn with WebGL 2.  No library, no request.
const data = JSON.parse(document.getElementById("scene").textContent);
const UNIT = 32000; // what q = 1 is stored as
const $ = (id) => document.getElementById(id);

function numbers(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}

// --- The mesh: elements, their facets, and which facets meet -------------------------------------------

// The sides show two states of all that there are: before and after, or methods to choose from.
const SIDES = ["before", "after"];
const shownState = { before: 0, after: data.right ?? 1 };
const mesh = load(data);
const state = { view: "both", colour: "quality", below: 1, axis: -1, cut: 1, flip: false, edges: true, chosen: -1 };
const camera = { az: data.dim === 3 ? -0.95 : -Math.PI / 2, el: data.dim === 3 ? 0.5 : Math.PI / 2, zoom: 1, x: 0, y: 0 };
let target = mesh.centre.slice();

function load(scene) {
  const states = scene.states.map((s) => ({ name: s.name, points: numbers(s.points, Float32Array),
    quality: numbers(s.quality, Int16Array), moved: numbers(s.moved, Uint16Array) }));
  const elements = states[0].quality.length;
  const rings = [], owner = [], firstFacet = new Uint32Array(elements + 1);
  let element = 0;
  for (const block of scene.blocks) {
    const nodes = numbers(block.nodes, scene.wide ? Uint32Array : Uint16Array);
    for (let e = 0; e < block.count; e++, element++) {
      firstFacet[element] = rings.length;
      for (const facet of block.facets) {
        rings.push(facet.map((i) => nodes[e * block.k + i]));
        owner.push(element);
      }
    }
  }
  firstFacet[elements] = rings.length;
  const step = scene.blocks.flatMap((b) => new Array(b.count).fill(b.curved ? 2 : 1));
  const lo = [Infinity, Infinity, Infinity], hi = [-Infinity, -Infinity, -Infinity];
  for (const { points } of states)
    for (let i = 0; i < points.length; i++) {
      const k = i % 3;
      if (points[i] < lo[k]) lo[k] = points[i];
      if (points[i] > hi[k]) hi[k] = points[i];
    }
  const centre = lo.map((x, k) => (x + hi[k]) / 2);
  const radius = Math.hypot(...lo.map((x, k) => (hi[k] - x) / 2)) || 1;
  return { states, points: {}, quality: {}, moved: {}, centroid: {}, elements, rings, owner, step, firstFacet, lo, hi, centre,
    radius, mate: mates(rings, step, owner), reason: numbers(scene.reason, Uint8Array) };
}

function mates(rings, step, owner) {
  // the facet on the other side, or −1; three lowest corners tell the faces of a solid apart
  const mate = new Int32Array(rings.length).fill(-1), seen = new Map();
  for (let f = 0; f < rings.length; f++) {
    const corners = rings[f].filter((_, i) => i % step[owner[f]] === 0).sort((a, b) => a - b);
    if (data.blocks.length && data.flat) continue;
    const key = corners.slice(0, 3).join(",");
    const other = seen.get(key);
    if (other === undefined) seen.set(key, f);
    else { mate[f] = other; mate[other] = f; seen.delete(key); }
  }
  return mate;
}

function centroids(side) {
  const points = mesh.points[side], out = new Float32Array(3 * mesh.elements);
  for (let e = 0; e < mesh.elements; e++) {
    let n = 0;
    for (let f = mesh.firstFacet[e]; f < mesh.firstFacet[e + 1]; f++)
      for (const p of mesh.rings[f]) { n++; for (let k = 0; k < 3; k++) out[3 * e + k] += points[3 * p + k]; }
    for (let k = 0; k < 3; k++) out[3 * e + k] /= n;
  }
  return out;
}

function setState(side, index) {
  shownState[side] = index;
  for (const what of ["points", "quality"]) mesh[what][side] = mesh.states[index][what];
  mesh.centroid[side] = centroids(side);
  for (const one of SIDES) // of the input: how far its nodes are from where the other side has them
    mesh.moved[one] = mesh.states[shownState[one] || shownState.before || shownState.after].moved;
}
SIDES.forEach((side) => setState(side, shownState[side]));

// --- What is shown --------------------------------------------------------------------------------------

function visible(side) {
  const show = new Uint8Array(mesh.elements), q = mesh.quality[side], c = mesh.centroid[side];
  const limit = state.below >= 1 ? 40000 : state.below * UNIT + 0.5;
  const k = state.axis, at = k < 0 ? 0 : mesh.lo[k] + state.cut * (mesh.hi[k] - mesh.lo[k]);
  let count = 0;
  for (let e = 0; e < mesh.elements; e++) {
    if (q[e] > limit) continue;
    if (k >= 0 && (state.flip ? c[3 * e + k] < at : c[3 * e + k] > at)) continue;
    show[e] = 1; count++;
  }
  return { show, count };
}

function build(side, show) {
  // triangles of the facets that one shown element has alone: place, value, edges
  const points = mesh.points[side], out = [], nodes = new Uint8Array(points.length / 3);
  const facets = [];
  for (let f = 0; f < mesh.rings.length; f++) {
    if (show[mesh.owner[f]] && !(mesh.mate[f] >= 0 && show[mesh.owner[mesh.mate[f]]])) facets.push(f);
  }
  let triangles = 0;
  for (const f of facets) triangles += mesh.rings[f].length - 2;
  const floats = new Float32Array(triangles * 15), bytes = new Uint8Array(floats.buffer), owner = new Uint32Array(triangles);
  let t = 0;
  const put = (e, ring, a, b, c, ab, bc, ca) => {
    const three = [ring[a], ring[b], ring[c]], hide = [bc ? 0 : 255, ca ? 0 : 255, ab ? 0 : 255];
    for (let v = 0; v < 3; v++) {
      const base = (3 * t + v) * 5, p = three[v];
      for (let k = 0; k < 3; k++) floats[base + k] = points[3 * p + k];
      floats[base + 3] = value(side, e, p);
      for (let k = 0; k < 3; k++) bytes[base * 4 + 16 + k] = Math.max(hide[k], k === v ? 255 : 0);
      nodes[p] = 1;
    }
    owner[t++] = e;
  };
  for (const f of facets) {
    const ring = mesh.rings[f], e = mesh.owner[f], n = ring.length;
    if (mesh.step[e] === 1) for (let i = 1; i < n - 1; i++) put(e, ring, 0, i, i + 1, i === 1, true, i === n - 2);
    else {
      for (let i = 0; i < n; i += 2) put(e, ring, (i + n - 1) % n, i, i + 1, true, true, false);
      for (let i = 3; i < n - 2; i += 2) put(e, ring, 1, i, i + 2, false, false, false);
    }
  }
  return { floats, owner, count: 3 * triangles, dots: dots(points, nodes) };
}

function value(side, e, p) {
  if (state.colour === "moved") return mesh.moved[side][p] / 65535;
  if (state.colour === "held") return 0.5;
  const q = mesh.quality[side][e];
  return q < 0 ? -1 : Math.min(q / UNIT, 1);
}

function dots(points, nodes) {
  const out = [];
  if (state.colour === "held")
    for (let p = 0; p < nodes.length; p++)
      if (nodes[p] && mesh.reason[p]) out.push(points[3 * p], points[3 * p + 1], points[3 * p + 2], mesh.reason[p]);
  return new Float32Array(out);
}

// --- Drawing --------------------------------------------------------------------------------------------

const canvas = $("canvas");
const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
const scales = {
  quality: ["#8f1030", "#d9442f", "#f2a541", "#f6dd74", "#8ccbb0", "#3f9aa6", "#1f6f8b"],
  moved: ["#eef3f5", "#b5d5e2", "#6aaecb", "#2f7fae", "#1c4f86", "#14275a"], held: ["#dfe6ea", "#dfe6ea"] };
const drawn = {};
let program, points_, ghost = {};

const VERTEX = `#version 300 es
in vec3 place; in float value; in vec3 edge; uniform mat4 view; out vec3 at; out float v; out vec3 border;
void main() { gl_Position = view * vec4(place, 1.0); at = gl_Position.xyz; v = value; border = edge; }`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at; in float v; in vec3 border; out vec4 colour;
uniform sampler2D scale; uniform float alpha; uniform float lines; uniform vec2 size; uniform vec3 tint; uniform float flat_;
void main() {
  vec3 p = vec3(at.xy * size, at.z * size.x);
  vec3 n = normalize(cross(dFdx(p), dFdy(p)));
  float light = mix(0.62 + 0.38 * abs(dot(n, normalize(vec3(0.35, 0.5, 1.0)))), 1.0, flat_);
  vec3 base = tint.x < 0.0 && v < -0.5 ? vec3(0.42, 0.08, 0.55) : tint.x < 0.0 ? texture(scale, vec2(v * 0.996 + 0.002, 0.5)).rgb : tint;
  vec3 width = max(fwidth(border), 1e-6);
  vec3 near = smoothstep(vec3(0.0), width * 1.1, border);
  float line = lines * (1.0 - min(near.x, min(near.y, near.z)));
  line *= 1.0 - 0.75 * smoothstep(0.15, 0.6, max(width.x, max(width.y, width.z)));
  colour = vec4(mix(base * light, vec3(0.07, 0.13, 0.18), line * 0.55), alpha);
}`;
const DOT_VERTEX = `#version 300 es
in vec3 place; in float value; uniform mat4 view; uniform float big; flat out int reason;
void main() { gl_Position = view * vec4(place, 1.0); gl_Position.z -= 0.004; gl_PointSize = big; reason = int(value); }`;
const DOT_FRAGMENT = `#version 300 es
precision highp float;
flat in int reason; out vec4 colour; uniform vec3 colours[16];
void main() { float r = length(gl_PointCoord - 0.5); if (r > 0.5) discard;
  colour = vec4(mix(colours[reason], vec3(1.0), smoothstep(0.36, 0.44, r)), 1.0); }`;

function compile(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  ["place", "value", "edge"].forEach((name, i) => gl.bindAttribLocation(made, i, name));
  gl.linkProgram(made);
  return new Proxy({ made }, { get: (o, name) => (name === "made" ? made : gl.getUniformLocation(made, name)) });
}

const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);

function setScale(name) {
  const stops = scales[name].map(rgb), pixels = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i++) {
    const x = (i / 255) * (stops.length - 1), j = Math.min(Math.floor(x), stops.length - 2);
    for (let k = 0; k < 3; k++) pixels[4 * i + k] = 255 * (stops[j][k] + (x - j) * (stops[j + 1][k] - stops[j][k]));
    pixels[4 * i + 3] = 255;
  }
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  for (const what of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, what, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
}

function buffer(array, old) {
  const made = old || gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW);
  return made;
}

function refresh() {
  const words = [];
  for (const side of SIDES) {
    const { show, count } = visible(side);
    const built = build(side, show);
    const old = drawn[side] || {};
    drawn[side] = { ...built, buffer: buffer(built.floats, old.buffer), dotBuffer: buffer(built.dots, old.dotBuffer), shown: count };
    words.push(count);
  }
  const all = words.every((n) => n === mesh.elements);
  const text = (n) => `${n.toLocaleString("en")} of ${mesh.elements.toLocaleString("en")}`;
  $("shown").textContent = all ? `all ${mesh.elements.toLocaleString("en")} elements` :
    `${text(words[0])} elements ${nameOf("before")}, ${text(words[1])} ${nameOf("after")}`;
  canvas.dataset.shown = words.join(" ");
  legend();
  draw();
}

function matrix(width, height) {
  const [sa, ca, se, ce] = [Math.sin(camera.az), Math.cos(camera.az), Math.sin(camera.el), Math.cos(camera.el)];
  const right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce], away = [ce * ca, ce * sa, se];
  const s = (camera.zoom * 0.96) / mesh.radius, small = Math.min(width, height);
  const rows = [right.map((x) => (x * s * small) / width), up.map((x) => (x * s * small) / height),
    away.map((x) => -x * 0.24 / mesh.radius)];
  const dot = (r) => r[0] * target[0] + r[1] * target[1] + r[2] * target[2];
  const shift = [(camera.x * small) / width, (camera.y * small) / height, 0];
  const m = [];
  for (let c = 0; c < 3; c++) m.push(rows[0][c], rows[1][c], rows[2][c], 0);
  m.push(...rows.map((r, i) => shift[i] - dot(r)), 1);
  return new Float32Array(m);
}

function areas() {
  const w = canvas.width, h = canvas.height;
  if (state.view !== "both") return [[state.view, 0, 0, w, h]];
  return w >= h * 1.1 ? [["before", 0, 0, w / 2, h], ["after", w / 2, 0, w / 2, h]] :
    [["before", 0, h / 2, w, h / 2], ["after", 0, 0, w, h / 2]];
}

let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; paint(); });
}

function paint() {
  const box = canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = Math.round(box.width * ratio); canvas.height = Math.round(box.height * ratio);
  gl.disable(gl.SCISSOR_TEST);
  gl.clearColor(0.945, 0.963, 0.973, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.SCISSOR_TEST);
  for (const [side, x, y, w, h] of areas()) {
    gl.viewport(x, y, w, h); gl.scissor(x, y, w, h);
    const view = matrix(w, h), some = drawn[side].shown < mesh.elements || state.chosen >= 0;
    gl.enable(gl.DEPTH_TEST); gl.disable(gl.BLEND); gl.depthMask(true);
    triangles(view, drawn[side].buffer, drawn[side].count, w, h, { alpha: 1 });
    if (state.colour === "held") points(view, drawn[side], ratio);
    if (some && data.dim === 3) {
      gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA); gl.depthMask(false);
      triangles(view, ghost[side].buffer, ghost[side].count, w, h, { alpha: 0.1, tint: [0.4, 0.52, 0.6] });
    }
    if (state.chosen >= 0) {
      gl.enable(gl.BLEND); gl.disable(gl.DEPTH_TEST); gl.depthMask(false);
      triangles(view, chosen[side].buffer, chosen[side].count, w, h, { alpha: 0.85, tint: [0.76, 0.16, 0.68], lines: 1 });
    }
  }
}

function triangles(view, vertices, count, w, h, how) {
  if (!count) return;
  gl.useProgram(program.made);
  gl.bindBuffer(gl.ARRAY_BUFFER, vertices);
  [[0, 3, gl.FLOAT, 0], [1, 1, gl.FLOAT, 12], [2, 3, gl.UNSIGNED_BYTE, 16]].forEach(([i, n, kind, at]) => {
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, n, kind, kind !== gl.FLOAT, 20, at);
  });
  gl.uniformMatrix4fv(program.view, false, view);
  gl.uniform1f(program.alpha, how.alpha);
  gl.uniform1f(program.flat_, data.dim === 2 ? 1 : 0);
  gl.uniform1f(program.lines, how.lines ?? (how.tint ? 0 : state.edges ? 1 : 0));
  gl.uniform2f(program.size, w, h);
  gl.uniform3fv(program.tint, how.tint || [-1, 0, 0]);
  gl.drawArrays(gl.TRIANGLES, 0, count);
}

function points(view, side, ratio) {
  if (!side.dots.length) return;
  gl.useProgram(points_.made);
  gl.bindBuffer(gl.ARRAY_BUFFER, side.dotBuffer);
  gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 16, 0);
  gl.enableVertexAttribArray(1); gl.vertexAttribPointer(1, 1, gl.FLOAT, false, 16, 12);
  gl.disableVertexAttribArray(2);
  gl.uniformMatrix4fv(points_.view, false, view);
  gl.uniform1f(points_.big, ratio * Math.min(11, 5 + camera.zoom));
  const colours = new Float32Array(48);
  data.reasons.forEach((reason, i) => colours.set(rgb(reason.colour), 3 * i));
  gl.uniform3fv(points_.colours, colours);
  gl.drawArrays(gl.POINTS, 0, side.dots.length / 4);
}

// --- Hands ----------------------------------------------------------------------------------------------

let chosen = {};
function choose(e, fly) {
  state.chosen = e;
  document.querySelectorAll("[data-element]").forEach((row) => row.classList.toggle("chosen", +row.dataset.element === e));
  if (e >= 0) {
    const show = new Uint8Array(mesh.elements);
    show[e] = 1;
    for (const side of SIDES) {
      const built = build(side, show);
      chosen[side] = { ...built, buffer: buffer(built.floats, (chosen[side] || {}).buffer) };
    }
    const q = SIDES.map((side) => (mesh.quality[side][e] / UNIT).toFixed(3));
    let first = 0;
    const block = data.blocks.find((b) => (first += b.count) > e);
    const number = data.ids ? data.ids[e] : e - (first - block.count);
    $("picked").textContent = `${block.name} ${number}: q ${q[0]} → ${q[1]}`;
    if (fly) {
      target = Array.from(mesh.centroid.after.subarray(3 * e, 3 * e + 3));
      let size = 0;
      for (let f = mesh.firstFacet[e]; f < mesh.firstFacet[e + 1]; f++)
        for (const p of mesh.rings[f])
          size = Math.max(size, Math.hypot(...target.map((x, k) => mesh.points.after[3 * p + k] - x)));
      Object.assign(camera, { zoom: Math.max(1, 0.28 * mesh.radius / size), x: 0, y: 0 });
    }
  } else $("picked").textContent = "";
  draw();
}

function pick(event) {
  const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
  const px = (event.clientX - box.left) * ratio, py = canvas.height - (event.clientY - box.top) * ratio;
  const area = areas().find(([, x, y, w, h]) => px >= x && px < x + w && py >= y && py < y + h);
  if (!area) return;
  const [side, x, y, w, h] = area, m = matrix(w, h), { floats, owner } = drawn[side];
  const cx = ((px - x) / w) * 2 - 1, cy = ((py - y) / h) * 2 - 1, at = new Float64Array(9);
  let best = -1, depth = Infinity;
  for (let t = 0; t < owner.length; t++) {
    for (let v = 0; v < 3; v++)
      for (let r = 0; r < 3; r++) {
        const i = (3 * t + v) * 5;
        at[3 * v + r] = m[r] * floats[i] + m[4 + r] * floats[i + 1] + m[8 + r] * floats[i + 2] + m[12 + r];
      }
    const area2 = (at[3] - at[0]) * (at[7] - at[1]) - (at[6] - at[0]) * (at[4] - at[1]);
    const a = ((at[3] - cx) * (at[7] - cy) - (at[6] - cx) * (at[4] - cy)) / area2;
    const b = ((at[6] - cx) * (at[1] - cy) - (at[0] - cx) * (at[7] - cy)) / area2;
    if (!(a >= 0 && b >= 0 && a + b <= 1)) continue;
    const z = a * at[2] + b * at[5] + (1 - a - b) * at[8];
    if (z < depth) { depth = z; best = owner[t]; }
  }
  choose(best, false);
}

const fingers = new Map();
let travelled = 0, spread = 0;
canvas.addEventListener("pointerdown", (e) => {
  canvas.setPointerCapture(e.pointerId);
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
  travelled = 0; spread = 0;
});
canvas.addEventListener("pointermove", (e) => {
  const old = fingers.get(e.pointerId);
  if (!old) return;
  const dx = e.clientX - old[0], dy = e.clientY - old[1], small = Math.min(canvas.clientWidth, canvas.clientHeight);
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
  travelled += Math.abs(dx) + Math.abs(dy);
  if (fingers.size > 1) {
    const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (spread) camera.zoom *= now / spread;
    spread = now;
    camera.x += dx / small; camera.y -= dy / small;
  } else if (e.shiftKey || e.buttons === 2 || e.buttons === 4 || data.dim === 2) {
    camera.x += (2 * dx) / small; camera.y -= (2 * dy) / small;
  } else {
    camera.az -= dx * 0.008;
    camera.el = Math.max(-1.57, Math.min(1.57, camera.el + dy * 0.008));
  }
  draw();
});
for (const name of ["pointerup", "pointercancel"])
  canvas.addEventListener(name, (e) => {
    if (fingers.delete(e.pointerId) && name === "pointerup" && travelled < 5) pick(e);
    spread = 0;
  });
canvas.addEventListener("contextmenu", (e) => e.preventDefault());
canvas.addEventListener("wheel", (e) => {
  e.preventDefault();
  camera.zoom = Math.max(0.2, Math.min(400, camera.zoom * Math.exp(-e.deltaY * 0.0012)));
  draw();
}, { passive: false });

const nameOf = (side) => mesh.states[shownState[side]].name;

function whole(side) {
  const built = build(side, new Uint8Array(mesh.elements).fill(1));
  ghost[side] = { buffer: buffer(built.floats, (ghost[side] || {}).buffer), count: built.count };
}

function label(side) {
  $(`only-${side}`).textContent = nameOf(side);
  const tag = $(`tag-${side}`);
  if (mesh.states.length === 2) { tag.textContent = nameOf(side); return; }
  const select = document.createElement("select");
  mesh.states.forEach((one, i) => select.add(new Option(one.name, i, false, i === shownState[side])));
  select.addEventListener("change", () => {
    setState(side, +select.value);
    $(`only-${side}`).textContent = nameOf(side);
    whole(side); choose(state.chosen, false); refresh();
  });
  tag.replaceChildren(select);
}

function legend() {
  const bar = $("legend"), stops = scales[state.colour];
  const ends = state.colour === "moved" ? ["0", data.farthest] : ["q = 0", "1"];
  const tangled = state.colour === "quality" && SIDES.some((side) => mesh.quality[side].some((q) => q < 0));
  bar.innerHTML = state.colour === "held" ?
    data.reasons.map((r) => (r.count ? `<span><i style="background:${r.colour}"></i>${r.name} <b>${r.count.toLocaleString("en")}</b></span>` : "")).join("") :
    `<span>${ends[0]}</span><em style="background:linear-gradient(90deg,${stops.join(",")})"></em><span>${ends[1]}</span>${tangled ? '<span><i style="background:#6b148c"></i>q < 0</span>' : ""}`;
}

function group(name, then) {
  document.querySelectorAll(`[data-group=${name}] button`).forEach((button) =>
    button.addEventListener("click", () => {
      document.querySelectorAll(`[data-group=${name}] button`).forEach((b) => b.setAttribute("aria-pressed", b === button));
      then(button.value);
    }));
}

function start() {
  program = compile(VERTEX, FRAGMENT);
  points_ = compile(DOT_VERTEX, DOT_FRAGMENT);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  setScale("quality");
  for (const side of SIDES) { whole(side); label(side); }
  group("view", (v) => { state.view = v; $("stage").dataset.view = v; draw(); });
  group("colour", (v) => { state.colour = v; setScale(v); refresh(); });
  group("axis", (v) => { state.axis = +v; $("cut").disabled = state.axis < 0; if (state.axis >= 0 && state.cut === 1) $("cut").value = state.cut = 0.5; refresh(); });
  $("below").addEventListener("input", (e) => {
    state.below = +e.target.value;
    $("limit").textContent = state.below >= 1 ? "all" : `q < ${state.below.toFixed(2)}`;
    refresh();
  });
  $("cut").addEventListener("input", (e) => { state.cut = +e.target.value; refresh(); });
  $("flip").addEventListener("click", () => { state.flip = !state.flip; refresh(); });
  $("edges").addEventListener("change", (e) => { state.edges = e.target.checked; draw(); });
  $("reset").addEventListener("click", () => {
    Object.assign(camera, { zoom: 1, x: 0, y: 0, az: data.dim === 3 ? -0.95 : -Math.PI / 2, el: data.dim === 3 ? 0.5 : Math.PI / 2 });
    target = mesh.centre.slice();
    choose(-1);
  });
  document.querySelectorAll("[data-element]").forEach((row) => row.addEventListener("click", () => {
    choose(+row.dataset.element, true);
    $("stage").scrollIntoView({ block: "nearest", behavior: "smooth" });
  }));
  new ResizeObserver(draw).observe(canvas);
  refresh();
  document.body.dataset.ready = Math.round(performance.now());
}

if (gl) start();
else $("stage").innerHTML = "<p class='sorry'>This browser has no WebGL 2; the tables below hold all numbers.</p>";
