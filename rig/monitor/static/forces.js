// Forces that models predict of one or more sensors, with intervals, beside those of the gauge and of
// another model.

import { $, AXES, Chart, h, lastSeconds, signed, text } from "./widgets.js";

const STATUS = { watching: "Watching", complete: "Ended", gone: "Gone" };
const SLIP = { gross: "the object slides", incipient: "its rim begins to slide" };
let hello = null, state = null, sensors = [];

class Sensor {
  constructor(of) {
    const node = $("f-sensor").content.cloneNode(true);
    this.parts = Object.fromEntries([...node.querySelectorAll("[data-f]")].map((part) => [part.dataset.f, part]));
    this.points = [];
    const { what, source, model, warnings, chart } = this.parts;
    text(what, of.name ? `${of.name}: ${of.sensor}` : of.sensor);
    text(source, of.source);
    text(model, `model ${of.model}`);
    warnings.replaceChildren(...of.warnings.map((line) => h("p", {}, line)));
    warnings.hidden = !of.warnings.length;
    $("forces").append(node);
    this.chart = new Chart(chart, 0.5);
  }

  show(status, news) {
    const { parts } = this;
    text(parts.status, STATUS[status]);
    // The last forces replace all others, with those that are only known at the end.
    if (status !== "watching" && news.length) this.points = [];
    this.points.push(...news);
    const { points } = this, range = lastSeconds(points, hello.seconds), newest = points.at(-1);
    if (!newest) return;
    const [, force, , , before, gauge, latency, contact, outside, slip] = newest;
    AXES.forEach(([name], k) => text(parts[name], signed(force[k])));
    text(parts.latency, latency.toFixed(1));
    text(parts.contact, SLIP[slip] ?? (outside ? "outside of what was learned" : contact ? "contact" : "no contact"));
    parts.contact.className = outside || slip === "gross" ? "wrong" : "";
    const beside = [["other model", before], ["gauge", gauge]].filter(([, each]) => each);
    text(parts.beside, [...(newest[2] ? ["band: 90 % interval"] : []),
      ...beside.map(([name, each]) => `${name} ${each.map((value) => signed(value)).join(", ")} N`)].join(" · "));
    const curve = (k, low, high = low) => points.map((point) => [point[0], point[low]?.[k] ?? null, point[high]?.[k] ?? null]);
    this.chart.show({ ...range, panels: AXES.map(([name, colour], k) => ({ least: 0.5, unit: "N", curves: [
      { colour, band: true, points: curve(k, 2, 3) },
      { colour: "--muted", name: "other model", dash: [5, 4], points: before ? curve(k, 4) : [] },
      { colour: "--text", name: "gauge", width: 2.5, points: points.some((point) => point[5]) ? curve(k, 5) : [] },
      { colour, name, width: 2, points: curve(k, 1) },
    ] })) });
  }
}

export function begin(message) {
  hello = message;
  $("forces").replaceChildren();
  sensors = hello.sensors.map((of) => new Sensor(of));
}

export function show(next) {
  state = next;
  document.body.dataset.status = state.status;
  sensors.forEach((sensor, number) => sensor.show(state.status, state.points[number]));
}

export const lost = () => {
  if (state && state.status !== "watching") return true;
  document.body.dataset.status = "lost";
  for (const { parts } of sensors) text(parts.status, "No connection");
  return false;
};
