// Shows one session: a frame at a time, its curves, its map of targets, and marks for recording again.

import { Curves } from "./curves.js";
import { $, PHASES, get, h, image, send, signed, tag, text, url } from "./tools.js";
import { TargetMap } from "./map.js";
import { taxels } from "./taxels.js";

const map = new TargetMap($("map"), $("cell"));
const curves = new Curves($("curves"));
let session = null, path = "", frame = 0, wanted = 0, busy = false, timer = null, views = [];

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
  let found;
  try {
    found = await get(url("session", { session: name }));
  } catch (error) {
    text("s-error", error.message);
    $("s-error").hidden = false;
    return;
  }
  if (path !== name) return;
  session = found;
  const faults = session.faults.length ? session.faults.map((fault) => tag(fault, "bad")) : [tag("complete", "good")];
  const day = session.started_utc.slice(0, 16).replace("T", " ");
  const about = [session.sensor, session.indenter, session.operator, day && `${day} UTC`, `${session.frames} frames at ${session.rate} Hz`, session.reason];
  $("s-about").replaceChildren(about.filter(Boolean).join(" · "), " ", ...faults, ...(session.mock ? [" ", tag("mock", "warn")] : []));
  $("replay").hidden = false;
  views = [...session.cameras.map((camera) => ({ camera, node: h("img", { alt: `image of ${camera}` }) })), ...(session.taxels ? [{ node: h("canvas", { width: 640, height: 480, role: "img", "aria-label": "taxels" }) }] : [])];
  $("pictures").replaceChildren(...views.map((view) => view.node));
  $("pictures").hidden = !views.length;
  $("slider").max = Math.max(session.frames - 1, 0);
  $("streams").replaceChildren(...session.streams.map((row) => h("tr", {},
    h("th", { scope: "row" }, row.name), h("td", {}, row.rows.toLocaleString("en")), h("td", {}, `${row.rate} Hz`),
    h("td", { class: row.dropped ? "wrong" : "" }, String(row.dropped)))));
  const dropped = session.streams.filter((row) => row.dropped).map((row) => `${row.name} dropped ${row.dropped}`);
  text("dropped", dropped.join(", ") || "no drop noticed while recording");
  $("dropped").className = dropped.length ? "wrong" : "note";
  map.build({ targets: session.map, points: session.points, directions: session.directions });
  map.marks = new Set(session.again.map((target) => target - 1));
  curves.show(session);
  marks(session);
  seek(session.starts[0] ?? 0);
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
  curves.seek(wanted);
  if (busy) return;
  busy = true;
  try {
    while (session && (frame !== wanted || !session.shown)) {
      const at = wanted, of = session, found = await get(url("frame", { session: path, frame: at }));
      if (of !== session) continue;
      frame = at;
      session.shown = true;
      await Promise.all(views.filter((view) => view.camera && found.images[view.camera] >= 0).map((view) =>
        image(view.node, url("image", { session: path, frame: at, camera: view.camera }))));
      if (of === session) show(found);
    }
  } catch (error) {
    text("place", error.message);
  } finally {
    busy = false;
  }
}

function show(found) {
  for (const view of views) if (!view.camera) taxels(view.node, found.taxels);
  const [fx, fy, fz] = found.wrench, part = (name, value) => h("span", {}, `${name} `, h("b", {}, value));
  $("values").replaceChildren(
    part("depth", `${signed(found.depth)} mm`), part("Fx", `${signed(fx)} N`), part("Fy", `${signed(fy)} N`), part("Fz", `${signed(fz)} N`),
    part("", PHASES[found.phase] ?? found.phase), ...(found.valid ? [] : [h("b", { class: "wrong" }, "a stream has no sample near")]));
  text("place", `${found.t.toFixed(2)} s · frame ${found.frame + 1} of ${session.frames}`);
  const counts = map.show(session.outcomes, -1);
  for (const name of ["done", "limited", "open"]) text(`n-${name}`, String(counts[name]));
  if (found.target >= 0 && found.target < session.map.length) map.pick(found.target);
  $("view").dataset.frame = found.frame;
  button();
}

function target() {
  return map.picked;
}

function step(by) {
  const starts = Object.entries(session.starts).map(([index, at]) => [Number(index), at]).sort((a, b) => a[1] - b[1]);
  const place = starts.findLastIndex(([, at]) => at <= wanted);
  const next = starts[Math.min(Math.max(place + by, 0), starts.length - 1)];
  if (next) seek(next[1]);
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
  const index = target(), on = map.marks.has(index);
  text("mark", index < 0 ? "Mark target" : `${on ? "Unmark" : "Mark"} target ${index + 1}`);
  $("mark").setAttribute("aria-pressed", on);
  $("mark").disabled = index < 0 || !session.plan;
  $("unmark").disabled = !map.marks.size;
}

function marks({ again, queue }) {
  map.marks = new Set(again.map((index) => index - 1));
  map.show(session.outcomes, -1);
  text("n-marked", String(again.length));
  text("marked", again.length ? `Marked: ${again.join(", ")}` : session.plan ? "No target is marked." : "Without a plan, targets cannot be pressed again.");
  text("command", again.length ? queue : "–");
  $("copy").disabled = !again.length;
  button();
}

async function change(list) {
  const of = path;
  const answer = await send({ session: of, again: list.map((index) => index + 1) });
  if (of !== path || !session) return;
  if (answer.error) text("marked", answer.error);
  else marks(answer);
}

function toggle() {
  const next = new Set(map.marks), index = target();
  if (index < 0 || !session.plan) return;
  next.delete(index) || next.add(index);
  change([...next]);
}

map.onPick = (index) => {
  if (session.starts[index] !== undefined) seek(session.starts[index]);
  else button();
};
$("mark").addEventListener("click", toggle);
$("unmark").addEventListener("click", () => change([]));
$("copy").addEventListener("click", () => navigator.clipboard?.writeText($("command").textContent));
$("slider").addEventListener("input", () => seek(Number($("slider").value)));
$("play").addEventListener("click", play);
$("before").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
for (const kind of ["pointerdown", "pointermove"]) $("curves").addEventListener(kind, (event) => {
  if (session && event.buttons) seek(curves.frameAt(event.clientX));
});
addEventListener("keydown", (event) => {
  if (!session || $("v-session").hidden || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.closest("input:not([type=range]), select, dialog, #map")) return;
  const by = event.shiftKey ? 10 : 1;
  const keys = { ArrowLeft: () => seek(wanted - by), ArrowRight: () => seek(wanted + by), n: () => step(1), p: () => step(-1), m: toggle };
  if (event.key === " " && !event.target.closest("button, a")) keys[" "] = play;
  if (!keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
