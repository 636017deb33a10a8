// Connects, displays the server's messages and sends commands. The server pushes all data.

import { TargetMap } from "./map.js";
import { taxels } from "./taxels.js";
import { $, PHASES, signed, text } from "./tools.js";
import { Traces } from "./traces.js";

const STATUS = {
  preparing: "Preparing", collecting: "Collecting", pausing: "Pausing", paused: "Paused", ending: "Ending",
  complete: "Complete", stopped: "Stopped", gone: "Gone",
};
const QUALITY = { good: "good", watch: "look", fault: "fault", unknown: "unknown" };
const ENDED = new Set(["complete", "stopped", "gone"]);
const SILENT = 2000;
const RETRY = 1500;

const map = new TargetMap($("map"), $("cell"));
const first = new Traces($("traces"));
let traces = {}, pictures = [], captions = {};
let hello = null, state = null, socket = null, heard = 0, asked = "";

function clock(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.max(Math.round(seconds), 0), hours = Math.floor(whole / 3600);
  const two = (n) => String(n).padStart(2, "0");
  const minutes = Math.floor((whole % 3600) / 60);
  return hours ? `${hours}:${two(minutes)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
}

// Connection -------------------------------------------------------------------------------------

async function connect() {
  try {
    // The page is fetched first: the response renews the cookie, and shows if access is denied.
    const answer = await fetch("/", { cache: "no-store" });
    if (answer.status === 403) return lost("Not let in: open the address that the collection printed.", true);
    if (!answer.ok) return lost("", true);
  } catch {
    return lost("", true);
  }
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => (typeof data === "string" ? take(JSON.parse(data)) : picture(data));
  socket.onclose = ({ reason }) => {
    socket = null;
    lost(reason, true);
  };
}

function lost(why, again) {
  if (again) setTimeout(connect, RETRY);
  buttons();
  if (state && ENDED.has(state.status)) {
    $("lost").hidden = true;
    return;
  }
  const ago = heard ? ` since ${Math.max(1, Math.round((Date.now() - heard) / 1000))} s` : "";
  text("lost", why ? `No connection${ago}: ${why}` : `No connection${ago}. Collecting does not depend on this page; reconnecting …`);
  $("lost").hidden = false;
  document.body.dataset.status = "lost";
  text("status", "No connection");
  text("phase", "");
}

setInterval(() => {
  if (heard && Date.now() - heard > SILENT) lost("", false);
}, 500);

function take(message) {
  heard = Date.now();
  $("lost").hidden = true;
  if (message.kind === "hello") begin(message);
  else if (message.kind === "state") show(message);
}

function ask(command) {
  if (socket?.readyState !== WebSocket.OPEN) return;
  asked = command;
  socket.send(JSON.stringify({ command }));
  buttons();
}

// Constant data -------------------------------------------------------------------------------------

function begin(message) {
  hello = message;
  document.title = `${hello.sensor}: collection`;
  text("what", `${hello.sensor} · ${hello.indenter} · ${hello.session}`);
  text("bench", hello.mock ? "MOCK BENCH" : "LAB BENCH");
  $("bench").hidden = false;
  text("total", ` / ${hello.targets.length}`);
  $("bar").setAttribute("aria-valuemax", hello.targets.length);
  layOut();
  const sector = hello.directions > 1 ? "shear direction" : "repeat";
  text("map-note", `rose: contact point · ring: depth, deepest outside · sector: ${sector}`);
  $("log").textContent = "";
  map.build(hello);
  const { axes, ratings, soft, hard, box } = hello.limits;
  text("limits-note", `fraction of the rating; marks: soft limit ${percent(soft)}, hard ${percent(hard)}`);
  $("loads").replaceChildren(...axes.map((axis, k) => {
    const made = gauge(axis, `${axis}: fraction of ${ratings[k]} ${k < 3 ? "N" : "N mm"}`, ["fill"]);
    for (const [name, fraction] of [["soft", soft], ["hard", hard]]) mark(made, name, fraction / railEnd());
    return made;
  }));
  $("box").replaceChildren(
    gauge("depth", `depth, allowed up to ${-box[2][0]} mm`, ["fill"]),
    gauge("x", `x, allowed ${box[0].join(" to ")} mm`, ["dot"]),
    gauge("y", `y, allowed ${box[1].join(" to ")} mm`, ["dot"]),
  );
}

// The first picture and the first plot stand large on the page, further ones small below them.
function layOut() {
  captions = {};
  $("more-images").textContent = "";
  $("more-traces").textContent = "";
  pictures = Object.entries(hello.pictures).map(([name, kind], k) => ({
    name, kind, busy: false, canvas: k ? figure($("more-images"), name, 320, 240) : $("image"),
  }));
  $("image").parentElement.hidden = !pictures.length;
  text("h-image", pictures[0]?.kind === "taxels" ? "Taxels" : "Live image");
  traces = {};
  hello.plots.forEach((name, k) => {
    traces[name] = k ? new Traces(figure($("more-traces"), name)) : first;
    traces[name].clear(hello.seconds);
  });
  $("traces").closest("section").hidden = !hello.plots.length;
}

function figure(parent, name, width, height) {
  const made = document.createElement("figure"), caption = document.createElement("figcaption");
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", name);
  if (width) {
    canvas.width = width;
    canvas.height = height;
    made.append(canvas);
  } else {
    const plot = document.createElement("div");
    plot.className = "plot";
    plot.append(canvas);
    made.append(plot);
  }
  text(caption, name);
  captions[name] = caption;
  made.append(caption);
  parent.append(made);
  return canvas;
}

const percent = (fraction) => `${Math.round(100 * fraction)} %`;
const railEnd = () => 1.05 * hello.limits.hard;

function gauge(name, label, parts) {
  const row = document.createElement("div");
  row.className = "gauge";
  const title = document.createElement("span"), rail = document.createElement("div"), value = document.createElement("b");
  title.textContent = name;
  rail.className = "rail";
  rail.setAttribute("role", "meter");
  rail.setAttribute("aria-label", label);
  row.title = label;
  for (const part of parts) {
    const made = document.createElement("div");
    made.className = part;
    rail.append(made);
  }
  value.textContent = "–";
  row.append(title, rail, value);
  return row;
}

function mark(row, name, fraction) {
  const made = document.createElement("div");
  made.className = `mark ${name}`;
  made.style.left = `${(100 * Math.min(fraction, 1)).toFixed(1)}%`;
  row.children[1].append(made);
}

function setGauge(row, fraction, value, level) {
  const part = row.children[1].firstChild;
  const place = `${(100 * Math.min(Math.max(fraction, 0), 1)).toFixed(1)}%`;
  part.style[part.className === "dot" ? "left" : "width"] = place;
  row.children[1].setAttribute("aria-valuenow", Math.round(100 * fraction));
  row.className = `gauge ${level}`;
  text(row.children[2], value);
}

// Changing data -----------------------------------------------------------------------------------

function show(next) {
  state = next;
  const waiting = state.status === "collecting" && state.paused_by.length;
  const status = waiting ? "pausing" : state.status;
  document.body.dataset.status = status;
  const who = state.paused_by.length ? ` by ${state.paused_by.join(", ")}` : "";
  text("status", waiting ? "Pausing" : STATUS[status] + (status === "paused" ? who : ""));
  text("phase", status === "collecting" || status === "pausing" ? PHASES[state.phase] ?? state.phase : "");
  text("reason", state.reason);
  $("reason").hidden = !state.reason;
  text("target", state.target >= 0 ? String(state.target + 1) : "–");
  text("left", clock(state.left));
  const counts = map.show(state.outcomes, state.target);
  for (const name of ["done", "limited", "open"]) text(`n-${name}`, String(counts[name]));
  const behind = counts.done + counts.limited;
  $("bar").firstElementChild.style.width = `${(100 * behind) / hello.targets.length}%`;
  $("bar").setAttribute("aria-valuenow", behind);
  for (const [name, points] of Object.entries(state.traces)) traces[name].add(points);
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

function buttons() {
  const live = socket?.readyState === WebSocket.OPEN && state && !ENDED.has(state.status);
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
    ["fx", "fy", "fz"].forEach((name, k) => text(`v-${name}`, signed(force.wrench[k])));
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
  const list = $("quality");
  while (list.children.length > rows.length) list.lastChild.remove();
  while (list.children.length < rows.length) {
    const row = document.createElement("li");
    const said = document.createElement("p");
    said.append(document.createElement("b"), " ", document.createElement("span"));
    row.append(document.createElement("span"), said);
    list.append(row);
  }
  rows.forEach(({ name, state, text: why }, k) => {
    const [judged, said] = list.children[k].children, [title, reason] = said.children;
    judged.className = `state ${state}`;
    text(judged, QUALITY[state]);
    text(title, name);
    text(reason, why);
  });
  const count = (wanted) => rows.filter(({ state }) => state === wanted).length;
  const found = [["fault", "at fault"], ["watch", "to look at"], ["unknown", "unknown"]]
    .filter(([wanted]) => count(wanted)).map(([wanted, said]) => `${count(wanted)} ${said}`).join(", ");
  text("quality-all", found || (rows.length ? "all good" : ""));
}

function streams(rows) {
  const body = $("streams");
  const names = Object.keys(rows);
  while (body.children.length < names.length) {
    const row = body.insertRow();
    const head = document.createElement("th");
    head.scope = "row";
    row.append(head);
    for (let k = 0; k < 4; k += 1) row.insertCell();
  }
  names.forEach((name, k) => {
    const { rate, expected, dropped, gap, age } = rows[name];
    const cells = body.rows[k].cells;
    const over = ENDED.has(state.status) || state.status === "ending";
    const silent = age > 1000 && !over;
    const slow = rate !== undefined && Math.abs(rate - expected) > 0.15 * expected && !over;
    text(cells[0], name);
    text(cells[1], silent ? "silent" : rate === undefined ? "–" : `${rate.toFixed(0)} Hz`);
    cells[1].className = silent || slow ? "wrong" : rate === undefined || over ? "" : "right";
    text(cells[2], `${expected.toFixed(0)} Hz`);
    text(cells[3], dropped === undefined ? "–" : String(dropped));
    cells[3].className = dropped ? "wrong" : "";
    text(cells[4], gap ? `${gap.toFixed(0)} ms` : "–");
  });
  const { watchers, refused } = state;
  text("watchers", `${watchers} watching${refused ? `, ${refused} refused` : ""} · running for ${clock(state.elapsed)}`);
}

function log(lines) {
  if (!lines.length) return;
  const box = $("log");
  const atEnd = box.scrollHeight - box.scrollTop - box.clientHeight < 30;
  const all = box.textContent.split("\n").filter(Boolean).concat(lines);
  box.textContent = all.slice(-100).join("\n");
  if (atEnd) box.scrollTop = box.scrollHeight;
}

// The first byte is the number of the picture, the rest its JPEG.
async function picture(data) {
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
}

$("pause").addEventListener("click", () => ask(state.paused_by.includes("page") ? "resume" : "pause"));
$("abort").addEventListener("click", () => $("confirm").showModal());
$("go-on").addEventListener("click", () => $("confirm").close());
$("abort-now").addEventListener("click", () => {
  $("confirm").close();
  ask("abort");
});
connect();
