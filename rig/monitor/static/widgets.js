// Common parts of the views: text, elements, charts, the map of targets. Text of a lab is only ever set as text.

export const $ = (id) => document.getElementById(id);

export function text(id, value) {
  const node = typeof id === "string" ? $(id) : id;
  if (node.textContent !== value) node.textContent = value;
}

export function h(name, attributes, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "onclick") made.addEventListener("click", value);
    else if (value !== null && value !== false) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

const drawn = new WeakMap();

// Fills an element with what `build` makes of the content, if the content is another one than before.
export function fill(id, content, build) {
  const key = JSON.stringify(content);
  if (drawn.get($(id)) === key) return;
  drawn.set($(id), key);
  $(id).replaceChildren(...build(content));
}

export const tag = (name, kind) => h("span", { class: `tag ${kind}` }, name);

// A command to type at the bench: the page never starts an arm.
export function command(line) {
  const copy = () => navigator.clipboard?.writeText(line);
  return h("p", { class: "command" }, h("code", {}, line), h("button", { type: "button", class: "small", "aria-label": "copy the command", onclick: copy }, "Copy"));
}

// Shows an element over the whole window.
export function enlarge(content) {
  $("large-content").replaceChildren(content);
  $("large").showModal();
}
$("close").addEventListener("click", () => $("large").close());

const PHASES = {
  normal_inc: "pressing", shear_inc: "shearing", shear_dec: "shearing back", normal_dec: "releasing", "to point": "to the point",
};
const CLEAR = { normal_inc: "approaching", normal_dec: "lifting off" };

// What the arm does; above the surface nothing is pressed.
export const activity = (phase, depth) => (depth < 0 && CLEAR[phase]) || (PHASES[phase] ?? phase);

export function signed(value, digits = 2) {
  if (value === null || value === undefined) return "–";
  const shown = value.toFixed(digits);
  return Number(shown) === 0 ? shown.replace("-", "") : shown.replace("-", "−");
}

// Charts --------------------------------------------------------------------------------------------

// The colours of Fx, Fy and Fz, here and in the charts of files.
export const AXES = [["Fx", "--fx"], ["Fy", "--fy"], ["Fz", "--fz"]];
const LEFT = 46, RIGHT = 10, ABOVE = 18, BELOW = 22;

// Panels above one another with a common x axis. `content` is {from, to, ticks: [[x, text]], cursor, panels};
// a panel {curves, least, share, unit}, a curve {colour, name, points: [[x, low, high]], width, dash, band}.
// A null interrupts a curve, and so do points that are further apart than `gap`.
export class Chart {
  constructor(canvas, gap = Infinity) {
    this.canvas = canvas;
    this.gap = gap;
    this.content = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
    addEventListener("theme", () => this.draw());
  }

  show(content) {
    this.content = content;
    this.draw();
  }

  // Lines and letters grow with the letters of the page.
  unit() {
    return parseFloat(getComputedStyle(document.documentElement).fontSize) / 16;
  }

  // Returns the x of a place of the pointer.
  at(clientX) {
    const box = this.canvas.getBoundingClientRect(), unit = this.unit(), { from, to } = this.content;
    const fraction = (clientX - box.left - LEFT * unit) / (box.width - (LEFT + RIGHT) * unit);
    return from + Math.min(Math.max(fraction, 0), 1) * (to - from);
  }

  draw() {
    const { clientWidth, clientHeight } = this.canvas, scale = devicePixelRatio || 1, unit = this.unit();
    if (!this.content || !clientWidth || !clientHeight) return;
    const { from, to, ticks, cursor, panels } = this.content, width = clientWidth / unit, height = clientHeight / unit;
    this.canvas.width = Math.round(clientWidth * scale);
    this.canvas.height = Math.round(clientHeight * scale);
    const pen = this.canvas.getContext("2d"), style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name), x = (t) => LEFT + ((width - LEFT - RIGHT) * (t - from)) / (to - from || 1);
    pen.setTransform(scale * unit, 0, 0, scale * unit, 0, 0);
    pen.font = "13px system-ui, sans-serif";
    pen.lineJoin = "round";
    let top = 0;
    for (const panel of panels) {
      const bottom = top + (panel.share ?? 1 / panels.length) * (height - BELOW);
      this.panel(pen, colour, x, width, top + ABOVE, bottom, panel);
      top = bottom;
    }
    pen.fillStyle = colour("--muted");
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    for (const [t, name] of ticks) pen.fillText(name, Math.min(x(t), width - 22), height - 6);
    if (cursor === undefined) return;
    this.line(pen, colour("--current"), 1.5, [[x(cursor), ABOVE], [x(cursor), height - BELOW]]);
  }

  panel(pen, colour, x, width, top, bottom, { curves, least, unit }) {
    let low = -least, high = least;
    for (const { points } of curves) for (const [, a, b] of points) {
      if (a !== null && a < low) low = a;
      if (b !== null && b > high) high = b;
    }
    const pad = 0.06 * (high - low), y = (value) => top + ((high + pad - value) / (high - low + 2 * pad)) * (bottom - top);
    const step = niceStep(Math.max(20 / (bottom - top), 0.1) * (high - low)), digits = Math.max(0, -Math.floor(Math.log10(step)));
    pen.textBaseline = "middle";
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) {
      const level = Math.round(y(k * step)) + 0.5;
      this.line(pen, colour(k === 0 ? "--muted" : "--grid"), 1, [[LEFT, level], [width - RIGHT, level]]);
      pen.fillStyle = colour("--muted");
      pen.textAlign = "right";
      pen.fillText(signed(k * step, digits), LEFT - 8, level);
    }
    if (unit) pen.fillText(unit, LEFT - 8, top - 8);
    let start = LEFT;
    pen.textAlign = "left";
    for (const { colour: name, name: label, points, width: thick = 1.5, dash = [], band } of curves) {
      pen.fillStyle = colour(name);
      if (label && points.length) pen.fillText(label, start, top - 8);
      if (label && points.length) start += pen.measureText(label).width + 16;
      let run = [], before = -Infinity;
      const end = () => {
        if (band && run.length) this.fill(pen, run);
        else if (run.length) this.line(pen, colour(name), thick, run.flatMap(([at, a, b]) => (a === b ? [[at, a]] : [[at, a], [at, b]])), dash);
        run = [];
      };
      for (const [t, a, b] of points) {
        if (a === null || t - before > this.gap) end();
        if (a !== null) run.push([x(t), y(a), y(b)]);
        before = t;
      }
      end();
    }
  }

  line(pen, colour, width, places, dash = []) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    for (const place of places) pen.lineTo(...place);
    pen.stroke();
    pen.setLineDash([]);
  }

  fill(pen, run) {
    pen.globalAlpha = 0.2;
    pen.beginPath();
    for (const [at, low] of run) pen.lineTo(at, low);
    for (const [at, , high] of [...run].reverse()) pen.lineTo(at, high);
    pen.fill();
    pen.globalAlpha = 1;
  }
}

export function niceStep(rough) {
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= rough) ?? power;
}

// The last seconds of points whose first value is a time: the range and the ticks of a chart.
export function lastSeconds(points, seconds) {
  const to = points.at(-1)?.[0] ?? 0, backs = [...Array(Math.ceil(seconds / 5)).keys()].map((k) => 5 * k);
  const oldest = points.findIndex(([t]) => t >= to - seconds);
  if (oldest > 0) points.splice(0, oldest);
  return { from: to - seconds, to, ticks: backs.map((back) => [to - back, back ? `−${back} s` : "now"]) };
}

// Taxels row by row of the squarest grid: a disc for the normal force, a line for the shear.
export function taxels(canvas, values) {
  const pen = canvas.getContext("2d"), style = getComputedStyle(canvas);
  const disc = (u, v, radius, colour) => {
    pen.fillStyle = style.getPropertyValue(colour);
    pen.beginPath();
    pen.arc(u, v, radius, 0, 2 * Math.PI);
    pen.fill();
  };
  pen.setTransform(canvas.width / 640, 0, 0, canvas.height / 480, 0, 0);
  pen.clearRect(0, 0, 640, 480);
  let columns = Math.ceil(Math.sqrt(values.length));
  while (values.length % columns) columns += 1;
  const rows = values.length / columns, pitch = 460 / Math.max(rows, columns, 4), full = pitch / 2.3;
  values.forEach((axes, k) => {
    const [x, y] = axes.length > 1 ? axes : [0, 0], z = axes[axes.length - 1];
    const u = 320 + pitch * ((k % columns) - (columns - 1) / 2);
    const v = 240 + pitch * (Math.floor(k / columns) - (rows - 1) / 2);
    disc(u, v, full, "--open");
    disc(u, v, Math.min(full, Math.sqrt(Math.abs(z)) * 0.9), "--done");
    pen.strokeStyle = style.getPropertyValue("--limited");
    pen.lineWidth = 4;
    pen.beginPath();
    pen.moveTo(u, v);
    pen.lineTo(u + x / 40, v - y / 40);
    pen.stroke();
  });
}

// Map of targets ------------------------------------------------------------------------------------

const NAMES = { d: "done", l: "limited", ".": "open" };
const WORDS = { done: "done", limited: "force-limited", current: "under way", open: "open" };

// A rose per contact point, a ring per depth, a sector per shear direction.
// `onPick` gets the index of a target that a person chose; `marks` are outlined.
const GAP = 1.04;

export class TargetMap {
  constructor(svg, line) {
    this.svg = svg;
    this.line = line;
    this.cells = [];
    this.picked = -1;
    this.marks = new Set();
    this.onPick = null;
    svg.addEventListener("pointerover", (event) => this.onPick || this.pickCell(event.target));
    svg.addEventListener("pointerdown", (event) => this.pickCell(event.target));
    svg.addEventListener("keydown", (event) => this.onKey(event));
  }

  build(hello) {
    this.svg.replaceChildren();
    this.cells = hello.targets.map(() => null);
    this.targets = hello.targets;
    this.directions = hello.directions;
    this.picked = -1;
    const places = layout(hello.points.map((point) => point.at));
    hello.points.forEach(({ point }, k) => this.rose(point, places[k]));
  }

  rose(point, { x, y, r }) {
    const mine = this.targets.map((target, index) => ({ target, index })).filter((c) => c.target[0] === point);
    const depths = [...new Set(mine.map((c) => c.target[1]))].sort((a, b) => a - b);
    const core = r * 0.2;
    depths.forEach((depth, ring) => {
      const inner = core + ((r - core) * ring) / depths.length;
      const outer = core + ((r - core) * (ring + 1)) / depths.length;
      const row = mine.filter((c) => c.target[1] === depth);
      row.forEach(({ target, index }, k) => {
        const sheared = target[2] >= 0;
        const count = sheared ? this.directions : row.length;
        const middle = (2 * Math.PI * (sheared ? target[2] : k)) / count;
        const path = element("path", { d: sector(x, y, inner, outer, middle, (2 * Math.PI) / count) });
        path.dataset.index = index;
        path.append(element("title", {}));
        this.svg.append(path);
        this.cells[index] = path;
      });
    });
    const label = element("text", { x, y });
    label.textContent = point;
    this.svg.append(label);
  }

  show(outcomes, current) {
    const counts = { done: 0, limited: 0, open: 0 };
    this.cells.forEach((cell, index) => {
      const outcome = NAMES[outcomes[index]] ?? "open";
      counts[outcome] += 1;
      const name = index === current ? "current" : outcome;
      const shown = name + (index === this.picked ? " picked" : "") + (this.marks.has(index) ? " marked" : "");
      if (cell.dataset.is !== name || cell.getAttribute("class") !== shown) {
        cell.dataset.is = name;
        cell.setAttribute("class", shown);
        // Those drawn later would cover a part of its outline.
        if (shown !== name) this.svg.append(cell);
        cell.firstChild.textContent = this.text(index);
      }
    });
    if (this.picked >= 0) this.tell(this.text(this.picked));
    return counts;
  }

  text(index) {
    const [point, depth, direction] = this.targets[index];
    const angle = direction >= 0 ? `, ${Math.round((360 * direction) / this.directions)}°` : "";
    const state = WORDS[this.cells[index].dataset.is] ?? "open";
    const marked = this.marks.has(index) ? ", to record again" : "";
    return `Target ${index + 1}: point ${point}, ${depth.toFixed(2)} mm${angle}: ${state}${marked}`;
  }

  tell(text) {
    if (this.line.textContent !== text) this.line.textContent = text;
  }

  pickCell(target) {
    if (target.dataset?.index !== undefined) this.choose(Number(target.dataset.index));
  }

  choose(index) {
    this.pick(index);
    if (this.onPick) this.onPick(index);
  }

  pick(index) {
    this.cells[this.picked]?.classList.remove("picked");
    this.picked = index;
    this.cells[index].classList.add("picked");
    if (this.svg.lastChild !== this.cells[index]) this.svg.append(this.cells[index]);
    this.tell(this.text(index));
  }

  onKey(event) {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!step || !this.cells.length) return;
    event.preventDefault();
    this.choose((Math.max(this.picked, step > 0 ? -1 : 0) + step + this.cells.length) % this.cells.length);
  }
}

// Returns centres and a common radius, so that roses are arranged like the points and do not touch.
function layout(points) {
  if (points.length < 2) return points.map(() => ({ x: 50, y: 50, r: 46 }));
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  const size = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys));
  const unit = points.map(([x, y]) => [
    0.5 + (x - (Math.max(...xs) + Math.min(...xs)) / 2) / size,
    0.5 - (y - (Math.max(...ys) + Math.min(...ys)) / 2) / size,
  ]);
  let nearest = Infinity;
  unit.forEach((a, i) => unit.slice(i + 1).forEach((b) => {
    nearest = Math.min(nearest, Math.hypot(a[0] - b[0], a[1] - b[1]));
  }));
  const r = nearest / (2 * (GAP + nearest));
  return unit.map(([x, y]) => ({ x: 100 * (r + (1 - 2 * r) * x), y: 100 * (r + (1 - 2 * r) * y), r: 100 * r }));
}

function sector(x, y, inner, outer, middle, width) {
  if (width > 6.28) {
    const ring = (r, sweep) => `M${x + r},${y}A${r},${r} 0 1 ${sweep} ${x - r},${y}A${r},${r} 0 1 ${sweep} ${x + r},${y}Z`;
    return ring(outer, 0) + ring(inner, 1);
  }
  const at = (r, angle) => `${(x + r * Math.cos(angle)).toFixed(3)},${(y - r * Math.sin(angle)).toFixed(3)}`;
  const [a, b] = [middle - width / 2, middle + width / 2];
  const far = width > Math.PI ? 1 : 0;
  return `M${at(inner, a)}L${at(outer, a)}A${outer},${outer} 0 ${far} 0 ${at(outer, b)}` +
    `L${at(inner, b)}A${inner},${inner} 0 ${far} 1 ${at(inner, a)}Z`;
}

function element(name, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
