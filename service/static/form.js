// The form of settings: its controls show the side being edited, and change it.

import { $, make } from "./dom.js";
import { drawGlass, showGlass } from "./glass.js";
import { changed, renderAll, stop } from "./jobs.js";
import { turnTo } from "./orbit.js";
import { NUMBERS, ORBIT } from "./settings.js";
import { SIDES, state, tell, update } from "./state.js";
import { drawTiers } from "./tiers.js";
import { MODELS, MODEL_HELP } from "./words.js";

/** Controls that depend on what is in the stage; without one, none. */
export function drawChoices() {
  const facts = state.facts ?? {};
  const cameras = (facts.cameras ?? []).map(({ path }) => make("option", { value: path, textContent: path }));
  $("set-camera").replaceChildren(make("option", { value: "", textContent: "automatic" }), ...cameras);
  $("time-field").hidden = !facts.time?.authored || facts.time.start === facts.time.end;
  if (!$("time-field").hidden) {
    Object.assign($("set-time_code"), { placeholder: facts.time.start, min: facts.time.start, max: facts.time.end });
  }
  drawGlass(facts);
}

/** What a moving camera changes of the form. */
export function showCamera() {
  const settings = state.settings[state.edit];
  for (const name of ORBIT) if (document.activeElement !== $(`set-${name}`)) $(`set-${name}`).value = settings[name] ?? "";
  $("set-camera").value = settings.camera;
}

/** Every control of the form shows the side being edited. */
export function showSettings() {
  const settings = state.settings[state.edit];
  for (const name of NUMBERS) if (document.activeElement !== $(`set-${name}`)) $(`set-${name}`).value = settings[name] ?? "";
  showCamera();
  if ($("set-camera").value !== settings.camera) $("set-camera").append(make("option", { value: settings.camera, textContent: settings.camera, selected: true }));
  $("set-screen").value = settings.screen;
  $("set-model").value = settings.model;
  showGlass(settings.overrides);
  drawTiers(settings.tiers);
  for (const mark of document.querySelectorAll(".side")) mark.textContent = state.compare ? `(${state.edit.toUpperCase()})` : "";
  $("compare").checked = state.compare;
  $("editing").hidden = !state.compare;
  $(`edit-${state.edit}`).checked = true;
}

function setCompare(on) {
  if (!on) stop("b");
  Object.assign(state, { compare: on, edit: on ? state.edit : "a" });
  tell("all");
  changed();
}

const copyOf = (settings) => structuredClone(settings);

const PRESETS = {
  model: [{ model: "sphere" }, { model: "traced" }],
  screen: [{ screen: "traced" }, { screen: "proxy" }],
  tiers: [{ tiers: ["screen", "probe", "ray", "sky"] }, { tiers: ["ray", "sky"] }],
  layers: [{}, { max_layers: 1 }],
};

function applyPreset(name) {
  if (!PRESETS[name]) return;
  const base = state.settings[state.edit];
  const [a, b] = PRESETS[name].map((part) => copyOf({ ...base, ...part }));
  state.settings = { a, b };
  setCompare(true);
}

export function wireSettings() {
  for (const name of NUMBERS) {
    $(`set-${name}`).oninput = ({ target }) => {
      const value = target.value === "" ? null : Number(target.value);
      if (ORBIT.includes(name) && value !== null) turnTo({ [name]: value });
      else if (value !== null || ORBIT.includes(name) || name === "time_code") update({ [name]: value });
    };
    $(`set-${name}`).onblur = showSettings;
  }
  for (const name of ["camera", "screen", "model"]) $(`set-${name}`).onchange = ({ target }) => update({ [name]: target.value });
  $("set-model").append(...MODELS.map((model) => make("option", { value: model, textContent: model, title: MODEL_HELP[model] })));
  $("compare").onchange = ({ target }) => {
    if (target.checked) state.settings.b = copyOf(state.settings.a);
    state.edit = target.checked ? "b" : "a";
    setCompare(target.checked);
  };
  for (const side of SIDES) $(`edit-${side}`).onchange = () => { state.edit = side; tell("all"); };
  $("same").onclick = () => { state.settings.b = copyOf(state.settings.a); tell("all"); changed(); };
  $("preset").onchange = ({ target }) => { applyPreset(target.value); target.value = ""; };
  $("settings").onsubmit = (event) => { event.preventDefault(); renderAll(); };
}
