// Drawing an area on the map: a rectangle by dragging or by two corners, a polygon by its corners. With the keyboard
// Enter puts a corner at the middle of the map.
import { colours } from "./colours.js";
import { outline } from "./selection.js";

const CLOSE = 12;  // px from the first corner: closes the polygon
const MOST = 64;   // corners, as the server takes

const rectangle = ([x, y], [u, v]) => [[x, y], [u, y], [u, v], [x, v]];

export class Drawing {
  // `drawn` is called with the corners on the plane.
  constructor(viewport, drawn) {
    Object.assign(this, { viewport, drawn, changed() {}, shape: "", corners: [], pointer: null });
  }
  begin(shape) { Object.assign(this, { shape, corners: [], pointer: null }); this.changed(); }
  cancel() { this.begin(""); }
  finish() {
    const { shape, corners } = this;
    if (shape !== "polygon" || corners.length < 3) return;
    this.cancel();
    this.drawn(corners);
  }
  back() { this.corners.pop(); this.changed(); }
  // A corner at a point of the screen.
  corner(u, v) {
    const { corners, viewport } = this, point = viewport.toPlane(u, v);
    if (this.shape === "polygon") {
      const [first, last] = [corners[0], corners.at(-1)].map(one => one && viewport.toScreen(...one));
      const near = one => one && Math.hypot(one[0] - u, one[1] - v) < CLOSE;
      if (corners.length > 2 && (near(first) || near(last))) { this.finish(); return; }
      if (corners.length < MOST && !near(last)) corners.push(point);
    } else if (corners.length) {
      const first = corners[0];
      if (first[0] === point[0] || first[1] === point[1]) return;
      this.cancel();
      this.drawn(rectangle(first, point));
      return;
    } else corners.push(point);
    this.changed();
  }
  // Whether a drag from one point of the screen to another draws.
  drag(from, to, ended) {
    if (this.shape !== "rectangle") return false;
    this.corners = [this.viewport.toPlane(...from)];
    this.pointer = this.viewport.toPlane(...to);
    if (ended) this.corner(...to); else this.changed();
    return true;
  }
  hint() {
    if (this.shape === "rectangle") return "Drag over the map, or click two opposite corners. Escape ends it.";
    if (this.shape !== "polygon") return "";
    return this.corners.length < 3 ? "Click the corners, 3 or more. Backspace takes the last one back, Escape ends it."
      : `${this.corners.length} corners. Click the first or the last one again, or Finish.`;
  }
  draw(c, viewport) {
    if (!this.shape) return;
    const { corners, pointer } = this, points = this.shape === "rectangle" && corners.length && pointer
      ? rectangle(corners[0], pointer) : corners;
    const onScreen = points.map(point => viewport.toScreen(...point));
    c.strokeStyle = c.fillStyle = colours.accent; c.lineWidth = 2;
    c.setLineDash([6, 4]); outline(c, onScreen, this.shape === "rectangle"); c.setLineDash([]);
    for (const [u, v] of onScreen) { c.beginPath(); c.arc(u, v, 4, 0, 7); c.fill(); }
  }
}
