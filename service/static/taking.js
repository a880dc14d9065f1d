// What can be taken away: commands, a link, files.

import { bodyOf, send } from "./api.js";
import { asCli, asCurl, fileName } from "./commands.js";
import { $, download, say } from "./dom.js";
import { plane } from "./jobs.js";
import { toFragment } from "./link.js";
import { report } from "./problems.js";
import { requestOf, state } from "./state.js";

/** To the clipboard where the browser allows it, and to a box that can always be selected. */
async function copy(what, text) {
  $("copied-field").hidden = false;
  $("copied").value = text;
  $("copied").rows = Math.min(text.split("\n").length + 2, 14);
  $("copied").select();
  const done = await navigator.clipboard?.writeText(text).then(() => true, () => false);
  $("copied-label").textContent = done ? `${what}, copied` : `${what}: select and copy`;
  say(done ? `${what} copied.` : `${what} is in the box below the picture.`);
}

function copyLink() {
  const link = new URL(location.href);
  link.hash = toFragment(state);
  copy(state.source.file ? `Link (whoever opens it needs ${state.source.name})` : "Link", link.href);
}

/** An EXR holds linear light and every plane, which the picture on the page does not: it is rendered for itself. */
async function exr() {
  say("Rendering the EXR file …");
  const { body, headers } = bodyOf(requestOf(state.edit));
  const answer = await send("v1/render", { method: "POST", body, headers: { ...headers, Accept: "image/x-exr" } });
  const blob = await answer.blob();
  say("The EXR file is ready.");
  return blob;
}

async function save(kind) {
  const run = state.runs[state.edit];
  try {
    const blob = kind === "png" ? (await plane(run, state.view)).blob : await exr();
    download(blob, fileName(state.source.name, kind));
  } catch (error) {
    report(error);
  }
}

export function wireTaking() {
  const address = () => new URL("v1/render", document.baseURI).href;
  $("copy-curl").onclick = () => copy("curl command", asCurl(address(), state.source, requestOf(state.edit)));
  $("copy-cli").onclick = () => copy("Command", asCli(state.source, requestOf(state.edit)));
  $("copy-link").onclick = copyLink;
  $("save-png").onclick = () => save("png");
  $("save-exr").onclick = () => save("exr");
}
