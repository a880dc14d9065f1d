// What the service says of the file itself: what is in it, what is wrong with it, and the stages it makes of it: its glass as the
// renderer's own material, and what is worked out once and kept.

import { bodyOf, send } from "./api.js";
import { fileName } from "./commands.js";
import { $, counted, download, make } from "./dom.js";
import { report } from "./problems.js";
import { state } from "./state.js";
import { MODELS } from "./words.js";

const MOST = 200; // findings shown; the file has them all
const ORDER = ["error", "warning", "info"];
const DOING = {
  inspect: "Inspecting", validate: "Validating", convert: "Converting", "bake-thickness": "Measuring the glass of", "bake-probes": "Baking the probes of",
};
const KINDS = Object.keys(DOING);
const MADE = { convert: "converted.usdz", "bake-thickness": "thickness.usdz", "bake-probes": "probes.usdz" }; // verbs that make a stage
// What may be asked of them: the setting, what it is called, what it is when nothing is chosen, and what else it may be.
const texels = (...counts) => counts.map((count) => [count, `${count} x ${count}`]);
const OPTIONS = {
  convert: [
    ["model", "Model", "as found", MODELS.map((model) => [model, model])],
    ["thickness", "Thickness", "as typed", [["measured", "measured"]]],
    ["to", "Also described for", "nothing else", [["preview", "UsdPreviewSurface"], ["openpbr", "OpenPBR"], ["gltf", "glTF"]]],
  ],
  "bake-thickness": [
    ["along", "Measured along", "the way straight in", [["refracted", "the refracted way"]]],
    ["texture", "Kept in", "primvars", texels(256, 512, 1024)],
  ],
  "bake-probes": [["resolution", "Texels of a face", "each probe's own", texels(64, 128, 256)]],
};
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

function baked({ summary, prims = [], notices = [] }) {
  return { title: summary, rows: [...findingRows(notices), ...prims.map((one) => ({ word: "done", ...one }))] };
}

const SHOWN = { inspect: inspected, validate: validated, convert: converted, "bake-thickness": baked, "bake-probes": baked };

async function ask(kind, settings = {}) {
  asking?.abort();
  const mine = (asking = new AbortController());
  const { source } = state;
  given = null;
  if (!Object.keys(settings).length) drawOptions(kind);
  show(`${DOING[kind]} ${source.name} …`, []);
  try {
    const { body, headers } = bodyOf(settings);
    const answer = await send(`v1/${kind}`, { method: "POST", body, headers: { ...headers, Accept: "application/json" }, signal: mine.signal });
    const job = /jobs\/([^/]+)/.exec(answer.headers.get("Content-Location") ?? "")?.[1];
    const found = await answer.json();
    if (asking !== mine) return;
    given = { kind, source, job, found };
    const { title, rows } = SHOWN[kind](found);
    show(title, rows);
    if (!$("checked-options").contains(document.activeElement)) $("checked").focus({ preventScroll: true });
  } catch (error) {
    if (asking !== mine) return;
    closeChecks();
    report(error);
  }
}

/** Choices of a verb that makes a stage; another choice asks again. */
function drawOptions(kind) {
  const fields = (OPTIONS[kind] ?? []).map(([name, label, rest, values]) => {
    const choice = make("select", { id: `option-${name}`, onchange: () => ask(kind, chosen()) },
      make("option", { value: "", textContent: rest }), ...values.map(([value, textContent]) => make("option", { value, textContent })));
    return { name, values, choice, node: make("span", { className: "field inline" }, make("label", { htmlFor: choice.id, textContent: label }), choice) };
  });
  const chosen = () => Object.fromEntries(fields.filter(({ choice }) => choice.value)
    .map(({ name, values, choice }) => [name, values[choice.selectedIndex - 1][0]]));
  $("checked-options").replaceChildren(...fields.map(({ node }) => node));
  $("checked-options").hidden = !fields.length;
}

function show(title, rows) {
  $("checked").hidden = false;
  $("checked-title").textContent = title;
  $("checked-found").replaceChildren(...(rows.length ? [listOf(rows)] : []));
  $("take-report").hidden = !given;
  $("take-stage").hidden = !MADE[given?.kind] || !given.job;
  for (const kind of KINDS) $(kind).setAttribute("aria-pressed", String(given?.kind === kind));
}

export function closeChecks() {
  asking?.abort();
  asking = given = null;
  show("", []);
  $("checked").hidden = true;
}

const named = (ending) => fileName(given.source.name, ending);

async function takeStage() {
  const name = named(MADE[given.kind]);
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
