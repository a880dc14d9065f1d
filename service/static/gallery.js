// Pictures of the server's stages, to choose one by. Those with a picture beside them show it; others are drawn once, one
// after the other, as they come into sight, so that who only looks takes no more than one place of the queue.

import { send } from "./api.js";
import { $, counted, make } from "./dom.js";

const WIDTH = 320;
const HEIGHT = 180;
let line = Promise.resolve();
let sight = null;

/** A stage's name for people: without its folder and its ending. */
export const nameOf = (path) => path.replace(/^.*\//, "").replace(/\.usd[acz]?$/i, "").replaceAll("_", " ");

/** Which stages are shown by pictures, and which only by name: parts of others lie in folders and have no picture. */
export function sorted(stages) {
  const shown = stages.filter(({ path, picture }) => picture || !path.includes("/"));
  return [shown, stages.filter((one) => !shown.includes(one))];
}

export function drawGallery(stages, open) {
  const [shown, others] = sorted(stages);
  sight?.disconnect();
  sight = new IntersectionObserver(look, { rootMargin: "200px" });
  $("gallery").replaceChildren(...shown.map((stage) => {
    const canvas = make("canvas", { width: WIDTH, height: HEIGHT, ariaHidden: "true", stage });
    sight.observe(canvas);
    return make("li", {}, make("button", { type: "button", className: "card", title: stage.path, onclick: () => open(stage.path) },
      canvas, make("span", { textContent: nameOf(stage.path) })));
  }));
  $("gallery-title").hidden = !shown.length;
  $("others").hidden = !others.length;
  $("others-title").textContent = counted(others.length, "other file");
  $("others-list").replaceChildren(...others.map(({ path }) =>
    make("li", {}, make("button", { type: "button", textContent: path, onclick: () => open(path) }))));
}

function look(entries) {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    sight.unobserve(target);
    show(target).catch(() => target.classList.add("none")); // its name is enough to choose it by, and what is wrong is said then
  }
}

async function show(canvas) {
  const bitmap = await createImageBitmap(await pictureOf(canvas.stage));
  const scale = Math.max(WIDTH / bitmap.width, HEIGHT / bitmap.height);
  const [wide, high] = [bitmap.width * scale, bitmap.height * scale];
  canvas.getContext("2d").drawImage(bitmap, (WIDTH - wide) / 2, (HEIGHT - high) / 2, wide, high);
}

function pictureOf({ path, picture }) {
  const get = async (address) => (await send(address, { headers: { Accept: "image/webp, image/png" } })).blob();
  if (picture) return get(picture.slice(1));
  const address = `v1/thumbnails/${path.split("/").map(encodeURIComponent).join("/")}?w=${WIDTH}`;
  line = line.catch(() => {}).then(() => get(address));
  return line;
}
