// What the service says of the file itself: what is in it, what is wrong with it, and its glass as the renderer's own material.

import { bodyOf, send } from "./api.js";
import { pictureName } from "./commands.js";
import { $, counted, download, make } from "./dom.js";
import { report } from "./problems.js";
import { state } from "./state.js";

const MOST = 200; // findings shown; the file has them all
const ORDER = ["error", "warning", "info"];
const KINDS = ["inspect", "validate", "convert"];
const DOING = { inspect: "Inspecting", validate: "Validating", convert: "Converting" };
let given = null; // {kind, source, job, found} of what is shown
let asking = null;

/** One line of a list: how bad or what, where, and what about it. */
const item = ({ severity, word = severity, path, text, more = [] }) => make("li", { className: severity },
  make("b", { textContent: word }), ...(path ? [make("code", { textContent: path })] : []),
  ...(text ? [make("p", { textContent: text })] : []), ...more.filter(Boolean).map((textContent) => make("p", { className: "quiet", textContent })));

function listOf(rows) {
  const shown = rows.slice(0, MOST).map(item);
  if (rows.length > MOST) shown.push(make("li", { textContent: `and ${rows.length - MOST} more, in the JSON file` }));
  return make("ul", { className: "findings" }, ...shown);
}

/** Findings, the worst first. */
export const findingRows = (findings) =>
  findings.map((one) => ({ severity: one.severity ?? "warning", path: one.path, text: one.text, more: [one.fix && `To mend it: ${one.fix}`] }))
    .sort((one, other) => ORDER.indexOf(one.severity) - ORDER.indexOf(other.severity));

const number = (value) => (typeof value === "number" ? String(Number(value.toPrecision(4))) : "");
const amount = (name, { value } = {}) => (typeof value === "number" ? `${name} ${number(value)}` : "");
const joined = (...words) => words.filter(Boolean).join(", ");

function inspected(facts) {
  const { prims = {}, time = {}, settings = {} } = facts;
  const rows = [
    { word: "stage", text: joined(`${facts.up_axis} up`, `${facts.metres_per_unit} m per unit`, time.authored && `time codes ${time.start} to ${time.end}`) },
    { word: "prims", text: joined(...Object.entries(prims).map(([name, count]) => count && `${count} ${name === "all" ? "in all" : name}`)) },
    { word: "usual settings", text: joined(settings.tiers?.join(", "), `${settings.max_layers} surfaces`, counted(settings.samples, "sample")) },
    ...(facts.cameras ?? []).map(({ path, used }) => ({ word: used ? "camera, used" : "camera", path })),
    ...(facts.glass ?? []).map((one) => ({
      word: "glass", path: one.path, more: [`material ${one.material}`],
      text: joined(one.model, amount("index", one.ior), amount("roughness", one.roughness),
        one.thickness?.most != null && `thickness ${[...new Set([one.thickness.least, one.thickness.most].map(number))].join(" to ")}`),
    })),
    ...(facts.probes ?? []).map((one) => ({ word: "probe", path: one.path, text: joined(one.mode, one.covers?.length && `covers ${one.covers.join(", ")}`) })),
  ];
  const odd = [...(facts.suspicious ?? []), ...(facts.unsupported ?? [])];
  return { title: joined(counted(facts.glass?.length ?? 0, "glass object"), odd.length && `${counted(odd.length, "thing")} to look at`), rows: [...findingRows(odd), ...rows] };
}

function validated({ findings = [] }) {
  const counts = ORDER.map((severity) => findings.filter((one) => one.severity === severity).length);
  const said = counts.map((count, at) => count && counted(count, ["error", "warning", "remark"][at])).filter(Boolean);
  return { title: said.join(", ") || "Nothing is wrong with it", rows: findingRows(findings) };
}

function converted({ materials = [], notices = [] }) {
  const done = materials.filter(({ action }) => action === "applied").length;
  const rows = materials.map((one) => ({
    word: one.action, path: one.path, text: joined(one.action !== "skipped" && one.model, one.ior && `index ${number(one.ior)}`), more: [one.why, ...(one.notes ?? [])],
  }));
  return { title: done ? `${counted(done, "material")} described` : "No material had to be described", rows: [...findingRows(notices), ...rows] };
}

const SHOWN = { inspect: inspected, validate: validated, convert: converted };

async function ask(kind) {
  asking?.abort();
  const mine = (asking = new AbortController());
  const { source } = state;
  given = null;
  show(`${DOING[kind]} ${source.name} …`, []);
  try {
    const { body, headers } = bodyOf({});
    const answer = await send(`v1/${kind}`, { method: "POST", body, headers: { ...headers, Accept: "application/json" }, signal: mine.signal });
    const job = /jobs\/([^/]+)/.exec(answer.headers.get("Content-Location") ?? "")?.[1];
    const found = await answer.json();
    if (asking !== mine) return;
    given = { kind, source, job, found };
    const { title, rows } = SHOWN[kind](found);
    show(title, rows);
    $("checked").focus({ preventScroll: true });
  } catch (error) {
    if (asking !== mine) return;
    closeChecks();
    report(error);
  }
}

function show(title, rows) {
  $("checked").hidden = false;
  $("checked-title").textContent = title;
  $("checked-found").replaceChildren(...(rows.length ? [listOf(rows)] : []));
  $("take-report").hidden = !given;
  $("take-stage").hidden = given?.kind !== "convert" || !given.job;
  for (const kind of KINDS) $(kind).setAttribute("aria-pressed", String(given?.kind === kind));
}

export function closeChecks() {
  asking?.abort();
  asking = given = null;
  show("", []);
  $("checked").hidden = true;
}

const named = (ending) => pictureName(given.source.name).replace(/png$/, ending);

async function takeStage() {
  const name = named("converted.usdz");
  try {
    download(await (await send(`v1/jobs/${given.job}/file`, { headers: { Accept: "model/vnd.usdz+zip" } })).blob(), name);
  } catch (error) {
    report(error);
  }
}

export function wireChecks() {
  for (const kind of KINDS) $(kind).onclick = () => ask(kind);
  $("take-stage").onclick = takeStage;
  $("take-report").onclick = () => download(new Blob([JSON.stringify(given.found, null, 2)], { type: "application/json" }), named(`${given.kind}.json`));
  $("checked-close").onclick = () => {
    const kind = given?.kind ?? "validate";
    closeChecks();
    $(kind).focus();
  };
}
