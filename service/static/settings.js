// What may be asked of a render: what is usual, and what of a stranger's settings is kept.

import { MODELS, SCREENS, TIERS } from "./words.js";

// Where a camera of the page's own stands. Without any of them the picture is taken by the stage's.
export const ORBIT = ["azimuth", "elevation", "distance"];
export const NUMBERS = ["image_width", "image_height", "samples", "max_layers", "exposure", "time_code", ...ORBIT];
export const NO_ORBIT = { azimuth: null, elevation: null, distance: null, look_at: null };
const GLASS_NUMBERS = ["ior", "thickness", "roughness", "absorptionDistance", "abbeNumber"];

/** What a render of this stage does when nothing is asked, and a size that suits a page. */
export function defaultSettings(facts) {
  const authored = facts?.settings ?? {};
  return {
    camera: "", ...NO_ORBIT, time_code: null, image_width: 480, image_height: 0, samples: authored.samples ?? 16, exposure: 0,
    tiers: [...(authored.tiers ?? ["screen", "probe", "ray", "sky"])], screen: "traced", model: "",
    max_layers: authored.max_layers ?? 16, overrides: {},
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
const areThree = (value) => Array.isArray(value) && value.length === 3 && value.every(isNumber);

/** Settings out of a link: known names with values of their kind; all else is dropped. */
export function cleanSettings(given, facts) {
  const clean = defaultSettings(facts);
  if (!given || typeof given !== "object") return clean;
  for (const name of NUMBERS) if (isNumber(given[name])) clean[name] = given[name];
  if (typeof given.camera === "string") clean.camera = given.camera;
  if (areThree(given.look_at)) clean.look_at = [...given.look_at];
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
  if (areThree(override?.transmittanceColor)) kept.transmittanceColor = [...override.transmittanceColor];
  return kept;
}
