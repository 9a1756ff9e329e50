// Which part of the plane is shown: metres to pixels and back.
const LEAST = 0.05, MOST = 2000; // pixels a metre
const MARGIN = 36;               // px around what is fitted
const TOOLS = 44;                // px at the right, where the buttons are

export class Viewport {
  constructor() { this.x = this.y = 0; this.scale = 30; this.width = this.height = 1; this.touched = false; }
  toScreen(x, y) { return [(x - this.x) * this.scale + this.width / 2, this.height / 2 - (y - this.y) * this.scale]; }
  toPlane(u, v) { return [(u - this.width / 2) / this.scale + this.x, (this.height / 2 - v) / this.scale + this.y]; }
  // Whether a point is in view, so many px from the edge or more.
  holds(x, y, edge) {
    const [u, v] = this.toScreen(x, y);
    return u >= edge && v >= edge && u <= this.width - edge && v <= this.height - edge;
  }
  pan(du, dv) { this.x -= du / this.scale; this.y += dv / this.scale; this.touched = true; }
  zoom(factor, u = this.width / 2, v = this.height / 2) {
    const [x, y] = this.toPlane(u, v);
    this.scale = Math.min(MOST, Math.max(LEAST, this.scale * factor));
    const [nx, ny] = this.toPlane(u, v);
    this.x += x - nx; this.y += y - ny; this.touched = true;
  }
  fit(bounds, { most = 120, margin = MARGIN, tools = TOOLS } = {}) {
    if (!bounds) return;
    const wide = Math.max(bounds[2] - bounds[0], 1), high = Math.max(bounds[3] - bounds[1], 1);
    const across = (this.width - 2 * margin - tools) / wide, down = (this.height - 2 * margin) / high;
    this.scale = Math.min(most, MOST, Math.max(LEAST, Math.min(across, down)));
    this.x = (bounds[0] + bounds[2] + tools / this.scale) / 2; this.y = (bounds[1] + bounds[3]) / 2;
  }
  show(x, y, least = 40) {
    this.x = x; this.y = y; this.scale = Math.max(this.scale, least); this.touched = true;
  }
}
