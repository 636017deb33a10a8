// Finished sessions: search, and one of them a frame at a time, with marks for recording again.

import { $, AXES, Chart, TargetMap, activity, command, fill, h, niceStep, signed, tag, taxels, text } from "./widgets.js";
import { get, on, send, url } from "./wire.js";

// Search --------------------------------------------------------------------------------------------

const day = (utc) => utc.slice(0, 16).replace("T", " ");

export async function list() {
  const query = { text: $("q-text").value, faults: $("q-faults").value, since: $("q-since").value };
  for (const key of ["sensor", "indenter", "status"]) query[key] = $(`q-${key}`).value;
  const answer = await get(url("sessions", query));
  for (const key of ["sensor", "indenter", "status"]) {
    choices($(`q-${key}`), [["", `every ${key}`], ...answer.choices[key].map((name) => [name, name])]);
  }
  const more = answer.found > answer.rows.length ? `, the newest ${answer.rows.length} are shown` : "";
  text("found", answer.total ? `${answer.found} of ${answer.total} sessions${more}` : "No session yet: record one with tactile collect.");
  fill("list", answer.rows, (rows) => rows.map(entry));
}

function choices(select, wanted) {
  if (select.options.length === wanted.length && wanted.every(([value], k) => select.options[k].value === value)) return;
  const before = select.value;
  select.replaceChildren(...wanted.map(([value, name]) => h("option", { value }, name)));
  select.value = wanted.some(([value]) => value === before) ? before : "";
}

function entry(row) {
  const finished = !["recording", "unreadable"].includes(row.status);
  const picture = finished ? thumbnail(row.path) : h("span", { class: "picture" });
  const about = [row.sensor, row.indenter, row.targets ? `${row.targets} targets` : "", row.operator, day(row.started_utc)];
  const tags = row.faults.length ? row.faults.map((fault) => tag(fault, fault === "recording" ? "warn" : "bad")) : [tag(row.status, "good")];
  if (row.mock) tags.push(tag("mock", ""));
  if (row.findings === null && finished) tags.push(tag("not checked", ""));
  return h("li", {}, h("a", { href: `#session/${encodeURIComponent(row.path)}` }, picture,
    h("span", {}, h("b", {}, row.path), h("span", { class: "note" }, about.filter(Boolean).join(" · ")), h("span", { class: "tags" }, ...tags))));
}

export const thumbnail = (path) => h("img", { class: "picture", alt: "", loading: "lazy", width: 248, height: 186, src: url("thumbnail", { session: path }) });

export function onSearch(refresh) {
  let typing = null;
  $("search").addEventListener("submit", (event) => event.preventDefault());
  $("search").addEventListener("input", () => {
    clearTimeout(typing);
    typing = setTimeout(refresh, 200);
  });
}

// Replay --------------------------------------------------------------------------------------------

// Returns values and pictures of a frame.
async function load(at) {
  const answer = await get(url("frame", { session: path, frame: at }));
  const pictures = await Promise.all(views.map(async ({ camera }) => {
    if (!(answer.images[camera] >= 0)) return null;
    const node = h("img", { alt: `image of ${camera}`, src: url("image", { session: path, frame: at, camera }) });
    return node.decode().then(() => node, () => null);
  }));
  return { answer, pictures };
}

// As `load`; the frame that is likely to be the next one is asked for ahead.
function loaded(at) {
  if (ahead.at !== at || ahead.of !== session) ahead = { at, of: session, ready: load(at) };
  ahead.ready.catch(() => {});
  return ahead.ready;
}

const map = new TargetMap($("r-map"), $("r-cell"));
const chart = new Chart($("curves"));
let session = null, path = "", frame = 0, wanted = 0, busy = false, timer = null, views = [], ahead = {};
// What the chart and the slider show: all frames or those of one press, first and last, and their curves.
let range = [0, 0], curves = null, zoomed = false;

export async function open(name) {
  stop();
  path = name;
  session = null;
  text("s-name", name);
  text("s-about", "");
  $("s-error").hidden = true;
  $("replay").hidden = true;
  $("values").replaceChildren();
  text("place", "");
  delete $("view").dataset.frame;
  curves = null;
  zoom(false);
  let answer;
  try {
    answer = await get(url("session", { session: name }));
  } catch (error) {
    text("s-error", error.message);
    $("s-error").hidden = false;
    return;
  }
  if (path !== name) return;
  session = answer;
  const faults = session.faults.length ? session.faults.map((fault) => tag(fault, "bad")) : [tag("complete", "good")];
  const day = session.started_utc.slice(0, 16).replace("T", " ");
  const about = [session.sensor, session.indenter, session.operator, day && `${day} UTC`, `${session.frames} frames at ${session.rate} Hz`, session.reason];
  $("s-about").replaceChildren(about.filter(Boolean).join(" · "), " ", ...faults, ...(session.mock ? [" ", tag("mock", "warn")] : []));
  $("replay").hidden = false;
  views = [...session.cameras.map((camera) => ({ camera, node: h("img", { alt: `image of ${camera}` }) })), ...(session.taxels ? [{ node: h("canvas", { width: 640, height: 480, role: "img", "aria-label": "taxels" }) }] : [])];
  $("pictures").replaceChildren(...views.map((view) => view.node));
  $("pictures").hidden = !views.length;
  $("r-streams").replaceChildren(...session.streams.map((row) => h("tr", {},
    h("th", { scope: "row" }, row.name), h("td", {}, row.rows.toLocaleString("en")), h("td", {}, `${row.rate} Hz`),
    h("td", { class: row.dropped ? "wrong" : "" }, String(row.dropped)))));
  const dropped = session.streams.filter((row) => row.dropped).map((row) => `${row.name} dropped ${row.dropped}`);
  text("dropped", dropped.join(", ") || "no drop noticed while recording");
  $("dropped").className = dropped.length ? "wrong" : "note";
  map.build({ targets: session.map, points: session.points, directions: session.directions });
  map.marks = new Set(session.again.map((target) => target - 1));
  marks(session);
  fill("continue", [session.path, session.go_on], () => session.go_on ? [h("h2", {}, "Continue"),
    h("p", { class: "note" }, "The session was stopped; what it lacks is recorded into it. Type this at the bench:"), command(session.go_on)] : []);
  if (!session.frames) return;
  seek(session.presses[0]?.[0] ?? 0);
}

// Shows the frames from first to last in the chart and the slider.
async function focus(next) {
  if (curves && String(next) === String(range)) return;
  range = next;
  const of = session, answer = await get(url("curves", { session: path, first: next[0], last: next[1] }));
  if (of !== session || next !== range) return;
  curves = answer;
  [$("slider").min, $("slider").max] = range;
  $("slider").value = wanted;
  draw();
}

function zoom(on) {
  zoomed = on;
  $("zoom").setAttribute("aria-pressed", on);
  if (session) seek(wanted);
}

export function stop() {
  clearInterval(timer);
  timer = null;
  text("play", "▶");
  $("play").setAttribute("aria-label", "play");
}

// Asks for a frame; of those asked for meanwhile only the last is fetched, so that no queue grows.
async function seek(next) {
  if (!session) return;
  wanted = Math.min(Math.max(next, 0), session.frames - 1);
  $("slider").value = wanted;
  draw();
  const press = zoomed && Object.values(session.presses).find(([first, last]) => first <= wanted && wanted <= last);
  focus(press || [0, session.frames - 1]).catch((error) => text("place", error.message));
  if (busy) return;
  busy = true;
  try {
    while (session && (frame !== wanted || !session.shown)) {
      const at = wanted, of = session, { answer, pictures } = await loaded(at);
      if (of !== session) continue;
      const by = at - frame;
      frame = at;
      session.shown = true;
      pictures.forEach((node, k) => {
        if (!node) return;
        views[k].node.replaceWith(node);
        views[k].node = node;
      });
      show(answer);
      if (by && Math.abs(by) < 10 && session.frames > at + by && at + by >= 0) loaded(at + by);
    }
  } catch (error) {
    text("place", error.message);
  } finally {
    busy = false;
  }
}

// Force and depth over time, with a line at the frame that is shown; between targets there are no frames.
function draw() {
  if (!curves) return;
  const { t, to, at } = curves, from = t[0], step = niceStep((to - from) / 6 || 1), ticks = [];
  for (let k = Math.ceil(from / step); k * step <= to; k += 1) ticks.push([k * step, `${+(k * step).toFixed(3)} s`]);
  const curve = (name) => curves[name].map(([low, high], k) => [t[k], low, high]);
  chart.gap = 3 * ((at.length > 1 ? at[1] - at[0] : 1) + 2) / session.rate;
  chart.show({ from, to, ticks, cursor: between(wanted, [...at, range[1]], [...t, to]), panels: [
    { share: 0.56, least: 0.1, unit: "N", curves: AXES.map(([name, colour]) => ({ name, colour, points: curve(name.toLowerCase()) })) },
    { share: 0.44, least: 0.1, unit: "mm", curves: [{ name: "depth", colour: "--text", points: curve("depth") }] },
  ] });
}

// Returns the y of an x, linear between places with rising xs.
function between(x, xs, ys) {
  const k = Math.max(xs.findLastIndex((each) => each <= x), 0), next = Math.min(k + 1, xs.length - 1);
  const part = xs[next] > xs[k] ? Math.min(Math.max((x - xs[k]) / (xs[next] - xs[k]), 0), 1) : 0;
  return ys[k] + part * (ys[next] - ys[k]);
}

function show(answer) {
  for (const view of views) if (!view.camera) taxels(view.node, answer.taxels);
  const part = (name, value) => h("span", {}, `${name} `, h("b", {}, value));
  $("values").replaceChildren(
    answer.depth < 0 ? part("above the surface", `${signed(-answer.depth)} mm`) : part("depth", `${signed(answer.depth)} mm`), ...AXES.map(([name], k) => part(name, `${signed(answer.wrench[k])} N`)),
    part("", activity(answer.phase, answer.depth)), ...(answer.valid ? [] : [h("b", { class: "wrong" }, "a stream has no sample near")]));
  text("place", `${answer.t.toFixed(2)} s · frame ${answer.frame + 1} of ${session.frames}`);
  const counts = map.show(session.outcomes, -1);
  for (const name of ["done", "limited", "open"]) text(`r-${name}`, String(counts[name]));
  if (answer.target >= 0 && answer.target < session.map.length) map.pick(answer.target);
  $("view").dataset.frame = answer.frame;
  button();
}

function step(by) {
  const starts = Object.values(session.presses).map(([first]) => first).sort((a, b) => a - b);
  const place = starts.findLastIndex((first) => first <= wanted);
  seek(starts[Math.min(Math.max(place + by, 0), starts.length - 1)] ?? wanted);
}

function play() {
  if (timer) return stop();
  text("play", "■");
  $("play").setAttribute("aria-label", "stop playing");
  const period = Math.max(1000 / session.rate, 50), by = Math.max(Math.round((period * session.rate) / 1000), 1);
  timer = setInterval(() => {
    if (!session || wanted >= session.frames - 1) return stop();
    if (!busy) seek(wanted + by);
  }, period);
}

// Marks ---------------------------------------------------------------------------------------------

function button() {
  const index = map.picked, on = map.marks.has(index);
  text("mark", index < 0 ? "Mark target" : `${on ? "Unmark" : "Mark"} target ${index + 1}`);
  $("mark").setAttribute("aria-pressed", on);
  $("mark").disabled = index < 0 || !session.plan;
  $("unmark").disabled = !map.marks.size;
}

function marks({ again, queue }) {
  map.marks = new Set(again.map((index) => index - 1));
  map.show(session.outcomes, -1);
  text("r-marked", String(again.length));
  text("marked", again.length ? `Marked: ${again.join(", ")}` : session.plan ? "No target is marked." : "Without a plan, targets cannot be pressed again.");
  fill("command", again.length ? queue : "", (line) => line ? [h("p", { class: "note" }, "Type this at the bench:"), command(line)] : []);
  button();
}

function change(list) {
  if (!send({ session: path, again: list.map((index) => index + 1) })) text("marked", "No connection: nothing is marked.");
}

on("marks", (answer) => {
  if (answer.session !== path || !session) return;
  if (answer.error) text("marked", answer.error);
  else marks(answer);
});

function toggle() {
  const next = new Set(map.marks), index = map.picked;
  if (index < 0 || !session.plan) return;
  next.delete(index) || next.add(index);
  change([...next]);
}

map.onPick = (index) => {
  if (session.presses[index]) seek(session.presses[index][0]);
  else button();
};
$("mark").addEventListener("click", toggle);
$("unmark").addEventListener("click", () => change([]));
$("slider").addEventListener("input", () => seek(Number($("slider").value)));
$("play").addEventListener("click", play);
$("zoom").addEventListener("click", () => zoom(!zoomed));
$("before").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
for (const kind of ["pointerdown", "pointermove"]) $("curves").addEventListener(kind, (event) => {
  if (curves && event.buttons) seek(Math.round(between(chart.at(event.clientX), [...curves.t, curves.to], [...curves.at, range[1]])));
});
addEventListener("keydown", (event) => {
  if (!session || $("v-session").hidden || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.closest("input:not([type=range]), select, dialog, #r-map")) return;
  const by = event.shiftKey ? 10 : 1;
  const keys = { ArrowLeft: () => seek(wanted - by), ArrowRight: () => seek(wanted + by), n: () => step(1), p: () => step(-1), m: toggle, z: () => zoom(!zoomed) };
  if (event.key === " " && !event.target.closest("button, a")) keys[" "] = play;
  if (!keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
