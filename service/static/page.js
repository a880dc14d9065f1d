// The page of the service. No framework, no build step: what is exported needs no document (so that tests reach it), the
// rest begins at start(). Text from stages and from the service reaches the page as text only, never as markup.

export const TIERS = ["screen", "ray", "probe", "sky"];
export const MODELS = ["none", "sphere", "box", "thin", "traced"];
export const SCREENS = ["march", "proxy"];
const NUMBERS = ["image_width", "image_height", "samples", "max_layers", "exposure", "time_code"];
const GLASS_NUMBERS = ["ior", "thickness", "roughness", "absorptionDistance"];
const ACTIVE = ["sending", "queued", "running"];
const SIDES = ["a", "b"];
// Planes of one number per pixel are drawn in false colour. Those with a unit are not between 0 and 1: white in their
// PNG stands for what the job's record says.
const UNITS = { thickness: " m", path_length: " m", layers: "" };
const SCALARS = ["weight.screen", "weight.ray", "weight.probe", "weight.sky", "weight.none", "confidence", "mask", ...Object.keys(UNITS)];
export const AOVS = [...SCALARS, "refraction", "reflection", "transmittance", "N"];
// Dark to light in steps of even lightness, so that the order survives colour blindness and grey print.
const RAMP = [[24, 15, 61], [66, 40, 133], [33, 102, 153], [20, 150, 136], [110, 191, 84], [236, 221, 92], [255, 250, 220]];

// --- settings -------------------------------------------------------------------------------------------------------

/** What a render of this stage does when nothing is asked, and a size that suits a page. */
export function defaultSettings(facts) {
  const authored = facts?.settings ?? {};
  return {
    camera: "", time_code: null, image_width: 480, image_height: 0, samples: authored.samples ?? 4, exposure: 0,
    tiers: [...(authored.tiers ?? ["screen", "probe", "sky"])], screen: "march", model: "",
    max_layers: authored.max_layers ?? 4, overrides: {},
  };
}

/** The request's settings: what differs from what the stage would do by itself, and always the width. */
export function requestSettings(settings, facts) {
  const usual = defaultSettings(facts);
  const request = { image_width: settings.image_width };
  for (const [name, value] of Object.entries(settings)) {
    if (JSON.stringify(value) !== JSON.stringify(usual[name])) request[name] = value;
  }
  return request;
}

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
const isColour = (value) => Array.isArray(value) && value.length === 3 && value.every(isNumber);

/** Settings out of a link: known names with values of their kind; all else is dropped. */
export function cleanSettings(given, facts) {
  const clean = defaultSettings(facts);
  if (!given || typeof given !== "object") return clean;
  for (const name of NUMBERS) if (isNumber(given[name])) clean[name] = given[name];
  if (typeof given.camera === "string") clean.camera = given.camera;
  if (SCREENS.includes(given.screen)) clean.screen = given.screen;
  if (MODELS.includes(given.model)) clean.model = given.model;
  const tiers = Array.isArray(given.tiers) ? TIERS.filter((tier) => given.tiers.includes(tier)) : [];
  if (tiers.length) clean.tiers = tiers.sort((one, two) => given.tiers.indexOf(one) - given.tiers.indexOf(two));
  for (const [path, override] of Object.entries(given.overrides ?? {})) {
    const kept = cleanOverride(override);
    if (path.startsWith("/") && Object.keys(kept).length) clean.overrides[path] = kept;
  }
  return clean;
}

function cleanOverride(override) {
  const kept = {};
  for (const name of GLASS_NUMBERS) if (isNumber(override?.[name])) kept[name] = override[name];
  if (MODELS.includes(override?.model)) kept.model = override.model;
  if (isColour(override?.transmittanceColor)) kept.transmittanceColor = [...override.transmittanceColor];
  return kept;
}

/** The part of a link after #: the stage, both settings, and what is looked at. */
export function toFragment(state) {
  const words = new URLSearchParams();
  if (state.source) words.set(state.source.file ? "file" : "stage", state.source.name);
  words.set("a", JSON.stringify(requestSettings(state.settings.a, state.facts)));
  if (state.compare) words.set("b", JSON.stringify(requestSettings(state.settings.b, state.facts)));
  if (state.view !== "beauty") words.set("view", state.view);
  if (state.compare && state.split !== 50) words.set("split", String(state.split));
  return words.toString();
}

/** {stage, file, a, b, view, split}; the settings are as found, for cleanSettings. */
export function fromFragment(text) {
  const words = new URLSearchParams(text.replace(/^#/, ""));
  const parsed = (name) => {
    try { return JSON.parse(words.get(name) ?? "null"); } catch { return null; }
  };
  const split = Number(words.get("split") ?? 50);
  return {
    stage: words.get("stage") ?? "", file: words.get("file") ?? "", a: parsed("a"), b: parsed("b"),
    view: words.get("view") ?? "beauty", split: split >= 0 && split <= 100 ? split : 50,
  };
}

// --- commands -------------------------------------------------------------------------------------------------------

/** One word of a POSIX shell. */
export function quoted(word) {
  return /^[\w./:,=@%+-]+$/.test(word) ? word : `'${word.replaceAll("'", `'\\''`)}'`;
}

/** The same render by curl. A file is named as it was here: run it beside that file. */
export function asCurl(url, source, request) {
  const end = `${quoted(url)} -o ${quoted(pictureName(source.name))}`;
  if (!source.file) {
    const body = JSON.stringify({ stage: source.name, ...request });
    return `curl --fail-with-body -H 'Content-Type: application/json' -d ${quoted(body)} ${end}`;
  }
  const file = /[;,"\\]/.test(source.name) ? `"${source.name.replace(/[\\"]/g, "\\$&")}"` : source.name;
  return `curl --fail-with-body -F ${quoted(`stage=@${file}`)} --form-string ${quoted(`settings=${JSON.stringify(request)}`)} ${end}`;
}

const pictureName = (name) => `${name.replace(/^.*\//, "").replace(/\.usd[acz]?$/i, "")}.png`;

/** The same render by the command line. Overrides of single materials become a layer over the stage. */
export function asCli(source, request, facts) {
  const { overrides = {}, time_code: time = null, ...flags } = request;
  const changed = Object.keys(overrides).length > 0;
  const layer = pictureName(source.name).replace(/\.png$/, "_changed.usda");
  const hashes = time === null ? "" : Number.isInteger(time) ? ".####" : ".####.###";
  const words = ["refract", "render", changed ? layer : source.name, pictureName(source.name).replace(/\.png$/, `${hashes}.png`)];
  for (const [name, value] of Object.entries(flags)) {
    const flag = `--${name.replaceAll("_", "-")}`;
    words.push(...(value < 0 ? [`${flag}=${value}`] : [flag, String(value)]));
  }
  if (time !== null) words.push(...(time < 0 ? [`--frames=${time}`] : ["--frames", String(time)]));
  const command = words.map(quoted).join(" ");
  if (!changed) return command;
  const rough = Object.keys(overrides).filter((path) => "roughness" in overrides[path]);
  const notes = rough.map((path) => `# roughness ${overrides[path].roughness} of ${path}: set it in its surface shader\n`);
  return `${notes.join("")}cat > ${quoted(layer)} <<'USDA'\n${overLayer(source.name, overrides, facts)}USDA\n${command}`;
}

function overLayer(stage, overrides, facts) {
  const asset = stage.includes("@") ? `@@@./${stage}@@@` : `@./${stage}@`;
  const lines = ["#usda 1.0", "(", `    subLayers = [${asset}]`];
  if (facts) lines.push(`    upAxis = "${facts.up_axis}"`, `    metersPerUnit = ${facts.metres_per_unit}`);
  if (facts?.time?.authored) lines.push(`    startTimeCode = ${facts.time.start}`, `    endTimeCode = ${facts.time.end}`);
  lines.push(")");
  const tree = {};
  for (const [path, override] of Object.entries(overrides)) {
    let node = tree;
    for (const name of path.split("/").filter(Boolean)) node = (node[name] ??= { inside: {} }).inside;
    Object.defineProperty(node, "override", { value: override });
  }
  return `${[...lines, ...overs(tree, "")].join("\n")}\n`;
}

function overs(tree, indent) {
  return Object.entries(tree).flatMap(([name, { inside }]) => [
    `${indent}over "${name}"${inside.override ? ` (\n${indent}    prepend apiSchemas = ["RefractMaterialAPI"]\n${indent})` : ""}`,
    `${indent}{`, ...opinions(inside.override ?? {}, `${indent}    `), ...overs(inside, `${indent}    `), `${indent}}`,
  ]);
}

function opinions(override, indent) {
  const lines = override.model ? [`${indent}uniform token refraction:model = "${override.model}"`] : [];
  for (const name of ["ior", "thickness", "absorptionDistance"]) {
    if (name in override) lines.push(...constant("float", name, override[name], indent));
  }
  const colour = override.transmittanceColor;
  return colour ? [...lines, ...constant("color3f", "transmittanceColor", `(${colour.join(", ")})`, indent)] : lines;
}

/** A value, and no connection: else a map would still win over it. */
const constant = (type, name, value, indent) => [
  `${indent}${type} inputs:refraction:${name} = ${value}`, `${indent}${type} inputs:refraction:${name}.connect = None`,
];

// --- wire and colour ------------------------------------------------------------------------------------------------

/** Server-sent events in `text`: those that are whole, and the rest of the text. */
export function parseEvents(text) {
  const blocks = text.replaceAll("\r\n", "\n").split("\n\n");
  const rest = blocks.pop();
  const found = [];
  for (const block of blocks) {
    const event = { event: "message", data: "" };
    for (const line of block.split("\n")) {
      const [, name, value] = /^([^:]*):? ?(.*)$/.exec(line);
      if (name === "event") event.event = value;
      if (name === "data") event.data += (event.data && "\n") + value;
    }
    if (event.data) found.push(event);
  }
  return [found, rest];
}

/** [red, green, blue] 0 .. 255 of a share 0 .. 1. */
export function falseColour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((from, channel) => Math.round(from + (RAMP[low + 1][channel] - from) * (at - low)));
}

/** A colour picker's #rrggbb (sRGB) as linear numbers, and back. */
export function linearOf(hex) {
  return [1, 3, 5].map((at) => {
    const value = parseInt(hex.slice(at, at + 2), 16) / 255;
    return Number((value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4).toFixed(4));
  });
}
export function hexOf(linear) {
  return `#${linear.map((value) => {
    const shown = value <= 0.0031308 ? value * 12.92 : 1.055 * value ** (1 / 2.4) - 0.055;
    return Math.round(Math.min(Math.max(shown, 0), 1) * 255).toString(16).padStart(2, "0");
  }).join("")}`;
}

/** The parts of a JSON pointer. */
export const pointerParts = (pointer) =>
  String(pointer).replace(/^#/, "").split("/").slice(1).map((part) => part.replaceAll("~1", "/").replaceAll("~0", "~"));

// --- the page -------------------------------------------------------------------------------------------------------

const state = {
  source: null, facts: null, settings: { a: defaultSettings(), b: defaultSettings() }, edit: "a", compare: false,
  view: "beauty", split: 50, runs: { a: null, b: null }, token: "",
};
const $ = (id) => document.getElementById(id);
const sides = () => (state.compare ? SIDES : ["a"]);
const sleep = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

function make(tag, props = {}, ...children) {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
}

/** A problem document that the service sent, or one made here in its shape. */
class Problem extends Error {
  constructor(document) {
    super(document.title);
    this.document = document;
  }
}

async function send(path, options = {}) {
  const headers = new Headers(options.headers);
  if (state.token) headers.set("Authorization", `Bearer ${state.token}`);
  let answer;
  try {
    answer = await fetch(new URL(path, document.baseURI), { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ title: "The service cannot be reached", detail: "Check that it is running, then try again." });
  }
  if (answer.ok) return answer;
  const body = await answer.json().catch(() => ({ title: `The service answered ${answer.status}`, detail: answer.statusText }));
  const wait = answer.headers.get("Retry-After");
  if (wait) body.detail = `${body.detail ?? ""} Try again in ${wait} s.`.trim();
  if (answer.status === 401) $("token-field").hidden = false;
  throw new Problem(body);
}

/** Multipart for a file of the visitor's, JSON for a stage of the server's. */
function bodyOf(settings) {
  if (!state.source.file) {
    return { body: JSON.stringify({ stage: state.source.name, ...settings }), headers: { "Content-Type": "application/json" } };
  }
  const form = new FormData();
  form.set("stage", state.source.file, state.source.name);
  if (Object.keys(settings).length) form.set("settings", JSON.stringify(settings));
  return { body: form, headers: {} };
}

function say(text) {
  if ($("status").textContent !== text) $("status").textContent = text;
}

function showProblem(problem, side = "") {
  const box = $("problem");
  const lines = (problem.errors ?? []).map(({ pointer, detail }) => {
    const control = controlOf(pointer);
    const where = make(control ? "a" : "code", { textContent: pointer });
    if (control) {
      control.setAttribute("aria-invalid", "true");
      Object.assign(where, { href: `#${control.id}`, onclick: (event) => { event.preventDefault(); openTo(control); } });
    }
    return make("li", {}, where, ` ${detail ?? ""}`);
  });
  box.replaceChildren(make("h3", { textContent: `${side && state.compare ? `${side.toUpperCase()}: ` : ""}${problem.title ?? "Failed"}` }));
  if (problem.detail) box.append(make("p", { textContent: problem.detail }));
  if (problem.prim) box.append(make("p", { textContent: `Prim: ${problem.prim}` }));
  if (lines.length) box.append(make("ul", {}, ...lines));
  box.hidden = false;
}

function clearProblem() {
  $("problem").hidden = true;
  for (const marked of document.querySelectorAll("[aria-invalid]")) marked.removeAttribute("aria-invalid");
}

function controlOf(pointer) {
  const parts = pointerParts(pointer).filter((part) => part !== "settings");
  if (parts[0] !== "overrides") return parts[0] ? $(`set-${parts[0]}`) : null;
  return [...document.querySelectorAll("#glass [data-path]")].find(
    ({ dataset }) => dataset.path === parts[1] && dataset.name === parts[2]) ?? null;
}

function openTo(control) {
  control.closest("details")?.setAttribute("open", "");
  control.focus();
}

// --- stage ----------------------------------------------------------------------------------------------------------

async function listSamples() {
  try {
    const { stages } = await (await send("v1/stages")).json();
    const names = stages.map(({ path }) => path);
    $("sample").replaceChildren(make("option", { value: "", textContent: "none" }),
      ...names.map((name) => make("option", { value: name, textContent: name })));
  } catch (error) {
    report(error);
  }
}

/** Look into a stage, then draw its controls. `link` carries the settings of a shared link. */
async function choose(source, link = null) {
  stopAll();
  const waiting = (state.source = source);
  Object.assign(state, { facts: null, runs: { a: null, b: null } });
  clearProblem();
  showAll();
  $("facts").textContent = `Looking into ${source.name} …`;
  try {
    const { body, headers } = bodyOf({});
    const facts = await (await send("v1/inspect", { method: "POST", body, headers })).json();
    if (state.source !== waiting) return;
    state.facts = facts;
  } catch (error) {
    if (state.source !== waiting) return;
    state.source = null;
    $("facts").textContent = `${source.name} could not be opened.`;
    report(error);
    return;
  }
  const wanted = link ?? (state.keep ? state.keep : null);
  state.keep = null;
  state.settings = { a: cleanSettings(wanted?.a, state.facts), b: cleanSettings(wanted?.b ?? wanted?.a, state.facts) };
  state.compare = Boolean(wanted?.b);
  $("facts").textContent = factsText(source.name, state.facts);
  drawChoices();
  showAll();
  changed();
}

function factsText(name, facts) {
  const objects = facts.glass?.length ?? 0;
  const worry = (facts.suspicious?.length ?? 0) + (facts.unsupported?.length ?? 0);
  return `${name}: ${counted(objects, "glass object")}, ${counted(facts.cameras?.length ?? 0, "camera")}, ` +
    `${counted(facts.probes?.length ?? 0, "probe")}, ${facts.up_axis} up, ${facts.metres_per_unit} m per unit` +
    (worry ? `; ${counted(worry, "thing")} to look at, under Notices.` : ".");
}

const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

/** Controls that depend on what is in the stage. */
function drawChoices() {
  const { facts } = state;
  const cameras = (facts.cameras ?? []).map(({ path }) => make("option", { value: path, textContent: path }));
  $("set-camera").replaceChildren(make("option", { value: "", textContent: "automatic" }), ...cameras);
  $("time-field").hidden = !facts.time?.authored || facts.time.start === facts.time.end;
  if (!$("time-field").hidden) {
    Object.assign($("set-time_code"), { placeholder: facts.time.start, min: facts.time.start, max: facts.time.end });
  }
  const materials = new Map();
  for (const piece of facts.glass ?? []) materials.set(piece.material, [...(materials.get(piece.material) ?? []), piece]);
  $("glass-none").hidden = materials.size > 0;
  $("glass-none").textContent = "No glass was found in this stage.";
  $("glass").replaceChildren(...[...materials].map(([path, pieces], place) => glassControls(path, pieces, place)));
}

function glassControls(path, pieces, place) {
  const [first] = pieces;
  const unit = state.facts.metres_per_unit || 1;
  const size = Math.max(...pieces.flatMap((piece) => piece.size), 0.01) / unit;
  const thick = first.thickness.most / unit;
  const rows = [
    ["ior", "Index of refraction", 1, 3, 0.01, first.ior.value],
    ["thickness", "Thickness, scene units", short(size / 200), short(size * 2), short(size / 200), thick],
    ["roughness", "Roughness", 0, 1, 0.01, null],
    ["absorptionDistance", "Absorption distance, scene units", short(size / 200), short(size * 4), short(size / 200), null],
  ];
  const names = pieces.map((piece) => piece.path.split("/").pop()).join(", ");
  const reset = make("button", { type: "button", textContent: "As authored", onclick: () => { setOverride(path, {}); } });
  reset.setAttribute("aria-label", `${names}: as authored`);
  const models = [["", "as authored"], ...MODELS.map((model) => [model, model])];
  const id = (name) => `glass-${place}-${name}`;
  const known = (name) => ({ id: id(name), oninput: override, onchange: override });
  const model = make("select", known("model"), ...models.map(([value, textContent]) => make("option", { value, textContent })));
  const tinted = make("input", { type: "checkbox", ...known("tinted") });
  const colour = make("input", { type: "color", value: "#ffffff", ...known("transmittanceColor") });
  colour.setAttribute("aria-label", `${names}: colour after the absorption distance`);
  for (const [node, name] of [[model, "model"], [tinted, "tinted"], [colour, "transmittanceColor"]]) Object.assign(node.dataset, { path, name });
  return make("details", { open: place === 0, ariaLabel: names },
    make("summary", {}, names, make("span", { className: "quiet", textContent: path })),
    make("div", { className: "field" }, make("label", { htmlFor: model.id, textContent: `Model (authored: ${first.model})` }), model),
    ...rows.map((row) => numberControl(path, names, id(row[0]), row, known)),
    make("div", { className: "field" }, make("label", { className: "tick" }, tinted, "Absorption colour"), colour), reset);
}

const short = (value) => Number(value.toPrecision(3));

function numberControl(path, names, id, [name, label, min, max, step, authored], known) {
  const number = make("input", { type: "number", min, step: "any", placeholder: authored === null ? "as is" : short(authored), ...known(name) });
  const slider = make("input", { type: "range", min, max, step, id: `${id}-slider`, oninput: () => { number.value = slider.value; override({ target: number }); } });
  slider.dataset.rest = authored ?? min;
  slider.setAttribute("aria-label", `${names}: ${label}, slider`);
  Object.assign(number.dataset, { path, name });
  return make("div", { className: "field slider" }, make("label", { htmlFor: id, textContent: label }), slider, number);
}

/** An input of the glass controls changed. */
function override({ target }) {
  const { path, name } = target.dataset;
  const next = { ...state.settings[state.edit].overrides[path] };
  if (name === "tinted" || name === "transmittanceColor") {
    const box = [...$("glass").querySelectorAll("[data-name=tinted]")].find(({ dataset }) => dataset.path === path);
    const picker = box.closest(".field").querySelector("[type=color]");
    box.checked = name === "tinted" ? box.checked : true;
    if (box.checked) next.transmittanceColor = linearOf(picker.value);
    else delete next.transmittanceColor;
  } else if (target.value === "") {
    delete next[name];
  } else {
    next[name] = name === "model" ? target.value : Number(target.value);
  }
  setOverride(path, next);
}

function setOverride(path, next) {
  const { [path]: _, ...others } = state.settings[state.edit].overrides;
  const overrides = Object.keys(next).length ? { ...others, [path]: next } : others;
  update({ overrides });
}

function update(part) {
  Object.assign(state.settings[state.edit], part);
  showSettings();
  changed();
}

/** Every control of the form shows the side being edited. */
function showSettings() {
  const settings = state.settings[state.edit];
  for (const name of NUMBERS) if (document.activeElement !== $(`set-${name}`)) $(`set-${name}`).value = settings[name] ?? "";
  $("set-camera").value = settings.camera;
  if ($("set-camera").value !== settings.camera) $("set-camera").append(make("option", { value: settings.camera, textContent: settings.camera, selected: true }));
  $("set-screen").value = settings.screen;
  $("set-model").value = settings.model;
  for (const node of document.querySelectorAll("#glass [data-path]")) {
    const value = settings.overrides[node.dataset.path]?.[node.dataset.name];
    if (node.type === "checkbox") node.checked = Boolean(settings.overrides[node.dataset.path]?.transmittanceColor);
    else if (node.type === "color") node.value = value ? hexOf(value) : "#ffffff";
    else if (document.activeElement !== node) node.value = value ?? "";
    const slider = node.type === "number" ? $(`${node.id}-slider`) : null;
    if (slider && document.activeElement !== slider) slider.value = value ?? slider.dataset.rest;
  }
  drawTiers(settings.tiers);
  for (const mark of document.querySelectorAll(".side")) mark.textContent = state.compare ? `(${state.edit.toUpperCase()})` : "";
  $("compare").checked = state.compare;
  $("editing").hidden = !state.compare;
  $(`edit-${state.edit}`).checked = true;
}

// --- tier order -----------------------------------------------------------------------------------------------------

function drawTiers(chosen) {
  const held = document.activeElement?.id;
  $("tiers").replaceChildren(...[...chosen, ...TIERS.filter((tier) => !chosen.includes(tier))].map((tier) => tierRow(tier, chosen)));
  if (held?.startsWith("tier-")) ($(held)?.disabled ? $(`tier-${held.split("-")[1]}`) : $(held))?.focus();
}

function tierRow(tier, chosen) {
  const place = chosen.indexOf(tier);
  const used = make("input", { type: "checkbox", id: `tier-${tier}`, checked: place >= 0, disabled: place >= 0 && chosen.length === 1 });
  used.onchange = () => setTiers(used.checked ? [...chosen, tier] : chosen.filter((other) => other !== tier), tier);
  const button = (sign, word, step) => {
    const node = make("button", { type: "button", id: `tier-${tier}-${word}`, textContent: sign });
    node.disabled = place < 0 || place + step < 0 || place + step >= chosen.length;
    node.setAttribute("aria-label", `Move ${tier} ${word}`);
    node.onclick = () => setTiers(moved(chosen, tier, place + step), tier);
    return node;
  };
  const label = make("label", { className: "tick" }, used, place < 0 ? `${tier} (not asked)` : `${place + 1}. ${tier}`);
  const row = make("li", { draggable: place >= 0 }, label, button("↑", "up", -1), button("↓", "down", 1));
  row.ondragstart = (event) => event.dataTransfer.setData("text/tier", tier);
  row.ondragover = (event) => { if (event.dataTransfer.types.includes("text/tier")) { event.preventDefault(); row.classList.add("over"); } };
  row.ondragleave = () => row.classList.remove("over");
  row.ondrop = (event) => {
    const dragged = event.dataTransfer.getData("text/tier");
    event.preventDefault();
    if (TIERS.includes(dragged)) setTiers(moved(chosen, dragged, place < 0 ? chosen.length - 1 : place), dragged);
  };
  return row;
}

function moved(chosen, tier, to) {
  const others = chosen.filter((other) => other !== tier);
  return [...others.slice(0, to), tier, ...others.slice(to)];
}

function setTiers(tiers, tier) {
  update({ tiers });
  const place = tiers.indexOf(tier);
  $("moved").textContent = place < 0 ? `${tier} is not asked.` : `${tier} is number ${place + 1} of ${tiers.length}.`;
}

// --- jobs -----------------------------------------------------------------------------------------------------------

const requestOf = (side) => requestSettings(state.settings[side], state.facts);
const keyOf = (side) => JSON.stringify([state.source.name, requestOf(side)]);
let timer = 0;

/** Something about the wanted picture changed: keep the address current, and render soon if so wished. */
function changed() {
  if (!state.source) return;
  history.replaceState(null, "", `#${toFragment(state)}`);
  clearTimeout(timer);
  if ($("auto").checked && state.facts) timer = setTimeout(renderAll, 450);
  showProgress();
  showButtons();
}

function renderAll() {
  clearTimeout(timer);
  if (!state.facts) return;
  clearProblem();
  $("copied-field").hidden = true;
  for (const side of sides()) {
    const run = state.runs[side];
    if (run?.key === keyOf(side) && [...ACTIVE, "done"].includes(run.status)) continue;
    stop(side);
    submit(side);
  }
  showAll();
}

async function submit(side) {
  const before = shownRun(side);
  if (before) before.before = null; // one old picture is enough
  const run = { side, key: keyOf(side), status: "sending", fraction: 0, job: null, planes: {}, abort: new AbortController(), before };
  state.runs[side] = run;
  try {
    const { body, headers } = bodyOf({ ...requestOf(side), aovs: AOVS });
    const answer = await send("v1/render", { method: "POST", body, headers: { ...headers, Prefer: "respond-async", Accept: "image/png" } });
    if (answer.status === 202) {
      const place = answer.headers.get("Location") ?? "";
      take(run, { ...(await answer.json()), ...(place && { id: place.split("/").pop() }) });
    } else {
      const place = answer.headers.get("Content-Location") ?? answer.headers.get("Location") ?? "";
      const id = /jobs\/([^/]+)/.exec(place)?.[1] ?? (answer.headers.get("ETag") ?? "").replace(/^W\/|"/g, "");
      take(run, await (await send(`v1/jobs/${id}`)).json());
    }
    if (run.status === "cancelled") return void erase(run);
    await follow(run);
    if (run.status === "done") await plane(run, "beauty");
    else if (run.job.problem && state.runs[side] === run) showProblem(run.job.problem, side);
  } catch (error) {
    if (run.status === "cancelled" || error.name === "AbortError") return;
    run.status = "failed";
    if (state.runs[side] === run) report(error, side);
  }
  if (state.runs[side] === run) showAll();
}

/** Wait for the job's end: by its events, and by asking where those break off. */
async function follow(run) {
  for (let broken = 0; ACTIVE.includes(run.status);) {
    try {
      const answer = await send(`v1/jobs/${run.job.id}/events`, { headers: { Accept: "text/event-stream" }, signal: run.abort.signal });
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      for (let rest = "", part = await reader.read(); !part.done && ACTIVE.includes(run.status); part = await reader.read()) {
        const [events, left] = parseEvents(rest + part.value);
        rest = left;
        for (const { data } of events) take(run, JSON.parse(data));
      }
    } catch (error) {
      if (error.name === "AbortError" || (error instanceof Problem && error.document.status)) throw error;
      if (++broken > 5) throw error;
    }
    if (!ACTIVE.includes(run.status)) return run.abort.abort();
    await sleep(1000);
    take(run, await (await send(`v1/jobs/${run.job.id}`, { signal: run.abort.signal })).json());
  }
}

function take(run, job) {
  run.job = { ...run.job, ...job };
  if (run.status !== "cancelled") run.status = job.status ?? "queued";
  run.fraction = job.fraction ?? run.fraction;
  if (state.runs[run.side] === run) showProgress();
}

/** Give up a run; the job itself ends too, unless the other side waits for the same one. */
function stop(side) {
  const run = state.runs[side];
  if (!run || !ACTIVE.includes(run.status)) return;
  run.status = "cancelled";
  run.abort.abort();
  if (run.job?.id) erase(run);
}

function erase(run) {
  const shared = SIDES.some((side) => state.runs[side] !== run && state.runs[side]?.job?.id === run.job.id && ACTIVE.includes(state.runs[side].status));
  if (!shared) send(`v1/jobs/${run.job.id}`, { method: "DELETE", keepalive: true }).catch(() => {});
}

function stopAll() {
  clearTimeout(timer);
  for (const side of SIDES) stop(side);
}

function report(error, side = "") {
  if (error instanceof Problem) return showProblem(error.document, side);
  console.error(error);
  showProblem({ title: "The page met an error of its own", detail: "Reload it and try again." }, side);
}

/** Pixels of one plane of a finished run. */
function plane(run, name) {
  const path = name === "beauty" ? "image" : `aovs/${name}.png`;
  run.planes[name] ??= send(`v1/jobs/${run.job.id}/${path}`, { headers: { Accept: "image/png" } })
    .then((answer) => answer.blob())
    .then(async (blob) => {
      const bitmap = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
      const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(bitmap, 0, 0);
      return { blob, pixels: context.getImageData(0, 0, bitmap.width, bitmap.height) };
    })
    .catch((error) => {
      delete run.planes[name]; // so that it is asked for again
      throw error;
    });
  return run.planes[name];
}

// --- showing --------------------------------------------------------------------------------------------------------

function showAll() {
  showSettings();
  showProgress();
  showButtons();
  showNotices();
  paint();
}

function showProgress() {
  for (const side of SIDES) {
    const run = state.runs[side];
    const busy = sides().includes(side) && run && ACTIVE.includes(run.status);
    $(`row-${side}`).hidden = !state.facts || !sides().includes(side);
    $(`row-${side}`).classList.toggle("idle", !busy);
    if (!busy) continue;
    $(`progress-${side}`).value = run.fraction;
    $(`doing-${side}`).textContent = `${run.job?.stage_of_work || run.status}, ${Math.round(run.fraction * 100)} %`;
  }
  say(statusText());
  $("cancel").disabled = !sides().some((side) => ACTIVE.includes(state.runs[side]?.status));
}

/** A sentence for everybody; it moves in quarters, so that a screen reader is not flooded. */
function statusText() {
  if (!state.facts) return state.source ? "Looking into the stage." : "Pick a stage to begin.";
  const said = sides().map((side) => {
    const run = state.runs[side];
    const name = state.compare ? `${side.toUpperCase()} ` : "";
    if (!run) return "";
    if (run.key !== keyOf(side)) return `${name}${$("auto").checked ? "changed, about to render" : "changed, not rendered yet"}`;
    if (run.status === "running") return `${name}rendering, ${Math.floor(run.fraction * 4) * 25} %`;
    return `${name}${run.status}`;
  }).filter(Boolean);
  const text = said.join("; ");
  return text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "Ready to render.";
}

function showButtons() {
  const done = state.runs[state.edit]?.status === "done";
  $("render").disabled = !state.facts;
  for (const id of ["copy-curl", "copy-cli", "copy-link"]) $(id).disabled = !state.facts;
  for (const id of ["save-png", "save-exr"]) $(id).disabled = !done;
}

function showNotices() {
  const found = [...(state.facts?.suspicious ?? []), ...(state.facts?.unsupported ?? [])];
  const warned = sides().flatMap((side) => (state.runs[side]?.job?.warnings ?? []).map((warning) => ({ ...warning, side })));
  const lines = [...new Set([...found, ...warned].map(({ path, text, fix }) => `${path ? `${path}: ` : ""}${text}${fix ? ` (${fix})` : ""}`))];
  $("notices").hidden = !lines.length;
  $("notices-title").textContent = `Notices (${lines.length})`;
  $("notices-list").replaceChildren(...lines.map((textContent) => make("li", { textContent })));
}

/** What a side can show: its finished run, else the one before it, marked as old. */
function shownRun(side) {
  const run = state.runs[side];
  return run?.status === "done" ? run : run?.before ?? null;
}

let painting = 0;

async function paint() {
  const turn = ++painting;
  const shown = sides().map((side) => [side, shownRun(side)]).filter(([, run]) => run);
  const scalar = SCALARS.includes(state.view);
  let loaded = [];
  try {
    loaded = await Promise.all(shown.map(async ([side, run]) => {
      const names = scalar && state.view !== "mask" ? ["beauty", state.view, "mask"] : ["beauty", state.view];
      const [beauty, data, mask] = await Promise.all(names.map(async (name) => (await plane(run, name)).pixels));
      return { side, run, beauty, data, mask: mask ?? data };
    }));
  } catch (error) {
    if (turn === painting) report(error);
  }
  if (turn !== painting) return;
  const high = Math.max(1e-9, ...loaded.map(({ run }) => whiteOf(run)));
  for (const side of SIDES) {
    const one = loaded.find((entry) => entry.side === side);
    $(`canvas-${side}`).hidden = !one;
    if (one) draw($(`canvas-${side}`), one, scalar, high);
  }
  showFigure(loaded, scalar, high);
}

/** What white stands for in a run's PNG of the plane that is looked at. */
const whiteOf = (run) => run.job.aovs?.find(({ name }) => name === state.view)?.white ?? 1;

function draw(canvas, { side, run, beauty, data, mask }, scalar, high) {
  Object.assign(canvas, { width: data.width, height: data.height });
  canvas.classList.toggle("old", run !== state.runs[side]);
  canvas.getContext("2d").putImageData(scalar ? coloured(beauty, data, mask, whiteOf(run) / high) : data, 0, 0);
  const what = $("view").selectedOptions[0]?.textContent ?? state.view;
  canvas.setAttribute("aria-label", `${what} of ${state.source.name}, setting ${side.toUpperCase()}, ${data.width} by ${data.height} pixels`);
}

/** False colour where there is glass, the picture in dark grey elsewhere. White of `data` is `scale` of the ramp. */
function coloured(beauty, data, mask, scale) {
  const out = new ImageData(data.width, data.height);
  const ramp = Array.from({ length: 256 }, (_, value) => falseColour((value / 255) * scale));
  for (let at = 0; at < out.data.length; at += 4) {
    const grey = 0.35 * (0.3 * beauty.data[at] + 0.6 * beauty.data[at + 1] + 0.1 * beauty.data[at + 2]);
    const share = mask.data[at] / 255;
    const colour = ramp[data.data[at]];
    for (let channel = 0; channel < 3; channel++) out.data[at + channel] = share * colour[channel] + (1 - share) * grey;
    out.data[at + 3] = 255;
  }
  return out;
}

function showFigure(loaded, scalar, high) {
  const both = loaded.length === 2;
  $("empty").hidden = loaded.length > 0;
  for (const id of ["split-field", "divider", "tag-a", "tag-b"]) $(id).hidden = !both;
  $("canvas-b").style.clipPath = both ? `inset(0 0 0 ${state.split}%)` : "none";
  $("divider").style.left = `${state.split}%`;
  $("split").value = state.split;
  $("split").setAttribute("aria-valuetext", `A on the left ${state.split} %, B on the right ${100 - state.split} %`);
  $("legend").hidden = !scalar || !loaded.length;
  $("legend-low").textContent = `0${UNITS[state.view] ?? ""}`;
  $("legend-high").textContent = `${Number(high.toPrecision(3))}${UNITS[state.view] ?? ""}`;
  $("legend-text").textContent = "Grey: no glass.";
  $("legend-bar").style.background = `linear-gradient(90deg, ${RAMP.map((colour) => `rgb(${colour.join(" ")})`).join(", ")})`;
}

function setSplit(value) {
  state.split = Math.round(Math.min(Math.max(value, 0), 100));
  $("canvas-b").style.clipPath = `inset(0 0 0 ${state.split}%)`;
  $("divider").style.left = `${state.split}%`;
  $("split").value = state.split;
  $("split").setAttribute("aria-valuetext", `A on the left ${state.split} %, B on the right ${100 - state.split} %`);
}

// --- copying and saving ---------------------------------------------------------------------------------------------

/** To the clipboard where the browser allows it, and to a box that can always be selected. */
async function copy(what, text) {
  $("copied-field").hidden = false;
  $("copied").value = text;
  $("copied").rows = Math.min(text.split("\n").length + 2, 14);
  $("copied").select();
  const done = await navigator.clipboard?.writeText(text).then(() => true, () => false);
  $("copied-label").textContent = done ? `${what}, copied` : `${what}: select and copy`;
  say(done ? `${what} copied.` : `${what} is in the box below the picture.`);
}

function copyLink() {
  const link = new URL(location.href);
  link.hash = toFragment(state);
  copy(state.source.file ? `Link (whoever opens it needs ${state.source.name})` : "Link", link.href);
}

/** An EXR holds linear light and every plane, which the picture on the page does not: it is rendered for itself. */
async function exr() {
  say("Rendering the EXR file …");
  const { body, headers } = bodyOf(requestOf(state.edit));
  const answer = await send("v1/render", { method: "POST", body, headers: { ...headers, Accept: "image/x-exr" } });
  const blob = await answer.blob();
  say("The EXR file is ready.");
  return blob;
}

async function save(kind) {
  const run = state.runs[state.edit];
  try {
    const blob = kind === "png" ? (await plane(run, state.view)).blob : await exr();
    const link = make("a", { href: URL.createObjectURL(blob), download: pictureName(state.source.name).replace(/png$/, kind) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  } catch (error) {
    report(error);
  }
}

// --- wiring ---------------------------------------------------------------------------------------------------------

function setCompare(on) {
  if (!on) stop("b");
  Object.assign(state, { compare: on, edit: on ? state.edit : "a" });
  showAll();
  changed();
}

const copyOf = (settings) => structuredClone(settings);

const PRESETS = {
  model: [{ model: "sphere" }, { model: "traced" }],
  screen: [{ screen: "march" }, { screen: "proxy" }],
  tiers: [{ tiers: ["screen", "probe", "sky"] }, { tiers: ["ray", "sky"] }],
  layers: [{}, { max_layers: 1 }],
};

function applyPreset(name) {
  if (!PRESETS[name]) return;
  const base = state.settings[state.edit];
  const [a, b] = PRESETS[name].map((part) => copyOf({ ...base, ...part }));
  state.settings = { a, b };
  setCompare(true);
}

function openFile(file) {
  if (!file) return;
  $("sample").value = "";
  choose({ name: file.name, file });
}

function wireDrop() {
  const drop = $("drop");
  $("file").onchange = () => openFile($("file").files[0]);
  document.ondragover = (event) => {
    if (!event.dataTransfer.types.includes("Files")) return;
    event.preventDefault();
    drop.classList.add("over");
  };
  document.ondragleave = () => drop.classList.remove("over");
  document.ondrop = (event) => {
    drop.classList.remove("over");
    if (!event.dataTransfer.files.length) return;
    event.preventDefault();
    openFile(event.dataTransfer.files[0]);
  };
}

function wireSettings() {
  for (const name of NUMBERS) {
    $(`set-${name}`).oninput = ({ target }) => {
      if (target.value !== "") update({ [name]: Number(target.value) });
      else if (name === "time_code") update({ time_code: null });
    };
    $(`set-${name}`).onblur = showSettings;
  }
  for (const name of ["camera", "screen", "model"]) $(`set-${name}`).onchange = ({ target }) => update({ [name]: target.value });
  $("set-model").append(...MODELS.map((model) => make("option", { value: model, textContent: model })));
  $("compare").onchange = ({ target }) => {
    if (target.checked) state.settings.b = copyOf(state.settings.a);
    state.edit = target.checked ? "b" : "a";
    setCompare(target.checked);
  };
  for (const side of SIDES) $(`edit-${side}`).onchange = () => { state.edit = side; showAll(); };
  $("same").onclick = () => { state.settings.b = copyOf(state.settings.a); showAll(); changed(); };
  $("preset").onchange = ({ target }) => { applyPreset(target.value); target.value = ""; };
  $("settings").onsubmit = (event) => { event.preventDefault(); renderAll(); };
}

function wirePicture() {
  $("render").onclick = renderAll;
  $("cancel").onclick = () => { stopAll(); showAll(); $("render").focus(); };
  $("auto").onchange = changed;
  $("view").onchange = ({ target }) => { state.view = target.value; clearProblem(); paint(); history.replaceState(null, "", `#${toFragment(state)}`); };
  $("split").oninput = ({ target }) => setSplit(Number(target.value));
  const drag = (event) => {
    const box = $("views").getBoundingClientRect();
    if (event.buttons && !$("divider").hidden) setSplit(((event.clientX - box.left) / box.width) * 100);
  };
  $("views").onpointerdown = (event) => { $("views").setPointerCapture(event.pointerId); drag(event); };
  $("views").onpointermove = drag;
  $("copy-curl").onclick = () => copy("curl command", asCurl(new URL("v1/render", document.baseURI).href, state.source, requestOf(state.edit)));
  $("copy-cli").onclick = () => copy("Command", asCli(state.source, requestOf(state.edit), state.facts));
  $("copy-link").onclick = copyLink;
  $("save-png").onclick = () => save("png");
  $("save-exr").onclick = () => save("exr");
}

/** Do what the link says; also when somebody pastes another one over it. */
async function openLink() {
  const link = fromFragment(location.hash);
  Object.assign(state, { view: link.view, split: link.split });
  $("view").value = link.view;
  if ($("view").selectedIndex < 0) $("view").value = state.view = "beauty";
  if (link.stage) {
    $("sample").value = link.stage;
    await choose({ name: link.stage }, link);
  } else if (link.file) {
    state.keep = link;
    $("facts").textContent = `This link was made with a file called ${link.file}. Drop that file here to see it.`;
  }
}

async function start() {
  wireDrop();
  wireSettings();
  wirePicture();
  $("sample").onchange = ({ target }) => { if (target.value) { $("file").value = ""; choose({ name: target.value }); } };
  $("token-field").onsubmit = async (event) => {
    event.preventDefault();
    state.token = $("token").value.trim();
    clearProblem();
    await listSamples();
    if (!state.source) await openLink();
  };
  addEventListener("hashchange", openLink);
  addEventListener("pagehide", stopAll);
  showSettings();
  await listSamples();
  await openLink();
}

if (typeof document !== "undefined") start();
