// The picture: a plane of each side, in false colour where it is a number, with a slider between the two.

import { $ } from "./dom.js";
import { plane, shownRun } from "./jobs.js";
import { keepAddress } from "./link.js";
import { RAMP, SCALARS, UNITS, WHOLE, falseColour, whiteOf } from "./planes.js";
import { clearProblem, report } from "./problems.js";
import { SIDES, sides, state, tell } from "./state.js";

let painting = 0;

/** What is drawn of each side: {side, run, data, mask}; none while the camera moves. */
export let painted = [];

export async function paint() {
  const turn = ++painting;
  const shown = sides().map((side) => [side, shownRun(side)]).filter(([side, run]) => run && !state.moving[side]);
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
  const high = Math.max(1e-9, ...loaded.map(({ run }) => whiteOf(run, state.view)));
  for (const side of SIDES) {
    const one = loaded.find((entry) => entry.side === side);
    const frame = sides().includes(side) ? state.moving[side] : null;
    $(`canvas-${side}`).hidden = !one && !frame;
    if (frame) drawFrame($(`canvas-${side}`), frame);
    else if (one) draw($(`canvas-${side}`), one, scalar, high);
  }
  showFigure(loaded, scalar, high);
  painted = loaded;
  tell("painted");
}

/** A small picture of a camera that moves: smooth where it is drawn larger than it is. */
function drawFrame(canvas, frame) {
  Object.assign(canvas, { width: frame.width, height: frame.height });
  canvas.classList.remove("old");
  canvas.getContext("2d").drawImage(frame, 0, 0);
}

function draw(canvas, { side, run, beauty, data, mask }, scalar, high) {
  Object.assign(canvas, { width: data.width, height: data.height });
  canvas.classList.toggle("old", run !== state.runs[side]);
  canvas.getContext("2d").putImageData(scalar ? coloured(beauty, data, mask, whiteOf(run, state.view) / high) : data, 0, 0);
  const what = $("view").selectedOptions[0]?.textContent ?? state.view;
  canvas.setAttribute("aria-label", `${what} of ${state.source.name}, setting ${side.toUpperCase()}, ${data.width} by ${data.height} pixels`);
}

/** False colour where there is glass, or everywhere, and the picture in dark grey elsewhere. White of `data` is `scale` of the ramp. */
function coloured(beauty, data, mask, scale) {
  const out = new ImageData(data.width, data.height);
  const whole = WHOLE.includes(state.view);
  const ramp = Array.from({ length: 256 }, (_, value) => falseColour((value / 255) * scale));
  for (let at = 0; at < out.data.length; at += 4) {
    const grey = 0.35 * (0.3 * beauty.data[at] + 0.6 * beauty.data[at + 1] + 0.1 * beauty.data[at + 2]);
    const share = whole ? 1 : mask.data[at] / 255;
    const colour = ramp[data.data[at]];
    for (let channel = 0; channel < 3; channel++) out.data[at + channel] = share * colour[channel] + (1 - share) * grey;
    out.data[at + 3] = 255;
  }
  return out;
}

function showFigure(loaded, scalar, high) {
  const both = sides().length === 2 && sides().every((side) => !$(`canvas-${side}`).hidden);
  $("empty").hidden = loaded.length > 0 || sides().some((side) => state.moving[side]);
  for (const id of ["split-field", "divider", "tag-a", "tag-b"]) $(id).hidden = !both;
  $("canvas-b").style.clipPath = "none";
  if (both) showSplit();
  $("legend").hidden = !scalar || !loaded.length;
  $("legend-low").textContent = `0${UNITS[state.view] ?? ""}`;
  $("legend-high").textContent = `${Number(high.toPrecision(3))}${UNITS[state.view] ?? ""}`;
  $("legend-text").textContent = WHOLE.includes(state.view) ? "" : "Grey: no glass.";
  $("legend-bar").style.background = `linear-gradient(90deg, ${RAMP.map((colour) => `rgb(${colour.join(" ")})`).join(", ")})`;
}

function setSplit(value) {
  state.split = Math.round(Math.min(Math.max(value, 0), 100));
  showSplit();
}

function showSplit() {
  $("canvas-b").style.clipPath = `inset(0 0 0 ${state.split}%)`;
  $("divider").style.left = `${state.split}%`;
  $("split").value = state.split;
  $("split").setAttribute("aria-valuetext", `A on the left ${state.split} %, B on the right ${100 - state.split} %`);
}

export function wireView() {
  $("view").onchange = ({ target }) => {
    state.view = target.value;
    clearProblem();
    paint();
    keepAddress(state);
  };
  $("split").oninput = ({ target }) => setSplit(Number(target.value));
  const drag = (event) => {
    const box = $("views").getBoundingClientRect();
    if (event.buttons && !$("divider").hidden) setSplit(((event.clientX - box.left) / box.width) * 100);
  };
  $("views").addEventListener("pointerdown", (event) => { $("views").setPointerCapture(event.pointerId); drag(event); });
  $("views").addEventListener("pointermove", drag);
}
