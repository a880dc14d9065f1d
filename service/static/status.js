// What the page says of its runs: progress, notices, and which buttons work.

import { $, counted, make, say } from "./dom.js";
import { ACTIVE, SIDES, keyOf, sides, state } from "./state.js";

export function showProgress() {
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

/** How long a job took, as " in 1.9 s"; "" where it does not say. */
export function tookText(job) {
  const seconds = (Date.parse(job?.finished) - Date.parse(job?.started)) / 1000;
  return seconds >= 0 ? ` in ${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s` : "";
}

/** A sentence for everybody. How far a run is, is said by its bar alone: one number, and no flood for a screen reader. */
function statusText() {
  if (!state.facts) return state.source ? "Looking into the stage." : "Pick a stage to begin.";
  const said = sides().map((side) => {
    const run = state.runs[side];
    const name = state.compare ? `${side.toUpperCase()} ` : "";
    if (!run) return "";
    if (run.key !== keyOf(side)) return `${name}${$("auto").checked ? "changed, about to render" : "changed, not rendered yet"}`;
    if (run.status === "running") return `${name}rendering`;
    if (run.status !== "done") return `${name}${run.status}`;
    const warnings = run.job?.warnings?.length ?? 0;
    return `${name}done${tookText(run.job)}${warnings ? ` with ${counted(warnings, "notice")}, below` : ""}`;
  }).filter(Boolean);
  const text = said.join("; ");
  return text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "Ready to render.";
}

export function showButtons() {
  const done = state.runs[state.edit]?.status === "done";
  $("render").disabled = !state.facts;
  for (const id of ["copy-curl", "copy-cli", "copy-link"]) $(id).disabled = !state.facts;
  for (const id of ["save-png", "save-exr"]) $(id).disabled = !done;
}

export function showNotices() {
  const found = [...(state.facts?.suspicious ?? []), ...(state.facts?.unsupported ?? [])];
  const warned = sides().flatMap((side) => (state.runs[side]?.job?.warnings ?? []).map((warning) => ({ ...warning, side })));
  const lines = [...new Set([...found, ...warned].map(({ path, text, fix }) => `${path ? `${path}: ` : ""}${text}${fix ? ` (${fix})` : ""}`))];
  $("notices").hidden = !lines.length;
  $("notices-title").textContent = `Notices (${lines.length})`;
  $("notices-list").replaceChildren(...lines.map((textContent) => make("li", { textContent })));
}
