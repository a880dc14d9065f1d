// A camera that turns around what is seen: by dragging, by the wheel, by two fingers, by keys. It starts from the camera of
// the stage, which the job of its picture tells. Two settings that are compared are seen by one camera.

import { $ } from "./dom.js";
import { shownRun, stopAll } from "./jobs.js";
import { moving } from "./live.js";
import { NO_ORBIT, ORBIT } from "./settings.js";
import { sides, state, tell } from "./state.js";

const TURN = 0.4; // [degrees] of a pixel
const STEP = 5; // [degrees] of a key
const ZOOM = 0.0015; // of a pixel of the wheel: the logarithm of the distance
const STEEPEST = 89; // [degrees]: above it a drag to the side would spin the picture

const round = (value, digits) => Number(value.toPrecision(digits));

/** Where the camera is turned to by so many degrees, and how much nearer; 1 leaves the distance. */
export function turned(view, right, up, nearer = 1) {
  return {
    ...view,
    azimuth: round(((((view.azimuth + right + 180) % 360) + 360) % 360) - 180, 6),
    elevation: round(Math.max(-STEEPEST, Math.min(STEEPEST, view.elevation + up)), 6),
    distance: round(view.distance / nearer, 6),
  };
}

/** What is looked at, moved by shares of the picture's width, as the camera sees them; `up` is the stage's upright axis. */
export function moved(view, right, above, width, up) {
  const [turn, rise] = [view.azimuth, view.elevation].map((angle) => (angle * Math.PI) / 180);
  const across = [Math.cos(turn), 0, -Math.sin(turn)];
  const over = [-Math.sin(turn) * Math.sin(rise), Math.cos(rise), -Math.cos(turn) * Math.sin(rise)];
  const far = view.distance * width;
  const [x, y, z] = across.map((part, axis) => far * (right * part + above * over[axis]));
  const step = up === "Z" ? [x, -z, y] : [x, y, z];
  return { ...view, look_at: view.look_at.map((place, axis) => round(place + step[axis], 6)) };
}

/** The camera as it is: the page's own, else the stage's; null before a picture has told where that stands. */
function view() {
  const settings = state.settings[state.edit];
  const start = shownRun(state.edit)?.job.view ?? sides().map((side) => shownRun(side)?.job.view).find(Boolean);
  if (!start) return null;
  const own = Object.fromEntries(ORBIT.map((name) => [name, settings[name] ?? round(start[name], 6)]));
  own.look_at = settings.look_at ?? start.look_at.map((place) => round(place, 6));
  return { own, camera: settings.camera || start.camera, width: start.width };
}

/** Put the camera where `part` says; what it leaves out stays. */
export function turnTo(part) {
  const now = view();
  if (now) put({ ...now.own, ...part }, now.camera);
  else put(part, state.settings[state.edit].camera);
}

function put(values, camera) {
  for (const side of sides()) Object.assign(state.settings[side], values, { camera });
  tell("camera");
}

/** The same, and small pictures on the way. */
function turnLive(change) {
  const now = view();
  if (!now) return;
  stopAll(); // a picture of where the camera no longer is
  put(change(now.own, now), now.camera);
  moving();
}

export function showTurning() {
  const settings = state.settings[state.edit];
  $("turning").hidden = !view();
  $("back").disabled = [...ORBIT, "look_at"].every((name) => settings[name] === null);
  for (const name of ORBIT) $(`set-${name}`).placeholder = view() ? String(round(Number(view().own[name].toFixed(6)), 4)) : ""; // no 2e-16
}

function back() {
  const usual = state.facts.cameras?.find(({ used }) => used)?.path;
  for (const side of sides()) {
    const settings = state.settings[side];
    Object.assign(settings, NO_ORBIT, { camera: settings.camera === usual ? "" : settings.camera });
  }
  tell("settings");
}

const KEYS = {
  ArrowLeft: (own) => turned(own, -STEP, 0), ArrowRight: (own) => turned(own, STEP, 0),
  ArrowUp: (own) => turned(own, 0, STEP), ArrowDown: (own) => turned(own, 0, -STEP),
  "+": (own) => turned(own, 0, 0, 1.1), "=": (own) => turned(own, 0, 0, 1.1), "-": (own) => turned(own, 0, 0, 1 / 1.1),
};

export function wireOrbit() {
  const views = $("views");
  const fingers = new Map();
  const middle = () => [...fingers.values()].reduce(([x, y], one) => [x + one.x / fingers.size, y + one.y / fingers.size], [0, 0]);
  const span = () => {
    const [one, other] = [...fingers.values()];
    return other ? Math.hypot(one.x - other.x, one.y - other.y) : 0;
  };
  views.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  views.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const [before, wide] = [middle(), span()];
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const [right, down] = middle().map((place, axis) => place - before[axis]);
    const size = views.getBoundingClientRect().width || 1;
    if (fingers.size > 1 || event.shiftKey) {
      const nearer = wide ? span() / wide : 1;
      turnLive((own, { width }) => turned(moved(own, -right / size, down / size, width, state.facts.up_axis), 0, 0, nearer || 1));
    } else if (!state.compare && (right || down)) { // where two are compared, a drag moves the line between them
      turnLive((own) => turned(own, -TURN * right, TURN * down));
    }
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
    views.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  views.addEventListener("wheel", (event) => {
    if (!view()) return;
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
    turnLive((own) => turned(own, 0, 0, Math.exp(-ZOOM * Math.max(-300, Math.min(300, pixels)))));
  }, { passive: false });
  views.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !view()) return;
    if (event.key === "Home") back();
    else if (KEYS[event.key]) turnLive(KEYS[event.key]);
    else return;
    event.preventDefault();
  });
  $("back").onclick = back;
}
