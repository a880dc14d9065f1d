// Which stage is looked at: a sample of the server, or a file that is dropped or chosen.

import { Problem, bodyOf, send } from "./api.js";
import { closeChecks } from "./checks.js";
import { $, counted } from "./dom.js";
import { drawChoices } from "./form.js";
import { changed, stopAll } from "./jobs.js";
import { drawGallery } from "./gallery.js";
import { closeViewer } from "./live.js";
import { clearProblem, report } from "./problems.js";
import { cleanSettings } from "./settings.js";
import { state, tell } from "./state.js";

export async function listSamples() {
  try {
    const { stages } = await (await send("v1/stages")).json();
    drawGallery(stages, openSample);
  } catch (error) {
    report(error);
  }
}

/** The choice of stages stands alone while there is none, and is folded away while one is looked at. */
export function showChoice() {
  const folded = Boolean(state.source) && !state.choosing;
  $("main").classList.toggle("empty", !state.source);
  $("choice").hidden = folded;
  $("other").hidden = !state.source;
  $("checks").hidden = !state.facts;
  $("other").setAttribute("aria-expanded", String(!folded));
}

/** Look into a stage, then draw its controls. `link` carries the settings of a shared link. */
export async function choose(source, link = null) {
  stopAll();
  closeViewer();
  closeChecks();
  const waiting = (state.source = source);
  Object.assign(state, { choosing: false, playing: false, facts: null, runs: { a: null, b: null }, moving: { a: null, b: null } });
  clearProblem();
  tell("all");
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
    drawChoices();
    tell("all");
    report(error);
    return;
  }
  const wanted = link ?? (state.keep ? state.keep : null);
  state.keep = null;
  state.settings = { a: cleanSettings(wanted?.a, state.facts), b: cleanSettings(wanted?.b ?? wanted?.a, state.facts) };
  state.compare = Boolean(wanted?.b);
  $("facts").textContent = factsText(source.name, state.facts);
  drawChoices();
  tell("all");
  changed();
}

function factsText(name, facts) {
  const objects = facts.glass?.length ?? 0;
  const worry = (facts.suspicious?.length ?? 0) + (facts.unsupported?.length ?? 0);
  return `${name}: ${counted(objects, "glass object")}, ${counted(facts.cameras?.length ?? 0, "camera")}, ` +
    `${counted(facts.probes?.length ?? 0, "probe")}, ${facts.up_axis} up, ${facts.metres_per_unit} m per unit` +
    (worry ? `; ${counted(worry, "thing")} to look at, under Notices.` : ".");
}

const STAGE = /\.(usd[acz]?|glb|gltf|zip)$/i;

/** One stage and, where it needs them, the files beside it: a .gltf's buffer and textures. */
function openFiles(files) {
  const all = [...files];
  const stages = all.filter(({ name }) => STAGE.test(name));
  if (stages.length === 1) return choose({ name: stages[0].name, file: stages[0], parts: all.filter((one) => one !== stages[0]) });
  if (!all.length) return;
  clearProblem();
  report(new Problem(stages.length
    ? { title: "Which of them is the stage?", detail: `${stages.map(({ name }) => name).join(", ")} could each be. Take one of them with its textures, or a .zip or .usdz of all.` }
    : { title: "This is no stage", detail: `${all[0].name} is neither USD nor glTF. Take a .usd, .usda, .usdc, .usdz, .glb or .gltf, or a .zip with one of them; a folder as a .zip.` }));
}

function openSample(name) {
  $("file").value = "";
  choose({ name });
  $("picture").focus({ preventScroll: true }); // what was pressed is folded away
  scrollTo({ top: 0 });
}

export function wireStage() {
  const drop = $("drop");
  $("other").onclick = () => { state.choosing = !state.choosing; showChoice(); };
  $("file").onchange = () => openFiles($("file").files);
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
    openFiles(event.dataTransfer.files);
  };
}
