// What every module needs of the document.

export const $ = (id) => document.getElementById(id);

export function make(tag, props = {}, ...children) {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children);
  return node;
}

export function say(text) {
  if ($("status").textContent !== text) $("status").textContent = text;
}

export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
