// The map of targets: a rose per contact point, a ring per depth, a sector per shear direction.
// `onPick` gets the index of a target that a person chose; `marks` are outlined.

const NAMES = { d: "done", l: "limited", ".": "open" };
const WORDS = { done: "done", limited: "force-limited", current: "under way", open: "open" };
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
