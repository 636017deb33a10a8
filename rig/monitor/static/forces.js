// Forces that a model predicts, with intervals, beside those of the gauge and of another model.

import { $, AXES, Chart, fill, h, lastSeconds, signed, text } from "./widgets.js";

const STATUS = { watching: "Watching", complete: "Ended", gone: "Gone" };
const chart = new Chart($("f-chart"), 0.5);
let hello = null, state = null, points = [];

export function begin(message) {
  hello = message;
  points = [];
  text("f-what", hello.sensor);
  text("f-source", hello.source);
  text("f-model", `model ${hello.model}`);
  fill("f-warnings", hello.warnings, (lines) => lines.map((line) => h("p", {}, line)));
  $("f-warnings").hidden = !hello.warnings.length;
}

export function show(next) {
  state = next;
  document.body.dataset.status = state.status;
  text("f-status", STATUS[state.status]);
  // The last forces replace all others, with those that are only known at the end.
  if (state.status !== "watching" && state.points.length) points = [];
  points.push(...state.points);
  const range = lastSeconds(points, hello.seconds), newest = points.at(-1);
  if (!newest) return;
  const [, force, , , before, gauge, latency, contact, outside] = newest;
  AXES.forEach(([name], k) => text(`f-${name}`, signed(force[k])));
  text("f-latency", latency.toFixed(1));
  text("f-contact", outside ? "outside of what was learned" : contact ? "contact" : "no contact");
  $("f-contact").className = outside ? "wrong" : "";
  const beside = [["other model", before], ["gauge", gauge]].filter(([, each]) => each);
  text("f-beside", [...(newest[2] ? ["band: 90 % interval"] : []),
    ...beside.map(([name, each]) => `${name} ${each.map((value) => signed(value)).join(", ")} N`)].join(" · "));
  const curve = (k, low, high = low) => points.map((point) => [point[0], point[low]?.[k] ?? null, point[high]?.[k] ?? null]);
  chart.show({ ...range, panels: AXES.map(([name, colour], k) => ({ least: 0.5, unit: "N", curves: [
    { colour, band: true, points: curve(k, 2, 3) },
    { colour: "--muted", name: "other model", dash: [5, 4], points: before ? curve(k, 4) : [] },
    { colour: "--text", name: "gauge", width: 2.5, points: points.some((point) => point[5]) ? curve(k, 5) : [] },
    { colour, name, width: 2, points: curve(k, 1) },
  ] })) });
}

export const lost = () => {
  if (state && state.status !== "watching") return true;
  document.body.dataset.status = "lost";
  text("f-status", "No connection");
  return false;
};
