// How large the picture is on the screen, and what its pixels say. Neither makes another picture: wheel, drag and two fingers do.

import { $ } from "./dom.js";
import { shownRun } from "./jobs.js";
import { UNITS, pixelText } from "./planes.js";
import { sides, state } from "./state.js";
import { painted, whiteOf } from "./view.js";

const ROOM = 48; // [CSS pixels] of the window's height that a picture leaves free
const HINT = "Point at the picture, or tap it, to read a pixel.";
let actual = false;
let place = null; // shares of the picture's width and height that are read

const isFull = () => document.fullscreenElement === $("figure");

/** As large as the frame allows, or one pixel on one of the screen's. */
export function showSize() {
  const job = sides().map((side) => shownRun(side)?.job).find((one) => one?.width && one.height);
  $("tools").hidden = !job;
  $("full").hidden = !document.fullscreenEnabled;
  $("full").textContent = isFull() ? "Leave full screen" : "Full screen";
  $("fit").setAttribute("aria-pressed", String(!actual));
  $("actual").setAttribute("aria-pressed", String(actual));
  const high = isFull() ? $("frame").clientHeight : innerHeight - ROOM;
  const fitting = job && `min(100%, ${(high * job.width) / job.height}px)`;
  $("views").style.width = !job ? "" : actual ? `${job.width / devicePixelRatio}px` : fitting;
  $("frame").classList.toggle("over", actual && $("views").offsetWidth > $("frame").clientWidth);
}

/** The values under the place that is read, of each side. */
export function showReading() {
  $("mark").hidden = !place?.marked || !painted.length;
  if (!place || !painted.length) {
    $("readout").textContent = HINT;
    return;
  }
  Object.assign($("mark").style, { left: `${100 * place.right}%`, top: `${100 * place.down}%` });
  const [{ data: first }] = painted;
  const [column, row] = pixelAt(first);
  const said = painted.map(({ side, run, data, mask }) => {
    const text = state.view in UNITS && valueAt(mask)[0] === 0 ? "no glass" : pixelText(state.view, valueAt(data), whiteOf(run));
    return state.compare ? `${side.toUpperCase()} ${text}` : text;
  });
  $("readout").textContent = `Pixel ${column}, ${row}: ${$("view").selectedOptions[0]?.textContent} ${said.join("; ")}`;
}

function pixelAt({ width, height }) {
  return [[place.right, width], [place.down, height]].map(([share, count]) => Math.min(Math.max(Math.floor(share * count), 0), count - 1));
}

function valueAt(pixels) {
  const [column, row] = pixelAt(pixels);
  const at = 4 * (row * pixels.width + column);
  return pixels.data.slice(at, at + 3);
}

function read(event) {
  const box = $("views").getBoundingClientRect();
  place = {
    right: (event.clientX - box.left) / box.width, down: (event.clientY - box.top) / box.height,
    marked: event.pointerType !== "mouse", // a finger hides what it points at, and leaves
  };
  showReading();
}

function setActual(value) {
  actual = value;
  showSize();
}

export function wireLooking() {
  $("fit").onclick = () => setActual(false);
  $("actual").onclick = () => setActual(true);
  $("full").onclick = () => (isFull() ? document.exitFullscreen() : $("figure").requestFullscreen()).catch(() => {});
  document.addEventListener("fullscreenchange", showSize);
  addEventListener("resize", showSize);
  $("views").addEventListener("pointerdown", read);
  $("views").addEventListener("pointermove", (event) => {
    if (event.pointerType === "mouse" && !event.buttons) read(event);
  });
  $("views").addEventListener("pointerleave", (event) => {
    if (event.pointerType !== "mouse") return;
    place = null;
    showReading();
  });
}
