// A stage that moves: a time code is chosen by a slider, or they are played by the clock in small pictures.

import { $ } from "./dom.js";
import { changed, stopAll } from "./jobs.js";
import { moving } from "./live.js";
import { sides, state } from "./state.js";

let turn = 0; // of playing: a second one ends the first

const range = () => {
  const time = state.facts?.time;
  return time?.authored && time.end > time.start ? time : null;
};
const now = () => state.settings[state.edit].time_code ?? range().start;
const nextFrame = () => new Promise((resolve) => requestAnimationFrame(resolve));

export function showTime() {
  const time = range();
  $("timing").hidden = !time;
  if (!time) return;
  Object.assign($("scrub"), { min: time.start, max: time.end });
  $("scrub").value = now();
  $("time-now").textContent = String(Number(now().toFixed(3)));
  $("play").textContent = state.playing ? "Pause" : "Play";
  if (document.activeElement !== $("set-time_code")) $("set-time_code").value = state.settings[state.edit].time_code ?? "";
}

/** Both sides that are compared are seen at one time. */
function goTo(code) {
  for (const side of sides()) state.settings[side].time_code = code;
  showTime();
}

/** What the clock says is shown next: where pictures come slowly some are left out, and the pace stays. */
async function play() {
  const { source } = state;
  const { start, end, frames_per_second: rate } = range();
  const count = Math.floor(end - start) + 1;
  const [began, first] = [performance.now(), Math.floor(now() - start)];
  const mine = ++turn;
  state.playing = true;
  stopAll();
  showTime();
  while (state.playing && turn === mine && state.source === source) {
    const passed = Math.floor(((performance.now() - began) / 1000) * (rate || 24));
    const code = start + ((first + passed) % count);
    if (code !== now()) {
      goTo(code);
      if (!(await moving())) break;
    }
    await nextFrame();
  }
  if (turn === mine && state.source === source) pause();
}

function pause() {
  if (!state.playing) return;
  state.playing = false;
  showTime();
  changed(); // where it stands, in full
}

export function wireTime() {
  $("play").onclick = () => (state.playing ? pause() : play());
  $("scrub").oninput = ({ target }) => {
    state.playing = false;
    stopAll();
    goTo(Number(target.value));
    moving();
    changed();
  };
}
