// The list of tiers, in the order in which they are asked.

import { $, make } from "./dom.js";
import { TIERS } from "./words.js";
import { update } from "./state.js";

export function drawTiers(chosen) {
  const held = document.activeElement?.id;
  $("tiers").replaceChildren(...[...chosen, ...TIERS.filter((tier) => !chosen.includes(tier))].map((tier) => tierRow(tier, chosen)));
  if (held?.startsWith("tier-")) ($(held)?.disabled ? $(`tier-${held.split("-")[1]}`) : $(held))?.focus();
}

function tierRow(tier, chosen) {
  const place = chosen.indexOf(tier);
  const used = make("input", { type: "checkbox", id: `tier-${tier}`, checked: place >= 0, disabled: place >= 0 && chosen.length === 1 });
  used.onchange = () => setTiers(used.checked ? [...chosen, tier] : chosen.filter((other) => other !== tier), tier);
  const button = (sign, word, step) => {
    const node = make("button", { type: "button", id: `tier-${tier}-${word}`, textContent: sign });
    node.disabled = place < 0 || place + step < 0 || place + step >= chosen.length;
    node.setAttribute("aria-label", `Move ${tier} ${word}`);
    node.onclick = () => setTiers(moved(chosen, tier, place + step), tier);
    return node;
  };
  const label = make("label", { className: "tick" }, used, place < 0 ? `${tier} (not asked)` : `${place + 1}. ${tier}`);
  const row = make("li", { draggable: place >= 0 }, label, button("↑", "up", -1), button("↓", "down", 1));
  row.ondragstart = (event) => event.dataTransfer.setData("text/tier", tier);
  row.ondragover = (event) => { if (event.dataTransfer.types.includes("text/tier")) { event.preventDefault(); row.classList.add("over"); } };
  row.ondragleave = () => row.classList.remove("over");
  row.ondrop = (event) => {
    const dragged = event.dataTransfer.getData("text/tier");
    event.preventDefault();
    if (TIERS.includes(dragged)) setTiers(moved(chosen, dragged, place < 0 ? chosen.length - 1 : place), dragged);
  };
  return row;
}

function moved(chosen, tier, to) {
  const others = chosen.filter((other) => other !== tier);
  return [...others.slice(0, to), tier, ...others.slice(to)];
}

function setTiers(tiers, tier) {
  update({ tiers });
  const place = tiers.indexOf(tier);
  $("moved").textContent = place < 0 ? `${tier} is not asked.` : `${tier} is number ${place + 1} of ${tiers.length}.`;
}
