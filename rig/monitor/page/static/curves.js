// Force and depth over the frames of a session, with a line at the one that is shown.

import { niceStep } from "./traces.js";

const FORCES = [["fx", "--fx", "Fx"], ["fy", "--fy", "Fy"], ["fz", "--fz", "Fz"]];
const LEFT = 46, RIGHT = 10, ABOVE = 18, BELOW = 22;

export class Curves {
  constructor(canvas) {
    this.canvas = canvas;
    this.session = null;
    this.at = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
    addEventListener("theme", () => this.draw());
  }

  show(session) {
    this.session = session;
    this.draw();
  }

  seek(frame) {
    this.at = frame;
    this.draw();
  }

  // Returns the frame at a place of the pointer.
  frameAt(clientX) {
    const box = this.canvas.getBoundingClientRect(), unit = this.unit();
    const fraction = (clientX - box.left - LEFT * unit) / (box.width - (LEFT + RIGHT) * unit);
    return Math.round(Math.min(Math.max(fraction, 0), 1) * (this.session.frames - 1));
  }

  unit() {
    return parseFloat(getComputedStyle(document.documentElement).fontSize) / 16;
  }

  draw() {
    const { clientWidth, clientHeight } = this.canvas, scale = devicePixelRatio || 1, unit = this.unit();
    if (!this.session || !clientWidth || !clientHeight) return;
    const width = clientWidth / unit, height = clientHeight / unit;
    this.canvas.width = Math.round(clientWidth * scale);
    this.canvas.height = Math.round(clientHeight * scale);
    const pen = this.canvas.getContext("2d"), style = getComputedStyle(this.canvas);
    pen.setTransform(scale * unit, 0, 0, scale * unit, 0, 0);
    const x = (frame) => LEFT + ((width - LEFT - RIGHT) * frame) / Math.max(this.session.frames - 1, 1);
    const split = 0.56 * (height - BELOW);
    this.panel(pen, style, x, width, ABOVE, split, FORCES, 0.5);
    this.panel(pen, style, x, width, split + ABOVE, height - BELOW, [["depth", "--done", "depth"]], 0.1);
    this.frames(pen, style, x, height);
    pen.strokeStyle = style.getPropertyValue("--current");
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x(this.at), ABOVE);
    pen.lineTo(x(this.at), height - BELOW);
    pen.stroke();
  }

  panel(pen, style, x, width, top, bottom, curves, least) {
    const known = curves.map(([name]) => this.session.curves[name]);
    let low = -least, high = least;
    for (const curve of known) for (const [a, b] of curve) {
      if (a !== null && a < low) low = a;
      if (b !== null && b > high) high = b;
    }
    const pad = 0.06 * (high - low), y = (value) => top + ((high + pad - value) / (high - low + 2 * pad)) * (bottom - top);
    const step = niceStep((13 * (high - low)) / (bottom - top));
    pen.font = "13px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.lineWidth = 1;
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) {
      pen.strokeStyle = style.getPropertyValue(k === 0 ? "--muted" : "--grid");
      pen.beginPath();
      pen.moveTo(LEFT, Math.round(y(k * step)) + 0.5);
      pen.lineTo(width - RIGHT, Math.round(y(k * step)) + 0.5);
      pen.stroke();
      pen.fillStyle = style.getPropertyValue("--muted");
      pen.fillText((k * step).toFixed(step < 1 ? 1 : 0).replace("-", "−"), LEFT - 8, y(k * step));
    }
    pen.lineWidth = 1.5;
    pen.lineJoin = "round";
    curves.forEach(([, colour], k) => {
      pen.strokeStyle = style.getPropertyValue(colour);
      pen.beginPath();
      let down = false;
      known[k].forEach(([a, b], place) => {
        const at = x(this.session.curves.at[place]);
        if (a !== null) {
          if (down) pen.lineTo(at, y(a));
          else pen.moveTo(at, y(a));
          pen.lineTo(at, y(b));
        }
        down = a !== null;
      });
      pen.stroke();
    });
    pen.textAlign = "left";
    let place = LEFT;
    for (const [, colour, name] of curves) {
      pen.fillStyle = style.getPropertyValue(colour);
      pen.fillText(name, place, top - 8);
      place += 34;
    }
  }

  // Frames, not seconds: between targets there are none.
  frames(pen, style, x, height) {
    const { frames } = this.session, step = Math.max(niceStep(frames / 6), 1);
    pen.fillStyle = style.getPropertyValue("--muted");
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    for (let k = 0; k < frames * 0.97; k += step) pen.fillText(k ? String(k) : "frame", x(Math.max(k - 1, 0)), height - 6);
  }
}
