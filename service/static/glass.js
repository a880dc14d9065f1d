// The controls of the glass in the stage, one group per material.

import { $, make } from "./dom.js";
import { MODELS } from "./words.js";
import { state, update } from "./state.js";

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

/** A group for each material of the stage that is glass. */
export function drawGlass(facts) {
  const materials = new Map();
  for (const piece of facts.glass ?? []) materials.set(piece.material, [...(materials.get(piece.material) ?? []), piece]);
  $("glass-none").hidden = materials.size > 0 || !facts.glass;
  $("glass-none").textContent = "No glass was found in this stage.";
  $("glass").replaceChildren(...[...materials].map(([path, pieces], place) => glassControls(path, pieces, place)));
}

/** The controls as `overrides` has them; the one that is being typed into is left alone. */
export function showGlass(overrides) {
  for (const node of document.querySelectorAll("#glass [data-path]")) {
    const value = overrides[node.dataset.path]?.[node.dataset.name];
    if (node.type === "checkbox") node.checked = Boolean(overrides[node.dataset.path]?.transmittanceColor);
    else if (node.type === "color") node.value = value ? hexOf(value) : node.dataset.rest;
    else if (document.activeElement !== node) node.value = value ?? "";
    const slider = node.type === "number" ? $(`${node.id}-slider`) : null;
    if (slider && document.activeElement !== slider) slider.value = value ?? slider.dataset.rest;
  }
}

function glassControls(path, pieces, place) {
  const [first] = pieces;
  const unit = state.facts.metres_per_unit || 1;
  const size = Math.max(...pieces.flatMap((piece) => piece.size), 0.01) / unit;
  const length = (most, metres) => [short(size / 200), short(Math.max(most * size, 2 * metres / unit)), short(size / 200), metres / unit];
  const rows = [
    ["ior", "Index of refraction", 1, 3, 0.01, first.ior.value, first.ior.by],
    ["thickness", "Thickness, scene units", ...length(2, first.thickness.most)],
    ["roughness", "Roughness", 0, 1, 0.01, first.roughness.value, first.roughness.by],
    ["absorptionDistance", "Absorption distance, scene units", ...length(4, first.absorption_distance)],
  ];
  const authored = first.transmittance_color;
  const names = pieces.map((piece) => piece.path.split("/").pop()).join(", ");
  const reset = make("button", { type: "button", textContent: "As authored", onclick: () => { setOverride(path, {}); } });
  reset.setAttribute("aria-label", `${names}: as authored`);
  const models = [["", "as authored"], ...MODELS.map((model) => [model, model])];
  const id = (name) => `glass-${place}-${name}`;
  const known = (name) => ({ id: id(name), oninput: override, onchange: override });
  const model = make("select", known("model"), ...models.map(([value, textContent]) => make("option", { value, textContent })));
  const tinted = make("input", { type: "checkbox", ...known("tinted") });
  const colour = make("input", { type: "color", ...known("transmittanceColor") });
  colour.dataset.rest = hexOf(authored.value ?? [1, 1, 1]);
  colour.setAttribute("aria-label", `${names}: colour after the absorption distance`);
  for (const [node, name] of [[model, "model"], [tinted, "tinted"], [colour, "transmittanceColor"]]) Object.assign(node.dataset, { path, name });
  return make("details", { open: place === 0, ariaLabel: names },
    make("summary", {}, names, make("span", { className: "quiet", textContent: path })),
    make("div", { className: "field" }, make("label", { htmlFor: model.id, textContent: `Model (authored: ${first.model})` }), model),
    ...rows.map((row) => numberControl(path, names, id(row[0]), row, known)),
    make("div", { className: "field" }, make("label", { className: "tick" }, tinted, authored.value ? "Other absorption colour" : `Absorption colour (by ${authored.by})`), colour), reset);
}

const short = (value) => Number(value.toPrecision(3));

function numberControl(path, names, id, [name, label, min, max, step, authored, by = ""], known) {
  const number = make("input", { type: "number", min, step: "any", placeholder: authored === null ? `by ${by}` : short(authored), ...known(name) });
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
