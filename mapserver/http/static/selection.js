// What an edit is about: some nodes, or an area. An area hangs on a node, as on the server, so that it moves with the
// map.
import { colours } from "./colours.js";
import { counted } from "./dom.js";

export const within = (corners, x, y) => {
  let odd = false;
  corners.forEach(([x1, y1], k) => {
    const [x2, y2] = corners[(k + 1) % corners.length];
    if ((y1 > y) !== (y2 > y) && x < x1 + (y - y1) / (y2 - y1) * (x2 - x1)) odd = !odd;
  });
  return odd;
};
const listed = names => names.length > 4 ? `${names.slice(0, 4).join(", ")} and ${names.length - 4} more` : names.join(", ");

export class Selection {
  constructor(model) { Object.assign(this, { model, changed() {}, names: [], area: null }); }
  set(names) { this.names = [...new Set(names)]; this.area = null; this.changed(); }
  toggle(name) { this.set(this.names.includes(name) ? this.names.filter(one => one !== name) : [...this.names, name]); }
  clear() { this.set([]); }
  // An area as a place has it.
  take(area) { Object.assign(this, { names: [], area }); this.changed(); }
  // Corners on the plane. The area belongs to the component with most nodes in it.
  enclose(corners) {
    const { model } = this, counts = new Map();
    const [u, v] = [0, 1].map(k => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length);
    for (const row of model.order)
      if (within(corners, model.x[row], model.y[row]))
        counts.set(model.nodes.component[row], (counts.get(model.nodes.component[row]) || 0) + 1);
    const [component] = [...counts].sort((a, b) => b[1] - a[1])[0] || [model.nodes.component[model.nearest(u, v, Infinity)]];
    const anchor = model.nearest(u, v, Infinity, model.members[component]);
    if (anchor < 0) return;
    this.take({ anchor: model.name(anchor), corners: corners.map(([x, y]) =>
      model.toNode(anchor, x, y).map(m => +m.toFixed(4))) });
  }
  // Corners of the area on the plane; none while its anchor is not on the map.
  corners() {
    const anchor = this.area && this.model.rowOf(this.area.anchor);
    return anchor === undefined || !this.area ? [] : this.area.corners.map(([x, y]) => this.model.inNode(anchor, x, y));
  }
  rows() {
    const { model } = this;
    if (!this.area) return this.names.map(name => model.rowOf(name)).filter(row => row !== undefined);
    const corners = this.corners(), component = model.nodes.component[model.rowOf(this.area.anchor)];
    return (model.members[component] || []).filter(row => within(corners, model.x[row], model.y[row]));
  }
  // How much of the map some nodes are, in words.
  words(rows = this.rows()) {
    const { model } = this, inside = new Set(rows), { a, b, kind, count } = model.edges;
    const maps = [...new Set(rows.map(row => model.maps[model.nodes.map[row]]))].sort();
    let edges = 0, links = 0;
    for (let row = 0; row < count; row++) {
      if (!kind[row] || !(inside.has(a[row]) || inside.has(b[row]))) continue;
      if (["merged", "loop"].includes(model.kinds[kind[row]])) links++; else edges++;
    }
    const at = rows.length ? ` of ${listed(maps)}, with ${counted(edges, "edge")} and ${counted(links, "link")}` : "";
    return `${counted(rows.length, "node")}${at}`;
  }
  size() {
    const corners = this.corners();
    return Math.abs(corners.reduce((sum, [x, y], k) => {
      const [u, v] = corners[(k + 1) % corners.length];
      return sum + x * v - u * y;
    }, 0)) / 2;
  }
  draw(c, viewport) {
    const { model } = this;
    c.strokeStyle = c.fillStyle = colours.accent; c.lineWidth = 2.5;
    if (this.area) {
      outline(c, this.corners().map(point => viewport.toScreen(...point)), true);
      return;
    }
    for (const row of this.rows()) {
      const [u, v] = viewport.toScreen(model.x[row], model.y[row]);
      c.beginPath(); c.arc(u, v, 8, 0, 7); c.globalAlpha = 0.3; c.fill(); c.globalAlpha = 1; c.stroke();
    }
  }
}
export function outline(c, points, closed) {
  c.beginPath();
  points.forEach(([u, v], k) => k ? c.lineTo(u, v) : c.moveTo(u, v));
  if (closed) c.closePath();
  c.globalAlpha = 0.18; c.fill(); c.globalAlpha = 1; c.stroke();
}
