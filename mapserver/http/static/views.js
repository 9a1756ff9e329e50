// The images of nodes, GET /nodes/NODE/view, below what is drawn over them.
import { draw } from "./dom.js";

// Calls `seen` once the image is there; without one the drawing stays as it is.
export function drawView(svg, { id, image: [width, height] }, x, seen) {
  // A landmark's pixel is the middle of a square of the image.
  const view = draw(svg, "image", { x: x - 0.5, y: -0.5, width, height, preserveAspectRatio: "none" });
  view.addEventListener("load", () => { svg.classList.add("seen"); seen(); });
  view.addEventListener("error", () => view.remove());
  view.setAttribute("href", `nodes/${encodeURIComponent(id)}/view`);
}
