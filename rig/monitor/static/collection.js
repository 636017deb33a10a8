// A running collection: displays the server's messages and sends commands.

import { $, AXES, Chart, TargetMap, activity, command, enlarge, fill, h, lastSeconds, signed, taxels, text } from "./widgets.js";
import { connected, on, send } from "./wire.js";

const STATUS = {
  preparing: "Preparing", collecting: "Collecting", pausing: "Pausing", paused: "Paused", ending: "Ending",
  complete: "Complete", stopped: "Stopped", gone: "Gone",
};
const QUALITY = { good: "good", watch: "look", fault: "fault", unknown: "unknown" };
const ENDED = new Set(["complete", "stopped", "gone"]);
const NEXT = {
  complete: "To look at it:", gone: "What was recorded is kept. To make it readable:",
  stopped: "What was recorded is kept. To continue, clear the cause and type at the bench:",
};

const map = new TargetMap($("map"), $("cell"));
const first = new Chart($("traces"), 0.5);
let charts = {}, traces = {}, pictures = [], captions = {};
// Most lines of the log; the file beside the session has all.
const LOG = 2000;
let hello = null, state = null, asked = "";

function clock(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(Math.round(seconds), 0), hours = Math.floor(whole / 3600);
  const two = (n) => String(n).padStart(2, "0");
  const minutes = Math.floor((whole % 3600) / 60);
  return hours ? `${hours}:${two(minutes)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
}

export function lost() {
  buttons();
  if (state && ENDED.has(state.status)) return true;
  document.body.dataset.status = "lost";
  text("status", "No connection");
  text("phase", "");
  return false;
}

function ask(command) {
  if (!send({ command })) return;
  asked = command;
  buttons();
}

// Constant data -------------------------------------------------------------------------------------

export function begin(message) {
  hello = message;
  asked = "";
  text("what", `${hello.sensor} · ${hello.indenter} · ${hello.session}`);
  text("bench", hello.mock ? "MOCK BENCH" : "LAB BENCH");
  text("total", ` / ${hello.targets.length}`);
  $("bar").setAttribute("aria-valuemax", hello.targets.length);
  layOut();
  const sector = hello.directions > 1 ? "shear direction" : "repeat";
  text("map-note", `rose: contact point · ring: depth, deepest outside · sector: ${sector}`);
  $("log").textContent = "";
  map.build(hello);
  const { axes, ratings, soft, hard, box } = hello.limits;
  text("limits-note", `% of the rating; marks: soft limit ${percent(soft)}, hard ${percent(hard)}`);
  $("loads").replaceChildren(...axes.map((axis, k) => {
    const marks = [["soft", soft], ["hard", hard]].map(([name, fraction]) => {
      const made = h("div", { class: `mark ${name}` });
      made.style.left = `${(100 * Math.min(fraction / railEnd(), 1)).toFixed(1)}%`;
      return made;
    });
    // Each of the two columns has one scale, below its last axis.
    const ticks = k % 3 === 2 ? [0, 0.5, 1].map((fraction) => [fraction / railEnd(), `${100 * fraction}`]) : [];
    return gauge(axis, `${axis}: fraction of ${ratings[k]} ${k < 3 ? "N" : "N mm"}`, "fill", marks, ticks);
  }));
  $("box").replaceChildren(
    gauge("depth", `depth, allowed up to ${-box[2][0]} mm`, "fill", [], scale(0, -box[2][0])),
    gauge("x", `x, allowed ${box[0].join(" to ")} mm`, "dot", [], scale(...box[0])),
    gauge("y", `y, allowed ${box[1].join(" to ")} mm`, "dot", [], scale(...box[1])),
  );
}

// The first picture and the first plot stand large on the page, further ones small below them.
function layOut() {
  captions = {};
  $("more-images").textContent = "";
  $("more-traces").textContent = "";
  pictures = Object.entries(hello.pictures).map(([name, kind], k) => ({
    name, kind, busy: false, canvas: k ? figure($("more-images"), name, { width: 320, height: 240 }) : $("image"),
  }));
  $("image").parentElement.hidden = !pictures.length;
  text("h-image", pictures[0]?.kind === "taxels" ? "Taxels" : "Live image");
  charts = Object.fromEntries(hello.plots.map((name, k) => [name, k ? new Chart(figure($("more-traces"), name), 0.5) : first]));
  traces = Object.fromEntries(hello.plots.map((name) => [name, []]));
  $("traces").closest("section").hidden = !hello.plots.length;
}

function figure(parent, name, size) {
  const canvas = h("canvas", { role: "img", "aria-label": name, ...size });
  captions[name] = h("figcaption", {}, name);
  parent.append(h("figure", {}, size ? canvas : h("div", { class: "plot" }, canvas), captions[name]));
  return canvas;
}

const percent = (fraction) => `${Math.round(100 * fraction)} %`;
const railEnd = () => 1.05 * hello.limits.hard;

// A bar or a dot on a rail; `ticks` are fractions of the rail with their texts.
function gauge(name, label, part, marks = [], ticks = []) {
  const rail = h("div", { class: "rail", role: "meter", "aria-label": label }, h("div", { class: part }), ...marks);
  const row = h("div", { class: "gauge", title: label }, h("span", {}, name), rail, h("b", {}, "–"));
  if (ticks.length) row.append(h("div", { class: "scale", "aria-hidden": "true" }, ...ticks.map(([fraction, words]) => {
    const tick = h("span", {}, words);
    tick.style.left = `${100 * fraction}%`;
    return tick;
  })));
  return row;
}

const scale = (low, high) => [0, 0.25, 0.5, 0.75, 1].map((part) => [part, String(+(low + part * (high - low)).toFixed(2)).replace("-", "−")]);

function setGauge(row, fraction, value, level) {
  const part = row.children[1].firstChild;
  const place = `${(100 * Math.min(Math.max(fraction, 0), 1)).toFixed(1)}%`;
  part.style[part.className === "dot" ? "left" : "width"] = place;
  row.children[1].setAttribute("aria-valuenow", Math.round(100 * fraction));
  row.className = `gauge ${level}`;
  text(row.children[2], value);
}

// Changing data -----------------------------------------------------------------------------------

export function show(next) {
  state = next;
  const waiting = state.status === "collecting" && state.paused_by.length;
  const status = waiting ? "pausing" : state.status;
  document.body.dataset.status = status;
  const who = state.paused_by.length ? ` by ${state.paused_by.join(", ")}` : "";
  text("status", waiting ? "Pausing" : STATUS[status] + (status === "paused" ? who : ""));
  const tip = state.tips[hello.arms[0]];
  text("phase", status === "collecting" || status === "pausing" ? activity(state.phase, tip ? -tip[2] : 0) : "");
  ended(state);
  $("reason").hidden = !state.reason;
  text("target", state.target >= 0 ? String(state.target + 1) : "–");
  text("left", clock(state.left));
  const counts = map.show(state.outcomes, state.target);
  for (const name of ["done", "limited", "open"]) text(`n-${name}`, String(counts[name]));
  const behind = counts.done + counts.limited;
  $("bar").firstElementChild.style.width = `${(100 * behind) / hello.targets.length}%`;
  $("bar").setAttribute("aria-valuenow", behind);
  for (const [name, points] of Object.entries(state.traces)) trace(name, points);
  forces(state.forces);
  places(state.tips);
  quality(state.quality);
  streams(state.streams);
  for (const { name, canvas } of pictures) {
    if (!state.taxels[name]) continue;
    if (canvas === $("image")) $("image-waiting").hidden = true;
    taxels(canvas, state.taxels[name]);
  }
  log(state.log);
  if (asked === "pause" && who) asked = "";
  if (asked === "resume" && !state.paused_by.includes("page")) asked = "";
  buttons();
}

// After the end the page says what was kept, and the way on.
function ended({ status, command: line, reason }) {
  text("why", reason);
  fill("next", [status, line], () => line ? [h("span", {}, NEXT[status]), command(line)] : []);
  text("image-waiting", ENDED.has(status) ? "No image came before the end." : "The first image comes when recording begins.");
}

function trace(name, points) {
  if (!points.length && charts[name].content) return;
  traces[name].push(...points);
  const range = lastSeconds(traces[name], hello.seconds);
  const curves = AXES.map(([, colour], k) => ({ colour, width: 2, points: traces[name].map((point) => [point[0], point[k + 1], point[k + 1]]) }));
  charts[name].show({ ...range, panels: [{ curves, least: 0.1, unit: "N" }] });
}

function buttons() {
  const live = connected() && state && !ENDED.has(state.status);
  const running = live && ["collecting", "paused"].includes(state.status);
  const paused = Boolean(running && state.paused_by.includes("page"));
  text("pause", paused ? "Resume" : "Pause");
  $("pause").disabled = !running || asked !== "";
  $("abort").disabled = !running || asked === "abort";
  text("abort", running && asked === "abort" ? "Aborting" : "Abort…");
  if (!running && $("confirm").open) $("confirm").close();
}

function forces(gauges) {
  const force = gauges[hello.plots[0]];
  if (force) {
    AXES.forEach(([name], k) => text(`v-${name}`, signed(force.wrench[k])));
    text("fz", signed(force.wrench[2], 1));
  }
  for (const name of hello.plots.slice(1)) {
    const shown = gauges[name]?.wrench.slice(0, 3).map((value) => signed(value)).join(", ");
    text(captions[name], `${name}: ${shown ?? "–"} N`);
  }
  // The limits hold for every gauge that guards: the one nearest to them is shown.
  const known = Object.values(gauges), guards = known.filter((gauge) => gauge.guards);
  const loads = (guards.length ? guards : known).map((gauge) => gauge.load);
  if (!loads.length) return;
  const { soft, hard } = hello.limits;
  [...$("loads").children].forEach((row, k) => {
    const load = loads.some((each) => each[k] === null) ? null : Math.max(...loads.map((each) => each[k]));
    const level = load >= hard ? "over" : load >= soft ? "near" : "";
    setGauge(row, (load ?? 0) / railEnd(), load === null ? "–" : percent(load), level);
  });
}

function places(tips) {
  const further = hello.arms.slice(1).filter((name) => tips[name]);
  text("more-tips", further.map((name) => `${name}: ${tips[name].map((value) => signed(value, 1)).join(", ")} mm`).join(" · "));
  const tip = tips[hello.arms[0]];
  if (!tip) return;
  const [depth, ...sides] = $("box").children;
  const box = hello.limits.box, deep = Math.max(-tip[2], 0), most = -box[2][0];
  text("depth", deep > 0 ? deep.toFixed(2) : "0.00");
  setGauge(depth, deep / most, `${deep.toFixed(2)} mm`, deep > most ? "over" : deep > 0.95 * most ? "near" : "");
  sides.forEach((row, k) => {
    const [low, high] = box[k], fraction = (tip[k] - low) / (high - low);
    const level = fraction < 0 || fraction > 1 ? "over" : fraction < 0.05 || fraction > 0.95 ? "near" : "";
    setGauge(row, fraction, `${signed(tip[k], 1)} mm`, level);
  });
}

function quality(rows) {
  fill("quality", rows, () => rows.map(({ name, state, text: why }) =>
    h("li", {}, h("span", { class: `state ${state}` }, QUALITY[state]), h("p", {}, h("b", {}, name), " ", h("span", {}, why)))));
  const count = (wanted) => rows.filter(({ state }) => state === wanted).length;
  const counts = [["fault", "at fault"], ["watch", "to look at"], ["unknown", "unknown"]]
    .filter(([wanted]) => count(wanted)).map(([wanted, words]) => `${count(wanted)} ${words}`).join(", ");
  text("quality-all", counts || (rows.length ? "all good" : ""));
}

function streams(rows) {
  const over = ENDED.has(state.status) || state.status === "ending";
  const cells = Object.entries(rows).map(([name, { rate, expected, dropped, gap, age }]) => {
    const silent = age > 1000 && !over, slow = rate !== undefined && Math.abs(rate - expected) > 0.15 * expected && !over;
    return [
      ["", name], [silent || slow ? "wrong" : rate === undefined || over ? "" : "right", silent ? "silent" : rate === undefined ? "–" : `${rate.toFixed(0)} Hz`],
      ["", `${expected.toFixed(0)} Hz`], [dropped ? "wrong" : "", String(dropped ?? "–")], ["", gap ? `${gap.toFixed(0)} ms` : "–"],
    ];
  });
  fill("streams", cells, () => cells.map(([[, name], ...others]) =>
    h("tr", {}, h("th", { scope: "row" }, name), ...others.map(([kind, value]) => h("td", { class: kind }, value)))));
  const { watchers, refused } = state;
  text("watchers", `${watchers} watching${refused ? `, ${refused} refused` : ""} · running for ${clock(state.elapsed)}`);
}

function log(lines) {
  if (!lines.length) return;
  const box = $("log");
  const atEnd = box.scrollHeight - box.scrollTop - box.clientHeight < 30;
  const all = box.textContent.split("\n").filter(Boolean).concat(lines);
  box.textContent = all.slice(-LOG).join("\n");
  if (atEnd) box.scrollTop = box.scrollHeight;
}

// The first byte is the number of the picture, the rest its JPEG.
on("picture", async ({ data }) => {
  const shown = pictures[new Uint8Array(await data.slice(0, 1).arrayBuffer())[0]];
  if (!shown || shown.busy) return;
  shown.busy = true;
  try {
    const bitmap = await createImageBitmap(data.slice(1));
    const { name, canvas } = shown;
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
    }
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    canvas.dataset.shown = Number(canvas.dataset.shown ?? 0) + 1;
    const row = state?.images[name];
    if (captions[name]) text(captions[name], `${name}: image ${row}`);
    else {
      $("image-waiting").hidden = true;
      text("image-note", pictures.length > 1 ? `${name}: image ${row}` : `image ${row}`);
    }
  } finally {
    shown.busy = false;
  }
});

$("log-whole").addEventListener("click", () => enlarge(h("pre", {}, $("log").textContent)));
$("pause").addEventListener("click", () => ask(state.paused_by.includes("page") ? "resume" : "pause"));
$("abort").addEventListener("click", () => $("confirm").showModal());
$("go-on").addEventListener("click", () => $("confirm").close());
$("abort-now").addEventListener("click", () => {
  $("confirm").close();
  ask("abort");
});
