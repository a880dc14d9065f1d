// What went wrong, shown with a way to the control that it is about.

import { Problem } from "./api.js";
import { $, make } from "./dom.js";
import { state } from "./state.js";

export function report(error, side = "") {
  if (error instanceof Problem) {
    if (error.status === 401) $("token-field").hidden = false;
    return showProblem(error.document, side);
  }
  console.error(error);
  showProblem({ title: "The page met an error of its own", detail: "Reload it and try again." }, side);
}

export function showProblem(problem, side = "") {
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

export function clearProblem() {
  $("problem").hidden = true;
  for (const marked of document.querySelectorAll("[aria-invalid]")) marked.removeAttribute("aria-invalid");
}

/** The parts of a JSON pointer. */
export const pointerParts = (pointer) =>
  String(pointer).replace(/^#/, "").split("/").slice(1).map((part) => part.replaceAll("~1", "/").replaceAll("~0", "~"));

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
