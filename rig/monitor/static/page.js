// The three views, chosen by the part of the address after #: Live, Sessions (and one of them), Benches.

import * as benches from "./benches.js";
import * as collection from "./collection.js";
import * as forces from "./forces.js";
import * as sessions from "./sessions.js";
import { $, text } from "./widgets.js";
import { connect, fail, get, on, url } from "./wire.js";

const VIEWS = ["live", "sessions", "session", "benches"];
const LIVE = { collection, forces };
const PERIOD = 4000;
let hello = null, live = null, shown = "";

on("hello", (message) => {
  hello = message;
  live = LIVE[hello.live] ?? null;
  for (const [name, view] of Object.entries(LIVE)) $(name).hidden = view !== live;
  for (const link of document.querySelectorAll("nav a[href='#sessions'], nav a[href='#benches']")) link.hidden = !hello.lab;
  $("to-live").hidden = !live;
  live?.begin(hello);
  route();
});
on("state", (message) => live?.show(message));
on("lost", () => live?.lost());

function route() {
  if (!hello) return;
  const [name, ...rest] = location.hash.slice(1).split("/");
  const known = VIEWS.includes(name) && (name === "live" ? live : hello.lab);
  const view = known ? name : live ? "live" : "sessions", path = known ? decodeURIComponent(rest.join("/")) : "";
  for (const each of VIEWS) $(`v-${each}`).hidden = each !== view;
  for (const link of document.querySelectorAll("nav a")) {
    const here = link.hash === `#${view}` || (view === "session" && link.hash === "#sessions");
    here ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  document.title = view === "live" ? `${hello.sensor}: ${hello.live}` : path || view;
  if (view === "session" && shown !== location.hash) {
    sessions.open(path);
    scrollTo(0, 0);
  }
  if (view !== "session") sessions.stop();
  shown = location.hash;
  refresh();
}

async function refresh() {
  if (!hello?.lab || !$("v-live").hidden) return fail("");
  try {
    if (!$("v-sessions").hidden) await sessions.list();
    const lab = await get(url("lab", {}));
    if (!live) running(lab.running);
    if (!$("v-benches").hidden) benches.show(lab);
    fail("");
  } catch (error) {
    fail(error.message);
  }
}

// A collection serves a page of its own, from which it can be paused.
function running(page) {
  $("to-live").hidden = !page;
  if (!page) return;
  $("to-live").href = `http://${location.hostname}:${page.port}/`;
  text("to-live", "● recording");
  $("to-live").title = `watch ${page.session}; another computer needs the address that the collection printed`;
}

sessions.onSearch(refresh);
addEventListener("hashchange", route);
setInterval(() => document.hidden || refresh(), PERIOD);
connect();
