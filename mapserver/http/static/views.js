// The images of nodes, GET /nodes/NODE/view, below what is drawn over them.
import { ask, draw } from "./dom.js";

// Calls `seen` once the image is there, else `missing` with the reason, which may be known before: `none`.
export function drawView(svg, { id, image: [width, height] }, y, none, seen, missing) {
  if (none) { missing(none); return; }
  const path = `nodes/${encodeURIComponent(id)}/view`;
  // A landmark's pixel is the middle of a square of the image.
  const view = draw(svg, "image", { x: -0.5, y: y - 0.5, width, height, preserveAspectRatio: "none" });
  view.addEventListener("load", () => { svg.classList.add("seen"); seen(); });
  view.addEventListener("error", async () => {
    view.remove();
    missing((await ask(path)).error || "there is none");
  });
  view.setAttribute("href", path);
}
