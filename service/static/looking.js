// How large the picture is on the screen, and what its pixels say. Neither makes another picture: wheel, drag and two fingers do.

import { $, make } from "./dom.js";
import { plane, shownRun } from "./jobs.js";
import { AOVS, UNITS, WHOLE, pixelText, whiteOf } from "./planes.js";
import { report } from "./problems.js";
import { sides, state } from "./state.js";
import { painted } from "./view.js";

const ROOM = 48; // [CSS pixels] of the window's height that a picture leaves free
const HINT = "Point at the picture, or tap it, to read a pixel.";
let actual = false;
let asking = 0; // for planes: a newer place makes an older one's answer void
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
  $("planes").hidden = !painted.length;
  showPlanes();
  if (!place || !painted.length) {
    $("readout").textContent = HINT;
    return;
  }
  Object.assign($("mark").style, { left: `${100 * place.right}%`, top: `${100 * place.down}%` });
  const [{ data: first }] = painted;
  const [column, row] = pixelAt(first);
  const said = painted.map(({ side, run, data, mask }) => {
    const text = textAt(state.view, run, data, mask);
    return state.compare ? `${side.toUpperCase()} ${text}` : text;
  });
  $("readout").textContent = `Pixel ${column}, ${row}: ${$("view").selectedOptions[0]?.textContent} ${said.join("; ")}`;
}

/** Every plane at the place that is read, of each side; what was read last stays. They are fetched when first wanted. */
async function showPlanes() {
  if (!$("planes").open || !painted.length) return;
  const [turn, at] = [++asking, place];
  const names = ["beauty", ...AOVS];
  try {
    const shown = await Promise.all(painted.map(async ({ side, run }) => {
      const found = await Promise.all(names.map(async (name) => [name, (await plane(run, name)).pixels]));
      return { side, run, pixels: Object.fromEntries(found) };
    }));
    if (turn !== asking || !at) return;
    const row = (tag, first, words) => make("tr", {}, make("th", { textContent: first }), ...words.map((textContent) => make(tag, { textContent })));
    const [column, line] = pixelAt(shown[0].pixels.beauty, at);
    $("planes-head").replaceChildren(row("th", `Pixel ${column}, ${line}`, shown.map(({ side }) => (state.compare ? side.toUpperCase() : "value"))));
    $("planes-found").replaceChildren(...names.map((name) => row("td",
      $("view").querySelector(`[value="${name}"]`).textContent, shown.map(({ run, pixels }) => textAt(name, run, pixels[name], pixels.mask, at)))));
  } catch (error) {
    if (turn === asking) report(error);
  }
}

function textAt(name, run, data, mask, at = place) {
  const glass = WHOLE.includes(name) || !(name in UNITS) || valueAt(mask, at)[0] > 0;
  return glass ? pixelText(name, valueAt(data, at), whiteOf(run, name)) : "no glass";
}

function pixelAt({ width, height }, at = place) {
  return [[at.right, width], [at.down, height]].map(([share, count]) => Math.min(Math.max(Math.floor(share * count), 0), count - 1));
}

function valueAt(pixels, at) {
  const [column, row] = pixelAt(pixels, at);
  const first = 4 * (row * pixels.width + column);
  return pixels.data.slice(first, first + 3);
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
  $("planes").ontoggle = showReading;
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
