// Small pictures while the camera moves: one request at a time, always of where it is by then. A viewer of the service holds
// the stage for them. Where there is no place for one they are renders like any other, only small, and come slowly.

import { Problem, bodyOf, send } from "./api.js";
import { shownRun } from "./jobs.js";
import { report } from "./problems.js";
import { keyOf, requestOf, sides, state, tell } from "./state.js";

const WIDTHS = [128, 320]; // [pixels] smallest and largest
const WISHED = 100; // [ms] of a picture: ten a second
const AGAIN = 10_000; // [ms] after which a viewer is asked for again, where there was none
const GONE = 404;
let busy = false;
let stale = false;
let width = WIDTHS[1];
let viewer = { source: null, id: "", refused: 0 };

/** A request's settings for a picture that is soon there: the same, but small and coarse. */
export function smallRequest(request, aspect, wide = WIDTHS[1]) {
  return { ...request, image_width: wide, image_height: Math.max(1, Math.round(wide / aspect)), quality: "draft", samples: 1 };
}

/** Width of the next picture, after one that took so long: so many pixels as are there in time, towards it by halves. */
export function nextWidth(wide, milliseconds) {
  const fitting = wide * Math.sqrt(WISHED / Math.max(milliseconds, 1));
  return Math.round(Math.min(Math.max((wide + fitting) / 2, WIDTHS[0]), WIDTHS[1]));
}

/** The camera has moved, or time. Returns whether all went well. */
export async function moving() {
  stale = true;
  if (busy) return true;
  busy = true;
  try {
    while (stale && state.source) {
      stale = false;
      await frames(state.source);
    }
  } catch (error) {
    report(error);
    return false;
  } finally {
    busy = false;
  }
  return true;
}

/** Let the viewer's stage go. */
export function closeViewer() {
  if (viewer.id) send(`v1/live/${viewer.id}`, { method: "DELETE", keepalive: true }).catch(() => {}); // it ends by itself, too
  viewer = { source: null, id: "", refused: 0 };
}

async function frames(source) {
  for (const side of sides()) {
    const size = shownRun(side)?.job;
    if (!size) continue;
    const asked = smallRequest(requestOf(side), size.width / size.height, width);
    const began = performance.now();
    const drawn = await byViewer(source, asked);
    const answer = drawn ?? (await byItself(smallRequest(asked, size.width / size.height)));
    const frame = await createImageBitmap(await answer.blob());
    width = drawn ? nextWidth(width, performance.now() - began) : WIDTHS[1];
    const run = state.runs[side];
    const late = run?.status === "done" && run.key === keyOf(side); // the large picture was quicker
    if (state.source === source && !late) state.moving[side] = frame;
  }
  tell("frame");
}

function byItself(asked) {
  const { body, headers } = bodyOf(asked);
  return send("v1/render", { method: "POST", body, headers: { ...headers, Accept: "image/png" } });
}

/** The picture by a viewer; null where there is none. What is wrong with a request is told by the renders that follow. */
async function byViewer(source, asked) {
  for (let attempt = 0; attempt < 2; attempt++) {
    const id = await viewerOf(source);
    if (!id) return null;
    try {
      const headers = { "Content-Type": "application/json" };
      return await send(`v1/live/${id}/pictures`, { method: "POST", body: JSON.stringify(asked), headers });
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      viewer = { source, id: "", refused: error.status === GONE ? 0 : Date.now() }; // it was idle for too long: another one
    }
  }
  return null;
}

async function viewerOf(source) {
  if (viewer.source === source && (viewer.id || Date.now() - viewer.refused < AGAIN)) return viewer.id;
  closeViewer();
  let id = "";
  try {
    const { body, headers } = bodyOf({});
    id = (await (await send("v1/live", { method: "POST", body, headers })).json()).id;
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
  }
  viewer = { source, id, refused: id ? 0 : Date.now() };
  return id;
}
