// The views of the workbench, chosen by the part of the address after #.

import { open, stop } from "./replay.js";
import { $, get, h, tag, text, url } from "./tools.js";

const VIEWS = ["sessions", "session", "campaigns", "benches", "indenters"];
const PERIOD = 4000;
let lab = null, shown = "", drawn = {};

function route() {
  const [name, ...rest] = location.hash.slice(1).split("/");
  const view = VIEWS.includes(name) ? name : "sessions";
  for (const each of VIEWS) $(`v-${each}`).hidden = each !== view;
  for (const link of document.querySelectorAll("nav a[href^='#']")) {
    const here = link.hash === `#${view}` || (view === "session" && link.hash === "#sessions");
    here ? link.setAttribute("aria-current", "page") : link.removeAttribute("aria-current");
  }
  const path = decodeURIComponent(rest.join("/"));
  document.title = `${path || view}: workbench`;
  if (view === "session" && shown !== location.hash) {
    open(path);
    scrollTo(0, 0);
  }
  if (view !== "session") stop();
  shown = location.hash;
  refresh();
}

async function refresh() {
  try {
    if (!$("v-sessions").hidden) await sessions();
    lab = await get("/data/lab");
    running(lab.running);
    for (const [name, draw] of [["campaigns", campaigns], ["benches", benches], ["indenters", indenters]]) {
      const now = JSON.stringify(name === "benches" ? [lab.benches, lab.setups] : lab[name]);
      if ($(`v-${name}`).hidden || drawn[name] === now) continue;
      drawn[name] = now;
      draw();
    }
    $("lost").hidden = true;
  } catch (error) {
    text("lost", `No answer from the workbench: ${error.message}`);
    $("lost").hidden = false;
  }
}

function running(found) {
  $("running").hidden = !found;
  if (!found) return;
  $("running").href = `http://${location.hostname}:${found.port}/`;
  text("running", `● recording`);
  $("running").title = `watch ${found.session}; another computer needs the address that the collection printed`;
}

// Sessions ------------------------------------------------------------------------------------------

const day = (utc) => utc.slice(0, 16).replace("T", " ");

async function sessions() {
  const asked = { text: $("q-text").value, faults: $("q-faults").value, since: $("q-since").value };
  for (const key of ["sensor", "indenter", "status"]) asked[key] = $(`q-${key}`).value;
  const found = await get(url("sessions", asked));
  for (const key of ["sensor", "indenter", "status"]) {
    choices($(`q-${key}`), [["", `every ${key}`], ...found.choices[key].map((name) => [name, name])]);
  }
  const more = found.found > found.rows.length ? `, the newest ${found.rows.length} are shown` : "";
  text("found", found.total ? `${found.found} of ${found.total} sessions${more}` : "No session yet: record one with tactile collect.");
  const now = JSON.stringify(found.rows);
  if (drawn.sessions === now) return;
  drawn.sessions = now;
  $("list").replaceChildren(...found.rows.map(session));
}

function choices(select, wanted) {
  if (select.options.length === wanted.length && wanted.every(([value], k) => select.options[k].value === value)) return;
  const before = select.value;
  select.replaceChildren(...wanted.map(([value, name]) => h("option", { value }, name)));
  select.value = wanted.some(([value]) => value === before) ? before : "";
}

function session(row) {
  const finished = !["recording", "unreadable"].includes(row.status);
  const picture = finished ? thumbnail(row.path) : h("span", { class: "picture" });
  const about = [row.sensor, row.indenter, row.targets ? `${row.targets} targets` : "", row.operator, day(row.started_utc)];
  const tags = row.faults.length ? row.faults.map((fault) => tag(fault, fault === "recording" ? "warn" : "bad")) : [tag(row.status, "good")];
  if (row.mock) tags.push(tag("mock", ""));
  if (row.findings === null && finished) tags.push(tag("not checked", ""));
  return h("li", {}, h("a", { href: `#session/${encodeURIComponent(row.path)}` }, picture,
    h("span", {}, h("b", {}, row.path), h("span", { class: "note" }, about.filter(Boolean).join(" · ")), h("span", { class: "tags" }, ...tags))));
}

const thumbnail = (path) => h("img", { class: "picture", alt: "", loading: "lazy", width: 248, height: 186, src: url("thumbnail", { session: path }) });

// Campaigns -----------------------------------------------------------------------------------------

function campaigns() {
  $("campaigns").replaceChildren(...lab.campaigns.map((campaign) => {
    const done = campaign.items.reduce((sum, item) => sum + item.done, 0), total = campaign.items.reduce((sum, item) => sum + item.total, 0);
    const left = campaign.items.reduce((sum, item) => sum + item.left, 0), sensors = [...new Set(campaign.items.map((item) => item.sensor))];
    const bar = h("div", { class: "bar", role: "progressbar", "aria-label": "targets done", "aria-valuemin": 0, "aria-valuemax": total, "aria-valuenow": done }, h("i", {}));
    bar.firstChild.style.width = `${total ? (100 * done) / total : 0}%`;
    return h("section", {}, h("h2", {}, campaign.name === "again" ? "Record again" : campaign.name),
      h("p", { class: campaign.error ? "wrong" : "note" }, campaign.error || `${done} of ${total} targets, about ${duration(left)} left`), bar,
      table(["sensor", "indenter", "plan", "targets", "state"], campaign.items.map((item) => [
        item.sensor, item.indenter, item.again.length ? `again ${item.again.join(", ")}` : item.plan.replace("_", " "), `${item.done} / ${item.total}`,
        item.session ? h("a", { href: `#session/${encodeURIComponent(item.session)}` }, item.state) : item.state + (item.note ? `: ${item.note}` : "")])),
      h("p", { class: "note" }, "At the bench:"), h("p", { class: "command" }, h("code", {}, campaign.command)),
      h("div", { class: "plans" }, ...sensors.map((sensor) => picture(url("plan", { sensor }), `plan of ${sensor}`))));
  }));
}

function duration(seconds) {
  const minutes = Math.round(seconds / 60);
  return minutes < 1 ? "a minute" : minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

function table(heads, rows) {
  return h("table", {}, h("thead", {}, h("tr", {}, ...heads.map((head) => h("th", { scope: "col", class: "text" }, head)))),
    h("tbody", {}, ...rows.map((cells) => h("tr", {}, ...cells.map((cell) => h("td", { class: "text" }, cell))))));
}

function picture(where, name) {
  const made = h("button", { type: "button", class: "picture", "aria-label": `${name}, larger`, onclick: () => {
    $("large-image").src = where;
    $("large-image").alt = name;
    $("large").showModal();
  } }, h("img", { alt: name, loading: "lazy", src: where }));
  return made;
}

// Benches and indenters -----------------------------------------------------------------------------

function benches() {
  const used = lab.benches.filter((bench) => !bench.mock || bench.newest || setupOf(bench));
  const others = lab.benches.filter((bench) => !used.includes(bench));
  $("benches").replaceChildren(...used.map(bench), ...(others.length ? [h("section", {}, h("h2", {}, "Other mock benches"),
    table(["name", "sensor"], others.map((each) => [each.name, each.description])))] : []));
}

const setupOf = (bench) => lab.setups.find((each) => each.sensor === bench.sensor && (each.error || each.mock === bench.mock));

function bench(each) {
  if (each.error) return h("section", {}, h("h2", {}, each.name), h("p", { class: "wrong" }, each.error));
  const newest = `#session/${encodeURIComponent(each.newest)}`, name = `newest session of ${each.sensor}`;
  return h("section", {}, h("h2", {}, each.name, " ", tag(each.mock ? "mock" : "lab", each.mock ? "" : "warn")),
    h("p", {}, each.description), h("p", { class: "note" }, `${each.targets} targets · ${each.streams.join(", ")}`),
    ...(each.newest ? [h("a", { href: newest, "aria-label": name }, thumbnail(each.newest))] : []), ...setups(setupOf(each), each),
    h("details", {}, h("summary", {}, "Plan"), picture(url("plan", { sensor: each.name }), `plan of ${each.name}`)));
}

function setups(setup, bench) {
  if (!setup) return [h("p", { class: "note" }, "Not set up. At the bench:"), h("p", { class: "command" }, h("code", {}, `tactile setup --sensor ${bench.name}`))];
  if (setup.error) return [h("p", { class: "wrong" }, setup.error)];
  const rows = setup.steps.map((step) => [step.name, h("span", { class: `state-${step.state}` }, step.state),
    step.findings.filter((each) => each.state !== "well").map((each) => `${each.part}: ${each.text}`).join("; ") || step.date_utc.slice(0, 16).replace("T", " ")]);
  const now = setup.running;
  if (now) rows.push([now.step, h("span", { class: "state-now" }, "now"), [`step ${now.number} of ${now.count}`, ...now.findings.map((each) => `${each.state}: ${each.part}: ${each.text}`)].join("; ")]);
  const report = url("report", { sensor: setup.sensor });
  return [h("p", {}, "Set-up: ", h("b", {}, now ? "under way" : setup.result || "not finished"), ...(setup.report ? [" · ", h("a", { href: report, target: "_blank", rel: "noopener" }, "acceptance report")] : [])),
    h("details", now ? { open: "" } : {}, h("summary", {}, "Steps"), table(["step", "state", "found"], rows))];
}

function indenters() {
  $("indenters").replaceChildren(...lab.indenters.map((each) => h("section", {}, h("h2", {}, each.name),
    ...(each.drawing ? [picture(url("indenter", { name: each.name }), each.name)] : []),
    h("p", {}, each.size), h("p", { class: "note" }, each.tip))));
}

$("search").addEventListener("submit", (event) => event.preventDefault());
let typing = null;
$("search").addEventListener("input", () => {
  clearTimeout(typing);
  typing = setTimeout(refresh, 200);
});
$("close").addEventListener("click", () => $("large").close());
addEventListener("hashchange", route);
setInterval(() => document.hidden || refresh(), PERIOD);
route();
