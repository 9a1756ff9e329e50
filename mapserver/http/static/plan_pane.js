// The image of a floor plan beside the map: moved and zoomed as the map is, with the pixels of the pairs.
import { colours } from "./colours.js";
import { listen } from "./input.js";
import { imageOf, inTheme } from "./plans.js";
import { Viewport } from "./viewport.js";

// The viewport's plane is that of the pixels: x is u, y is -v. An image is `{ sha256, width, height }`; its size is known
// before its pixels have come.
export class PlanPane {
  constructor(canvas, clicked) {
    Object.assign(this, { canvas, viewport: new Viewport(), image: null, marks: { pairs: [], pixel: null } });
    const toPixel = (u, v) => { const [x, y] = this.viewport.toPlane(u, v); return [x, -y]; };
    listen(canvas, this.viewport, { moved: () => this.draw(), fit: () => this.fit(),
      chosen: (u, v) => { if (this.image) clicked(...toPixel(u, v)); } });
    for (const event of ["focus", "blur"]) canvas.addEventListener(event, () => this.draw());
    new ResizeObserver(() => this.resize()).observe(canvas);
  }
  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = window.devicePixelRatio || 1;
    const { viewport } = this, first = viewport.width <= 1;
    if (!width || (width === viewport.width && height === viewport.height)) return;
    Object.assign(viewport, { width, height });
    this.canvas.width = Math.round(width * ratio); this.canvas.height = Math.round(height * ratio);
    if (first || !viewport.touched) this.fit(); else this.draw();
  }
  fit() {
    const { width, height } = this.image || {};
    if (width) this.viewport.fit([0, -height, width, 0], { most: 8, margin: 12, tools: 0 });
    this.viewport.touched = false;
    this.draw();
  }
  draw() {
    const { canvas, viewport: v } = this, c = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = colours.ground; c.fillRect(0, 0, v.width, v.height);
    const { sha256, width, height } = this.image || {}, image = sha256 && imageOf(sha256, () => this.draw());
    if (image?.complete && image.naturalWidth) {
      const [left, top] = v.toScreen(0, 0);
      c.imageSmoothingEnabled = v.scale < 4;
      c.drawImage(inTheme(sha256, image), left, top, width * v.scale, height * v.scale);
    }
    this.marks.pairs.forEach((pair, k) => mark(c, ...v.toScreen(pair.u, -pair.v), k + 1));
    if (this.marks.pixel) mark(c, ...v.toScreen(this.marks.pixel.u, -this.marks.pixel.v), "");
    if (canvas.matches(":focus-visible")) crosshair(c, v);
  }
}
// Where Enter clicks.
export function crosshair(c, { width, height }) {
  const u = width / 2, v = height / 2;
  c.strokeStyle = colours.select; c.lineWidth = 1.5;
  c.beginPath();
  for (const [du, dv] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    c.moveTo(u + 4 * du, v + 4 * dv); c.lineTo(u + 12 * du, v + 12 * dv);
  }
  c.stroke();
}
// One end of a pair.
export function mark(c, u, v, words) {
  c.strokeStyle = c.fillStyle = colours.robot; c.lineWidth = 2;
  c.beginPath(); c.arc(u, v, 6, 0, 7); c.stroke();
  c.beginPath(); c.arc(u, v, 1.5, 0, 7); c.fill();
  c.font = "600 13px system-ui, sans-serif"; c.lineWidth = 3; c.strokeStyle = colours.ground;
  c.strokeText(words, u + 9, v - 6); c.fillText(words, u + 9, v - 6);
}
