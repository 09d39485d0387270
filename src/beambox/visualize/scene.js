"use strict";
// The 3-D page: three.js draws; what is computed here (corners, hits, projections, unpacking) is plain and tested alone.

// Corners of a box in the order of beambox.geometry.corners_3d, joined bottom, top, uprights.
const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

function boxCorners([x, y, z, l, w, h, yaw]) {
  const cos = Math.cos(yaw), sin = Math.sin(yaw), corners = [];
  for (const up of [-1, 1]) {
    for (const [a, b] of [[1, 1], [-1, 1], [-1, -1], [1, -1]]) {
      const u = a * l / 2, v = b * w / 2;
      corners.push([x + cos * u - sin * v, y + sin * u + cos * v, z + up * h / 2]);
    }
  }
  return corners;
}

// Segments of a box: its edges, and a line from the top's middle to its front.
function boxLines(box) {
  const c = boxCorners(box), mean = (...rows) => [0, 1, 2].map((k) => rows.reduce((sum, row) => sum + row[k], 0) / rows.length);
  return [...EDGES.map(([a, b]) => [c[a], c[b]]), [mean(c[4], c[5], c[6], c[7]), mean(c[4], c[7])]];
}

// Distance along a ray (unit direction) to a box, or null; the box is taken a little larger, for fingers.
function boxHit([x, y, z, l, w, h, yaw], origin, direction, margin = 0.1) {
  const cos = Math.cos(yaw), sin = Math.sin(yaw);
  const turn = (p) => [cos * p[0] + sin * p[1], -sin * p[0] + cos * p[1], p[2]];
  const o = turn([origin[0] - x, origin[1] - y, origin[2] - z]), d = turn(direction);
  let near = 0, far = Infinity;
  for (const [k, size] of [l, w, h].entries()) {
    const half = size / 2 + margin;
    if (Math.abs(d[k]) < 1e-9) { if (Math.abs(o[k]) > half) return null; continue; }
    const a = (-half - o[k]) / d[k], b = (half - o[k]) / d[k];
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far ? near : null;
}

// Project a segment by a 3 x 4 matrix (rows), cut where it passes behind the camera; null where it lies wholly behind.
function projectSegment(matrix, start, end, nearest = 0.3) {
  const at = (p) => matrix.map((row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3]);
  let a = at(start), b = at(end);
  if (a[2] < nearest && b[2] < nearest) return null;
  const cut = (p, q) => p.map((value, k) => value + (q[k] - value) * (nearest - p[2]) / (q[2] - p[2]));
  if (a[2] < nearest) a = cut(a, b);
  if (b[2] < nearest) b = cut(b, a);
  return [a, b].map((p) => [p[0] / p[2], p[1] / p[2]]);
}

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Undo what beambox.visualize.scene packs: per axis, low bytes then high bytes of differences between neighbors.
async function unpackPoints(sweep) {
  const bytes = await inflate(sweep.xyz), size = sweep.size, xyz = new Float32Array(3 * size);
  for (let axis = 0; axis < 3; axis++) {
    const low = 2 * axis * size, high = low + size;
    for (let i = 0, value = 0; i < size; i++) {
      value = (value + bytes[low + i] + 256 * bytes[high + i]) << 16 >> 16;
      xyz[3 * i + axis] = value / 100;
    }
  }
  return { xyz, intensity: await inflate(sweep.intensity) };
}

// Spread values over 256 shades, without the two in a hundred at each end.
function shades(values) {
  const sorted = Float32Array.from(values).sort(), at = (q) => sorted[Math.round(q * (sorted.length - 1))] || 0;
  const low = at(0.02), span = Math.max(at(0.98) - low, 1e-3);
  return Uint8Array.from(values, (value) => Math.max(0, Math.min(255, 255 * (value - low) / span)));
}

function pointsInside([x, y, z, l, w, h, yaw], xyz) {
  const cos = Math.cos(yaw), sin = Math.sin(yaw);
  let count = 0;
  for (let i = 0; i < xyz.length; i += 3) {
    const dx = xyz[i] - x, dy = xyz[i + 1] - y;
    if (Math.abs(cos * dx + sin * dy) <= l / 2 && Math.abs(-sin * dx + cos * dy) <= w / 2 && Math.abs(xyz[i + 2] - z) <= h / 2) count++;
  }
  return count;
}

const VERTEX = `
  attribute vec3 tint; varying vec3 shade; uniform float size, least;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = clamp(size / -seen.z, least, 5.0 * least);
    shade = tint;
  }`;
const FRAGMENT = "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }";
const VIEWS = { behind: [[-14, 0, 11], [12, 0, -1]], above: [[20, 0, 75], [20.01, 0, 0]] };

class Viewer {
  constructor(data) {
    this.data = data;
    this.sweep = 0;
    this.byIntensity = false;
    this.chosen = null;
    this.hidden = new Set();
    this.cache = new Map();
    this.at = (id) => document.getElementById(id);
    this.renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    this.renderer.setClearColor(0x0b0e14);
    this.at("view").append(this.renderer.domElement);
    this.scene = new THREE.Scene();
    this.eye = new THREE.PerspectiveCamera(55, 1, 0.3, 800);
    this.eye.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.eye, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.redraw());
    this.material = new THREE.ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: { size: { value: 1 }, least: { value: 1 } } });
    this.lines = { found: this.lineMaterial(2.2), truth: this.lineMaterial(1.6, data.both), chosen: this.lineMaterial(4) };
    this.scene.add(this.rings());
    this.look("behind");
    this.connect();
  }

  lineMaterial(width, dashed = false) {
    return new THREE.LineMaterial({ linewidth: width, vertexColors: true, dashed, dashSize: 0.35, gapSize: 0.25 });
  }

  rings() {
    const at = [];
    for (let r = 10; r <= 80; r += 10) {
      for (let k = 0; k < 128; k++) for (const end of [k, k + 1]) at.push(r * Math.cos(end * Math.PI / 64), r * Math.sin(end * Math.PI / 64), this.data.ground);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(at), 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: 0x2a3344 }));
  }

  look(name) {
    const [from, to] = VIEWS[name];
    this.eye.position.set(...from);
    this.controls.target.set(...to);
    this.controls.update();
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 3);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(innerWidth, innerHeight, false);
    this.eye.aspect = innerWidth / innerHeight;
    this.eye.updateProjectionMatrix();
    this.material.uniforms.size.value = 0.055 * ratio * innerHeight;
    this.material.uniforms.least.value = Math.max(1.2, ratio);
    for (const line of Object.values(this.lines)) line.resolution.set(innerWidth, innerHeight);
    this.redraw();
  }

  boxes() {
    const least = Number(this.at("score").value), { classes, sweeps } = this.data;
    return sweeps[this.sweep].boxes.filter((box) => !this.hidden.has(box.truth ? "truth" : classes[box.kind].name) && (box.truth || box.score >= least));
  }

  colourOf(box) { return box.truth ? this.data.truth : this.data.classes[box.kind].colour; }

  async go(number) {
    this.sweep = number;
    this.chosen = null;
    const sweep = this.data.sweeps[number];
    if (!this.cache.has(number)) {
      if (this.cache.size > 12) this.cache.delete(this.cache.keys().next().value);
      this.cache.set(number, await unpackPoints(sweep));
    }
    if (this.sweep !== number) return;
    this.points = this.cache.get(number);
    if (this.cloud) { this.scene.remove(this.cloud); this.cloud.geometry.dispose(); }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.points.xyz, 3));
    this.cloud = new THREE.Points(geometry, this.material);
    this.cloud.frustumCulled = false;
    this.scene.add(this.cloud);
    this.paint();
    this.at("counts").textContent = sweep.counts;
    this.at("sweep").value = number;
    this.at("sweep-name").textContent = `${number + 1} / ${this.data.sweeps.length}  ${sweep.name}`;
    await this.showPicture();
    this.update();
    document.body.dataset.sweep = String(number);
  }

  paint() {
    const { xyz, intensity } = this.points, colours = this.data.colours;
    const shade = this.byIntensity ? intensity : shades(xyz.filter((_, i) => i % 3 === 2)), tint = new Uint8Array(xyz.length);
    for (let i = 0; i < shade.length; i++) tint.set(colours[shade[i]], 3 * i);
    this.cloud.geometry.setAttribute("tint", new THREE.BufferAttribute(tint, 3, true));
    this.at("colour").textContent = this.byIntensity ? "Intensity" : "Height";
    this.redraw();
  }

  // Boxes anew: after another sweep, another score, another choice.
  update() {
    for (const old of this.drawn || []) { this.scene.remove(old); old.geometry.dispose(); }
    const boxes = this.boxes(), of = { found: boxes.filter((b) => !b.truth), truth: boxes.filter((b) => b.truth), chosen: boxes.filter((b) => b === this.chosen) };
    this.drawn = [];
    for (const [kind, some] of Object.entries(of)) {
      if (!some.length) continue;
      const at = [], tint = [];
      for (const box of some) for (const ends of boxLines(box.box)) for (const end of ends) {
        at.push(...end);
        const strength = kind === "found" ? Math.min(1, 0.35 + box.score) : 1;
        tint.push(...(kind === "chosen" ? [1, 1, 1] : this.colourOf(box).map((value) => strength * value / 255)));
      }
      const geometry = new THREE.LineSegmentsGeometry();
      geometry.setPositions(at);
      geometry.setColors(tint);
      const lines = new THREE.LineSegments2(geometry, this.lines[kind]);
      lines.computeLineDistances();
      this.drawn.push(lines);
      this.scene.add(lines);
    }
    this.at("labels").replaceChildren(...(this.unnamed ? [] : boxes.filter((b) => !b.truth || !this.data.both).sort((a, b) => (b.score || 0) - (a.score || 0)).slice(0, 150)).map((box) => this.nameTag(box)));
    this.at("score-value").textContent = Number(this.at("score").value).toFixed(2);
    this.showChosen();
    this.drawPicture(boxes);
    document.body.dataset.boxes = String(boxes.length);
    this.redraw();
  }

  nameTag(box) {
    const tag = document.createElement("span"), name = this.data.classes[box.kind].name;
    tag.textContent = (box.truth ? name : `${name} ${box.score.toFixed(2)}`) + (box.track === undefined ? "" : ` #${box.track}`);
    tag.style.color = `rgb(${this.colorOf(box)})`;
    tag.place = new THREE.Vector3(box.box[0], box.box[1], box.box[2] + box.box[5] / 2);
    return tag;
  }

  showChosen() {
    const panel = this.at("chosen"), box = this.chosen;
    panel.hidden = !box || !this.boxes().includes(box);
    if (panel.hidden) return;
    const [x, y, z, l, w, h, yaw] = box.box, metres = (value) => `${value.toFixed(2)} m`;
    const rows = [["x", metres(x)], ["y", metres(y)], ["z", metres(z)], ["length", metres(l)], ["width", metres(w)], ["height", metres(h)],
      ["yaw", `${(yaw * 180 / Math.PI).toFixed(1)}°`], ["distance", metres(Math.hypot(x, y))], ["points shown inside", String(pointsInside(box.box, this.points.xyz))]];
    if (!box.truth) rows.unshift(["score", box.score.toFixed(3)]);
    if (box.track !== undefined) rows.unshift(["track", String(box.track)]);
    panel.firstElementChild.textContent = this.data.classes[box.kind].name + (box.truth ? " (ground truth)" : "");
    panel.lastElementChild.replaceChildren(...rows.flatMap(([key, value]) => [["dt", key], ["dd", value]]).map(([kind, text]) => Object.assign(document.createElement(kind), { textContent: text })));
  }

  async showPicture() {
    const camera = this.data.sweeps[this.sweep].camera;
    this.picture = null;
    this.at("camera").hidden = !camera || this.pictureOff;
    this.at("picture").hidden = !this.data.sweeps.some((sweep) => sweep.camera);
    if (!camera) return;
    const picture = new Image();
    picture.src = camera.url;
    await picture.decode();
    this.picture = picture;
  }

  drawPicture(boxes) {
    if (!this.picture) return;
    const camera = this.data.sweeps[this.sweep].camera, canvas = this.at("camera").firstElementChild, context = canvas.getContext("2d");
    canvas.width = this.picture.width;
    canvas.height = this.picture.height;
    context.drawImage(this.picture, 0, 0);
    for (const box of boxes) {
      context.strokeStyle = box === this.chosen ? "#fff" : `rgb(${this.colorOf(box)})`;
      context.lineWidth = box === this.chosen ? 3 : 1.5;
      context.setLineDash(box.truth && this.data.both ? [5, 4] : []);
      context.beginPath();
      for (const [start, end] of boxLines(box.box)) {
        const ends = projectSegment(camera.matrix, start, end);
        if (ends && Math.max(...ends.flat().map(Math.abs)) < 6 * canvas.width) { context.moveTo(...ends[0]); context.lineTo(...ends[1]); }
      }
      context.stroke();
    }
  }

  pick(clientX, clientY) {
    const area = this.renderer.domElement.getBoundingClientRect();
    const at = new THREE.Vector3(2 * (clientX - area.left) / area.width - 1, 1 - 2 * (clientY - area.top) / area.height, 0.5).unproject(this.eye);
    const from = this.eye.position, direction = at.sub(from).normalize();
    const hits = this.boxes().map((box) => [boxHit(box.box, from.toArray(), direction.toArray()), box]).filter(([hit]) => hit !== null);
    hits.sort((a, b) => a[0] - b[0] || a[1].truth - b[1].truth);
    this.chosen = hits.length ? hits[0][1] : null;
    this.update();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  draw() {
    this.renderer.render(this.scene, this.eye);
    const taken = [];  // the surest first; a name without room is left out
    for (const tag of this.at("labels").children) {
      const at = tag.place.clone().project(this.eye), u = (at.x + 1) / 2 * innerWidth, v = (1 - at.y) / 2 * innerHeight;
      const half = 3.6 * tag.textContent.length, free = !taken.some(([a, b, c]) => Math.abs(u - a) < half + c && Math.abs(v - b) < 17);
      const shown = Math.abs(at.x) < 1 && Math.abs(at.y) < 1 && at.z < 1 && free;
      if (shown) taken.push([u, v, half]);
      tag.style.display = shown ? "" : "none";
      tag.style.left = `${u}px`;
      tag.style.top = `${v}px`;
    }
    document.body.dataset.drawn = String(Number(document.body.dataset.drawn || 0) + 1);
  }

  play() {
    this.playing = this.playing ? clearInterval(this.playing) : setInterval(() => this.go((this.sweep + 1) % this.data.sweeps.length), this.data.period);
    this.at("play").textContent = this.playing ? "Pause" : "Play";
  }

  legend() {
    const found = this.data.classes.filter((_, kind) => this.data.sweeps.some((sweep) => sweep.boxes.some((box) => !box.truth && box.kind === kind)));
    const entries = found.map(({ name, colour }) => [name, name, colour, false]);
    if (this.data.sweeps.some((sweep) => sweep.boxes.some((box) => box.truth))) entries.push(["truth", "ground truth", this.data.truth, this.data.both]);
    for (const [key, words, colour, dashed] of entries) {
      const line = document.createElement("label"), tick = document.createElement("input"), swatch = document.createElement("span");
      Object.assign(tick, { type: "checkbox", checked: true });
      tick.addEventListener("change", () => { this.hidden[tick.checked ? "delete" : "add"](key); this.update(); });
      swatch.className = dashed ? "swatch dashed" : "swatch";
      swatch.style.borderColor = `rgb(${colour})`;
      line.append(tick, swatch, words);
      this.at("legend").append(line);
    }
  }

  connect() {
    const canvas = this.renderer.domElement, count = this.data.sweeps.length, step = (by) => this.go((this.sweep + by + count) % count);
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; });
    canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5) this.pick(event.clientX, event.clientY);
      down = null;
    });
    const actions = {
      behind: () => this.look("behind"), above: () => this.look("above"), colour: () => { this.byIntensity = !this.byIntensity; this.paint(); },
      names: () => { this.unnamed = !this.unnamed; this.update(); },
      picture: () => { this.pictureOff = !this.pictureOff; this.at("camera").hidden = this.pictureOff || !this.picture; }, play: () => this.play(),
    };
    for (const [id, action] of Object.entries(actions)) this.at(id).addEventListener("click", action);
    this.at("score").addEventListener("input", () => this.update());
    this.at("sweep").addEventListener("input", (event) => this.go(Number(event.target.value)));
    const keys = { r: "behind", t: "above", c: "colour", l: "names", p: "picture", " ": "play" };
    addEventListener("keydown", (event) => {
      if (event.target.tagName === "INPUT" && event.key.startsWith("Arrow")) return;
      if (event.key === "ArrowRight" || event.key === "ArrowLeft") step(event.key === "ArrowRight" ? 1 : -1);
      else if (keys[event.key.toLowerCase()] && event.target.tagName !== "BUTTON" && !event.ctrlKey && !event.metaKey) actions[keys[event.key.toLowerCase()]]();
    });
    addEventListener("resize", () => this.resize());
    this.at("score-row").hidden = !this.data.sweeps.some((sweep) => sweep.boxes.some((box) => !box.truth));
    this.at("score").value = this.data.score;
    this.at("sweep").max = count - 1;
    this.at("time").hidden = count < 2;
    document.body.classList.toggle("timed", count > 1);
    this.legend();
  }
}

async function start() {
  const data = JSON.parse(document.getElementById("data").textContent);
  data.both = data.sweeps.some((s) => s.boxes.some((b) => b.truth)) && data.sweeps.some((s) => s.boxes.some((b) => !b.truth));
  try {
    const viewer = new Viewer(data);
    viewer.resize();
    await viewer.go(0);
    document.body.dataset.ready = "yes";
  } catch (error) {
    document.getElementById("fault").textContent = `This page needs a browser with WebGL, of 2023 or later (${error.message})`;
  }
}

if (typeof document !== "undefined") start();
