// The page of the service. No framework, no build step. This module starts it; none of the others does anything when it is
// loaded, so that tests reach them without a document.

import { wireChecks } from "./checks.js";
import { $ } from "./dom.js";
import { showCamera, showSettings, wireSettings } from "./form.js";
import { changed, renderAll, stopAll } from "./jobs.js";
import { fromFragment } from "./link.js";
import { closeViewer } from "./live.js";
import { showReading, showSize, wireLooking } from "./looking.js";
import { showTurning, wireOrbit } from "./orbit.js";
import { showTime, wireTime } from "./playing.js";
import { clearProblem } from "./problems.js";
import { choose, listSamples, showChoice, wireStage } from "./stage.js";
import { hear, state } from "./state.js";
import { showButtons, showNotices, showProgress } from "./status.js";
import { wireTaking } from "./taking.js";
import { paint, wireView } from "./view.js";

function showAll() {
  showChoice();
  showSettings();
  showProgress();
  showButtons();
  showNotices();
  showTurning();
  showTime();
  paint();
}

/** Do what the link says; also when somebody pastes another one over it. */
async function openLink() {
  const link = fromFragment(location.hash);
  Object.assign(state, { view: link.view, split: link.split });
  $("view").value = link.view;
  if ($("view").selectedIndex < 0) $("view").value = state.view = "beauty";
  if (link.stage) {
    await choose({ name: link.stage }, link);
  } else if (link.file) {
    state.keep = link;
    $("facts").textContent = `This link was made with a file called ${link.file}. Drop that file here to see it.`;
  }
}

async function start() {
  hear("settings", () => { showSettings(); showTurning(); showTime(); changed(); });
  hear("camera", () => { showCamera(); showTurning(); changed(); });
  hear("frame", paint);
  hear("painted", () => { showSize(); showReading(); });
  hear("all", showAll);
  wireStage();
  wireSettings();
  wireView();
  wireOrbit();
  wireLooking();
  wireTime();
  wireTaking();
  wireChecks();
  $("render").onclick = renderAll;
  $("cancel").onclick = () => { stopAll(); showAll(); $("render").focus(); };
  $("auto").onchange = changed;
  $("token-field").onsubmit = async (event) => {
    event.preventDefault();
    state.token = $("token").value.trim();
    clearProblem();
    await listSamples();
    if (!state.source) await openLink();
  };
  addEventListener("hashchange", openLink);
  addEventListener("pagehide", () => { stopAll(); closeViewer(); });
  showSettings();
  await listSamples();
  await openLink();
}

start();
