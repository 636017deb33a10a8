// Data from the server: what it pushes through the one connection, and what a view asks for.

import { $, text } from "./widgets.js";

const SILENT = 2000, RETRY = 1500;
const handlers = {};
let socket = null, live = null, heard = 0, offline = "", failed = "";

// Calls `handler` with each message of a kind: hello, state, marks, picture, and lost.
export const on = (kind, handler) => (handlers[kind] = handler);

export const connected = () => socket?.readyState === WebSocket.OPEN;

export function send(message) {
  if (connected()) socket.send(JSON.stringify(message));
  return connected();
}

export const url = (route, values) => `/data/${route}?${new URLSearchParams(values)}`;

export async function get(address) {
  const answer = await fetch(address, { cache: "no-store" });
  if (!answer.ok) throw new Error((await answer.text()).trim() || `answer ${answer.status}`);
  return answer.json();
}

// Shows why a view has no data; an empty text if it has.
export function fail(why) {
  failed = why && `No answer: ${why}`;
  banner();
}

function banner() {
  text("lost", offline || failed);
  $("lost").hidden = !(offline || failed);
}

export async function connect() {
  try {
    // The page is fetched first: the response renews the cookie, and shows if access is denied.
    const answer = await fetch("/", { cache: "no-store" });
    if (answer.status === 403) return lost("open the address that the command printed", true);
    if (!answer.ok) return lost("", true);
  } catch {
    return lost("", true);
  }
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => {
    heard = Date.now();
    offline = "";
    banner();
    const message = typeof data === "string" ? JSON.parse(data) : { kind: "picture", data };
    if (message.kind === "hello") live = message.live;
    handlers[message.kind]?.(message);
  };
  socket.onclose = ({ reason }) => {
    socket = null;
    lost(reason, true);
  };
}

function lost(why, again) {
  if (again) setTimeout(connect, RETRY);
  const ago = heard ? ` since ${Math.max(1, Math.round((Date.now() - heard) / 1000))} s` : "";
  const calm = live === "collection" ? " Collecting does not depend on this page;" : "";
  // A command that has ended leaves its last state on the page.
  offline = handlers.lost?.() ? "" : `No connection${ago}${why ? `: ${why}` : `.${calm} reconnecting …`}`;
  banner();
}

setInterval(() => {
  if (live && heard && Date.now() - heard > SILENT) lost("", false);
}, 500);
