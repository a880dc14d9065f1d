// The part of an address after #: a stage, one setting or two, and what is looked at.

import { requestSettings } from "./settings.js";

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

/** The address bar says what is on the page; the browser's back button keeps its meaning. */
export function keepAddress(state) {
  history.replaceState(null, "", `#${toFragment(state)}`);
}
