// Common parts of the pages. Text of a lab is only ever set as text.

export const $ = (id) => document.getElementById(id);

export function text(id, value) {
  const node = typeof id === "string" ? $(id) : id;
  if (node.textContent !== value) node.textContent = value;
}

export const PHASES = {
  normal_inc: "pressing", shear_inc: "shearing", shear_dec: "shearing back", normal_dec: "releasing", "to point": "to the point",
};

export function signed(value, digits = 2) {
  if (value === null || value === undefined) return "–";
  const shown = value.toFixed(digits);
  return Number(shown) === 0 ? shown.replace("-", "") : shown.replace("-", "−");
}

export function h(name, attributes, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "onclick") made.addEventListener("click", value);
    else if (value !== null && value !== false) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

export const tag = (name, kind) => h("span", { class: `tag ${kind}` }, name);

export const url = (route, given) => `/data/${route}?${new URLSearchParams(given)}`;

export async function get(where) {
  const answer = await fetch(where, { cache: "no-store" });
  if (!answer.ok) throw new Error((await answer.text()).trim() || `answer ${answer.status}`);
  return answer.json();
}

// Resolves when an image is shown, or cannot be.
export function image(node, where) {
  return new Promise((done) => {
    node.onload = node.onerror = done;
    node.src = where;
  });
}

// Sends one message and resolves with its answer.
export function send(message) {
  return new Promise((done) => {
    const socket = new WebSocket(`ws://${location.host}/live`);
    let answer = { error: "no answer from the workbench" };
    socket.onopen = () => socket.send(JSON.stringify(message));
    socket.onmessage = ({ data }) => {
      answer = JSON.parse(data);
      socket.close();
    };
    socket.onclose = () => done(answer);
  });
}
