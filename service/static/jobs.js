// One run per side: sent, followed to its end or given up, and the planes it made.

import { Problem, bodyOf, parseEvents, send } from "./api.js";
import { $ } from "./dom.js";
import { keepAddress } from "./link.js";
import { AOVS } from "./planes.js";
import { clearProblem, report, showProblem } from "./problems.js";
import { ACTIVE, SIDES, keyOf, requestOf, sides, state, tell } from "./state.js";
import { showButtons, showProgress } from "./status.js";

let timer = 0;
let address = 0;
const sleep = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

/** Something about the wanted picture changed: keep the address current, and render soon if so wished. */
export function changed() {
  if (!state.source) return;
  clearTimeout(address);
  address = setTimeout(() => state.source && keepAddress(state), 200); // browsers refuse it for every pixel of a drag
  clearTimeout(timer);
  if ($("auto").checked && state.facts && !state.playing) timer = setTimeout(renderAll, 450);
  showProgress();
  showButtons();
}

export function renderAll() {
  clearTimeout(timer);
  if (!state.facts) return;
  clearProblem();
  $("copied-field").hidden = true;
  for (const side of sides()) {
    const run = state.runs[side];
    if (run?.key === keyOf(side) && [...ACTIVE, "done"].includes(run.status)) continue;
    stop(side);
    submit(side);
  }
  tell("all");
}

async function submit(side) {
  const before = shownRun(side);
  if (before) before.before = null; // one old picture is enough
  const run = { side, key: keyOf(side), status: "sending", fraction: 0, job: null, planes: {}, abort: new AbortController(), before };
  state.runs[side] = run;
  try {
    const { body, headers } = bodyOf({ ...requestOf(side), aovs: AOVS });
    const answer = await send("v1/render", { method: "POST", body, headers: { ...headers, Prefer: "respond-async", Accept: "image/png" } });
    if (answer.status === 202) {
      const place = answer.headers.get("Location") ?? "";
      take(run, { ...(await answer.json()), ...(place && { id: place.split("/").pop() }) });
    } else {
      const place = answer.headers.get("Content-Location") ?? answer.headers.get("Location") ?? "";
      const id = /jobs\/([^/]+)/.exec(place)?.[1] ?? (answer.headers.get("ETag") ?? "").replace(/^W\/|"/g, "");
      take(run, await (await send(`v1/jobs/${id}`)).json());
    }
    if (run.status === "cancelled") return void erase(run);
    await follow(run);
    if (run.status === "done") await plane(run, "beauty");
    if (run.status === "done" && state.runs[side] === run) state.moving[side] = null; // the picture itself is there
    else if (run.job.problem && state.runs[side] === run) showProblem(run.job.problem, side);
  } catch (error) {
    if (run.status === "cancelled" || error.name === "AbortError") return;
    run.status = "failed";
    state.moving[side] = null;
    if (state.runs[side] === run) report(error, side);
  }
  if (state.runs[side] === run) tell("all");
}

/** Wait for the job's end: by its events, and by asking where those break off. */
async function follow(run) {
  for (let broken = 0; ACTIVE.includes(run.status);) {
    try {
      const answer = await send(`v1/jobs/${run.job.id}/events`, { headers: { Accept: "text/event-stream" }, signal: run.abort.signal });
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      for (let rest = "", part = await reader.read(); !part.done && ACTIVE.includes(run.status); part = await reader.read()) {
        const [events, left] = parseEvents(rest + part.value);
        rest = left;
        for (const { data } of events) take(run, JSON.parse(data));
      }
    } catch (error) {
      if (error.name === "AbortError" || (error instanceof Problem && error.document.status)) throw error;
      if (++broken > 5) throw error;
    }
    if (!ACTIVE.includes(run.status)) return run.abort.abort();
    await sleep(1000);
    take(run, await (await send(`v1/jobs/${run.job.id}`, { signal: run.abort.signal })).json());
  }
}

function take(run, job) {
  run.job = { ...run.job, ...job };
  if (run.status !== "cancelled") run.status = job.status ?? "queued";
  run.fraction = job.fraction ?? run.fraction;
  if (state.runs[run.side] === run) showProgress();
}

/** Give up a run; the job itself ends too, unless the other side waits for the same one. */
export function stop(side) {
  const run = state.runs[side];
  if (!run || !ACTIVE.includes(run.status)) return;
  run.status = "cancelled";
  run.abort.abort();
  if (run.job?.id) erase(run);
}

function erase(run) {
  const shared = SIDES.some((side) => state.runs[side] !== run && state.runs[side]?.job?.id === run.job.id && ACTIVE.includes(state.runs[side].status));
  if (!shared) send(`v1/jobs/${run.job.id}`, { method: "DELETE", keepalive: true }).catch(() => {});
}

export function stopAll() {
  clearTimeout(timer);
  for (const side of SIDES) stop(side);
}

/** What a side can show: its finished run, else the one before it, marked as old. */
export function shownRun(side) {
  const run = state.runs[side];
  return run?.status === "done" ? run : run?.before ?? null;
}

/** Pixels of one plane of a finished run. */
export function plane(run, name) {
  const path = name === "beauty" ? "image" : `aovs/${name}.png`;
  run.planes[name] ??= send(`v1/jobs/${run.job.id}/${path}`, { headers: { Accept: "image/png" } })
    .then((answer) => answer.blob())
    .then(async (blob) => {
      const bitmap = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
      const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(bitmap, 0, 0);
      return { blob, pixels: context.getImageData(0, 0, bitmap.width, bitmap.height) };
    })
    .catch((error) => {
      delete run.planes[name]; // so that it is asked for again
      throw error;
    });
  return run.planes[name];
}
