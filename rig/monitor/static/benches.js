// Campaigns with their progress, benches with their set-up, and indenters.

import { thumbnail } from "./sessions.js";
import { command, enlarge, fill, h, tag } from "./widgets.js";
import { url } from "./wire.js";

let lab = null;

export function show(found) {
  lab = found;
  fill("campaigns", lab.campaigns, (each) => each.map(campaign));
  fill("benches", [lab.benches, lab.setups], benches);
  fill("indenters", lab.indenters, (each) => each.map(indenter));
}

function campaign({ name, command: line, error, items }) {
  const sum = (key) => items.reduce((total, item) => total + item[key], 0);
  const done = sum("done"), total = sum("total"), sensors = [...new Set(items.map((item) => item.sensor))];
  const bar = h("div", { class: "bar", role: "progressbar", "aria-label": "targets done", "aria-valuemin": 0, "aria-valuemax": total, "aria-valuenow": done }, h("i", {}));
  bar.firstChild.style.width = `${total ? (100 * done) / total : 0}%`;
  return h("section", {}, h("h3", {}, name === "again" ? "Record again" : name),
    h("p", { class: error ? "wrong" : "note" }, error || `${done} of ${total} targets, about ${duration(sum("left"))} left`), bar,
    table(["sensor", "indenter", "plan", "targets", "state"], items.map((item) => [
      item.sensor, item.indenter, item.again.length ? `again ${item.again.join(", ")}` : item.plan.replace("_", " "), `${item.done} / ${item.total}`,
      item.session ? h("a", { href: `#session/${encodeURIComponent(item.session)}` }, item.state) : item.state + (item.note ? `: ${item.note}` : "")])),
    h("p", { class: "note" }, "At the bench:"), command(line), ...sensors.map(plan));
}

function duration(seconds) {
  const minutes = Math.round(seconds / 60);
  return minutes < 1 ? "a minute" : minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

function table(heads, rows) {
  return h("table", {}, h("thead", {}, h("tr", {}, ...heads.map((head) => h("th", { scope: "col", class: "text" }, head)))),
    h("tbody", {}, ...rows.map((cells) => h("tr", {}, ...cells.map((cell) => h("td", { class: "text" }, cell))))));
}

function picture(address, name) {
  const image = (alt) => h("img", { class: "drawing", alt, loading: "lazy", src: address });
  return h("button", { type: "button", class: "picture", "aria-label": `${name}, larger`, onclick: () => enlarge(image(name)) }, image(""));
}

const plan = (sensor) => h("details", {}, h("summary", {}, `Plan of ${sensor}`), h("div", { class: "plan" }, picture(url("plan", { sensor }), `plan of ${sensor}`)));

function benches() {
  const used = lab.benches.filter((bench) => !bench.mock || bench.newest || setupOf(bench));
  const others = lab.benches.filter((bench) => !used.includes(bench));
  return [...used.map(bench), ...(others.length ? [h("section", { class: "all" }, h("h3", {}, "Other mock benches"),
    table(["name", "sensor", "targets", "streams"], others.map((each) => [each.name, each.description, each.targets, each.streams.join(", ")])))] : [])];
}

const setupOf = (bench) => lab.setups.find((each) => each.sensor === bench.sensor && (each.error || each.mock === bench.mock));

function bench(each) {
  if (each.error) return h("section", {}, h("h3", {}, each.name), h("p", { class: "wrong" }, each.error));
  const newest = `#session/${encodeURIComponent(each.newest)}`, name = `newest session of ${each.sensor}`;
  return h("section", {}, h("h3", {}, each.name, " ", tag(each.mock ? "mock" : "lab", each.mock ? "" : "warn")),
    h("p", {}, each.description), h("p", { class: "note" }, `${each.targets} targets · ${each.streams.join(", ")}`),
    ...(each.newest ? [h("a", { href: newest, "aria-label": name }, thumbnail(each.newest))] : []), ...setups(setupOf(each), each),
    plan(each.name));
}

function setups(setup, bench) {
  if (!setup) return [h("p", { class: "note" }, "Not set up. At the bench:"), command(`tactile setup --sensor ${bench.name}`)];
  if (setup.error) return [h("p", { class: "wrong" }, setup.error)];
  const rows = setup.steps.map((step) => [step.name, h("span", { class: `state-${step.state}` }, step.state),
    step.findings.filter((each) => each.state !== "well").map((each) => `${each.part}: ${each.text}`).join("; ") || step.date_utc.slice(0, 16).replace("T", " ")]);
  const now = setup.running;
  if (now) rows.push([now.step, h("span", { class: "state-now" }, "now"), [`step ${now.number} of ${now.count}`, ...now.findings.map((each) => `${each.state}: ${each.part}: ${each.text}`)].join("; ")]);
  const report = url("report", { sensor: setup.sensor });
  return [h("p", {}, "Set-up: ", h("b", {}, now ? "under way" : setup.result || "not finished"), ...(setup.report ? [" · ", h("a", { href: report, target: "_blank", rel: "noopener" }, "acceptance report")] : [])),
    h("details", now ? { open: "" } : {}, h("summary", {}, "Steps"), table(["step", "state", "found"], rows))];
}

function indenter(each) {
  return h("section", {}, h("h3", {}, each.name), ...(each.drawing ? [picture(url("indenter", { name: each.name }), each.name)] : []),
    h("p", {}, each.size), h("p", { class: "note" }, each.tip));
}
