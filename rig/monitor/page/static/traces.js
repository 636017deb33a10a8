// Force traces on a canvas: the last seconds, newest at the right.

const AXES = ["--fx", "--fy", "--fz"];
const MARGIN = { left: 46, right: 10, top: 10, bottom: 22 };

export class Traces {
  constructor(canvas) {
    this.canvas = canvas;
    this.points = [];
    this.seconds = 20;
    new ResizeObserver(() => this.draw()).observe(canvas);
    addEventListener("theme", () => this.draw());
  }

  clear(seconds) {
    this.points = [];
    this.seconds = seconds;
  }

  add(points) {
    if (!points.length) return;
    this.points.push(...points);
    const oldest = this.points.at(-1)[0] - this.seconds;
    const keep = this.points.findIndex((point) => point[0] >= oldest);
    if (keep > 0) this.points.splice(0, keep);
    this.draw();
  }

  draw() {
    const scale = devicePixelRatio || 1;
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    // Lines and letters grow with the letters of the page.
    const unit = parseFloat(getComputedStyle(document.documentElement).fontSize) / 16;
    const width = clientWidth / unit, height = clientHeight / unit;
    if (this.canvas.width !== Math.round(clientWidth * scale) || this.canvas.height !== Math.round(clientHeight * scale)) {
      this.canvas.width = Math.round(clientWidth * scale);
      this.canvas.height = Math.round(clientHeight * scale);
    }
    const pen = this.canvas.getContext("2d");
    const style = getComputedStyle(this.canvas);
    pen.setTransform(scale * unit, 0, 0, scale * unit, 0, 0);
    pen.clearRect(0, 0, width, height);
    const values = this.points.flatMap((point) => point.slice(1)).filter((value) => value !== null);
    const low = Math.min(-0.5, ...values), high = Math.max(0.5, ...values);
    const pad = 0.06 * (high - low);
    const end = this.points.length ? this.points.at(-1)[0] : 0;
    const x = (t) => MARGIN.left + (width - MARGIN.left - MARGIN.right) * (1 - (end - t) / this.seconds);
    const y = (f) => MARGIN.top + ((high + pad - f) / (high - low + 2 * pad)) * (height - MARGIN.top - MARGIN.bottom);
    this.grid(pen, style, { width, height, low, high, x, y, end });
    pen.lineJoin = "round";
    pen.lineWidth = 2;
    AXES.forEach((name, axis) => {
      pen.strokeStyle = style.getPropertyValue(name);
      pen.beginPath();
      let down = false, before = -Infinity;
      for (const point of this.points) {
        const value = point[axis + 1];
        const joined = down && value !== null && point[0] - before < 0.5;
        if (value !== null) joined ? pen.lineTo(x(point[0]), y(value)) : pen.moveTo(x(point[0]), y(value));
        down = value !== null;
        before = point[0];
      }
      pen.stroke();
    });
  }

  grid(pen, style, { width, height, low, high, x, y, end }) {
    const step = niceStep((high - low) / 6);
    pen.font = "13px system-ui, sans-serif";
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) {
      const line = Math.round(y(k * step)) + 0.5;
      pen.strokeStyle = style.getPropertyValue(k === 0 ? "--muted" : "--grid");
      pen.beginPath();
      pen.moveTo(MARGIN.left, line);
      pen.lineTo(width - MARGIN.right, line);
      pen.stroke();
      pen.fillStyle = style.getPropertyValue("--muted");
      pen.fillText((k * step).toFixed(step < 1 ? 1 : 0).replace("-", "−"), MARGIN.left - 8, line);
    }
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    for (let back = 0; back < this.seconds; back += 5) {
      pen.fillText(back ? `−${back} s` : "now", Math.min(x(end - back), width - 22), height - 6);
    }
  }
}

export function niceStep(rough) {
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= rough) ?? power;
}
