// The service over HTTP.

import { state } from "./state.js";

/** A problem document that the service sent, or one made here in its shape. */
export class Problem extends Error {
  constructor(document, status = 0) {
    super(document.title);
    Object.assign(this, { document, status });
  }
}

export async function send(path, options = {}) {
  const headers = new Headers(options.headers);
  if (state.token) headers.set("Authorization", `Bearer ${state.token}`);
  let answer;
  try {
    answer = await fetch(new URL(path, document.baseURI), { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ title: "The service cannot be reached", detail: "Check that it is running, then try again." });
  }
  if (answer.ok) return answer;
  const body = await answer.json().catch(() => ({ title: `The service answered ${answer.status}`, detail: answer.statusText }));
  const wait = answer.headers.get("Retry-After");
  if (wait) body.detail = `${body.detail ?? ""} Try again in ${wait} s.`.trim();
  throw new Problem(body, answer.status);
}

/** Multipart for a file of the visitor's, JSON for a stage of the server's. */
export function bodyOf(settings) {
  if (!state.source.file) {
    return { body: JSON.stringify({ stage: state.source.name, ...settings }), headers: { "Content-Type": "application/json" } };
  }
  const form = new FormData();
  form.set("stage", state.source.file, state.source.name);
  for (const part of state.source.parts ?? []) form.append("file", part, part.name);
  if (Object.keys(settings).length) form.set("settings", JSON.stringify(settings));
  return { body: form, headers: {} };
}

/** Server-sent events in `text`: those that are whole, and the rest of the text. */
export function parseEvents(text) {
  const blocks = text.replaceAll("\r\n", "\n").split("\n\n");
  const rest = blocks.pop();
  const found = [];
  for (const block of blocks) {
    const event = { event: "message", data: "" };
    for (const line of block.split("\n")) {
      const [, name, value] = /^([^:]*):? ?(.*)$/.exec(line);
      if (name === "event") event.event = value;
      if (name === "data") event.data += (event.data && "\n") + value;
    }
    if (event.data) found.push(event);
  }
  return [found, rest];
}
