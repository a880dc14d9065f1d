// What the page knows. A change is told with tell(); page.js decides with hear() who then shows it, so that no module needs
// the one that shows what it did.

import { defaultSettings, requestSettings } from "./settings.js";

export const SIDES = ["a", "b"];
export const ACTIVE = ["sending", "queued", "running"];

export const state = {
  source: null, choosing: false, facts: null, settings: { a: defaultSettings(), b: defaultSettings() }, edit: "a", compare: false,
  view: "beauty", split: 50, runs: { a: null, b: null }, moving: { a: null, b: null }, playing: false, token: "",
};

export const sides = () => (state.compare ? SIDES : ["a"]);
export const requestOf = (side) => requestSettings(state.settings[side], state.facts);
export const keyOf = (side) => JSON.stringify([state.source.name, requestOf(side)]);

/** Other values for the side being edited. */
export function update(part) {
  Object.assign(state.settings[state.edit], part);
  tell("settings");
}

const listeners = {};

/** `act` whenever `what` is told: "settings" (of a side), "camera", "frame" (while it moves), or "all" (anything). One listener each. */
export function hear(what, act) {
  listeners[what] = act;
}

export function tell(what) {
  listeners[what]?.();
}
