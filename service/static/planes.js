// The planes of a picture that can be looked at, and numbers as colours.

// Planes of one number per pixel are drawn in false colour. Those with a unit are not between 0 and 1: white in their
// PNG stands for what the job's record says.
export const UNITS = { thickness: " m", path_length: " m", layers: "", Z: " m" };
export const WHOLE = ["Z"]; // of all that is seen, glass or not

export const SCALARS = ["weight.screen", "weight.ray", "weight.probe", "weight.sky", "weight.none", "confidence", "mask", ...Object.keys(UNITS)];
export const AOVS = [...SCALARS, "refraction", "reflection", "transmittance", "N"];

// Dark to light in steps of even lightness, so that the order survives colour blindness and grey print.
export const RAMP = [[24, 15, 61], [66, 40, 133], [33, 102, 153], [20, 150, 136], [110, 191, 84], [236, 221, 92], [255, 250, 220]];

/** [red, green, blue] 0 .. 255 of a share 0 .. 1. */
export function falseColour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((from, channel) => Math.round(from + (RAMP[low + 1][channel] - from) * (at - low)));
}

const short = (value) => String(Number(value.toFixed(3)));

/** What white stands for in a run's PNG of a plane. */
export const whiteOf = (run, name) => run.job.aovs?.find((one) => one.name === name)?.white ?? 1;

/** What a pixel of a plane's PNG says: [red, green, blue] 0 .. 255, where white stands for `white`. */
export function pixelText(name, [red, green, blue], white = 1) {
  if (WHOLE.includes(name) && red === 255) return `${Number(white.toPrecision(3))}${UNITS[name]} or farther`; // or nothing is there
  if (SCALARS.includes(name)) return `${Number(((red / 255) * white).toPrecision(3))}${UNITS[name] ?? ""}`;
  if (name === "N") return [red, green, blue].map((value) => short((value / 255) * 2 - 1)).join(", ");
  return `${red}, ${green}, ${blue} of 255`;
}
