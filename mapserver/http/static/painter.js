// Draws the map. A worker draws nodes and edges into a bitmap that is larger than the window. Panning moves it and
// zooming scales it, until there is a new one.
import { colours, edgeColour, hue } from "./colours.js";
import { byId } from "./dom.js";
import { Labels } from "./labels.js";
import { SUPERSEDED } from "./map_model.js";

const BORDER = 0.35;      // of the window's size, on each side of the bitmap
const NEAR = 0.1;         // of the window's size, from the border at which a new bitmap is asked for
const BLUR = 1.5;         // while the scale changes, the bitmap is scaled so much, up or down, before a new one is asked for
const REST = 120;         // ms without a change of the scale, after which it is sharp again
const NAMED = 38;         // px a metre, from which on nodes have names
const RULE = 90;          // px, longest ruler
const RING = 10;          // px, radius of the ring about the selected node
const SIGMAS = 2;         // of the ellipse about a robot

const words = robot => robot.name + (robot.doing ? `: ${robot.doing}` : "");

export class Painter {
  constructor(canvas, model, viewport) {
    Object.assign(this, { canvas, model, viewport, robots: [], underlays: [], overlays: [], selected: -1, ways: [], robot: "" });
    this.bitmap = this.drawn = null; this.stale = this.waiting = this.asked = false; this.kept = [];
    this.scale = this.since = this.resting = 0;
    this.worker = new Worker(new URL("map_bitmap.js", import.meta.url));
    this.worker.onmessage = ({ data: { bitmap, view } }) => {
      if (!this.bitmap) requestAnimationFrame(() => performance.mark("map drawn"));
      this.bitmap?.close();
      Object.assign(this, { bitmap, drawn: view, waiting: false });
      this.ask();
    };
    this.worker.onerror = () => { this.waiting = false; byId("undrawn").hidden = false; };
  }
  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = window.devicePixelRatio || 1;
    Object.assign(this.viewport, { width, height });
    this.ratio = ratio;
    this.canvas.width = Math.round(width * ratio); this.canvas.height = Math.round(height * ratio);
    // The buttons and the ruler.
    const { offsetLeft: left, offsetTop: top, offsetWidth: wide, offsetHeight: high } = byId("tools");
    this.kept = [[left, top, left + wide, top + high], [width - 14 - RULE, height - 32, width, height]];
    this.stale = true;
    this.ask();
  }
  // The map or the theme has changed.
  changed() {
    const { x, y, nodes, edges, kinds, members = [], components } = this.model, { heading, state } = nodes;
    const hues = components.map(({ anchor }) => hue(anchor)), all = Object.fromEntries(kinds.map(kind => [kind, edgeColour(kind)]));
    this.worker.postMessage({ map: { x, y, heading, state, superseded: SUPERSEDED, edges, kinds, members, hues, colours: all } });
    this.stale = true;
    this.ask();
  }
  ask() {
    if (this.asked || !this.ratio) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.frame(); });
  }
  frame() {
    const { viewport: v, ratio } = this, c = this.canvas.getContext("2d");
    this.refresh();
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colours.ground;
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    for (const underlay of this.underlays) underlay(c, v, this.model);
    c.setTransform(1, 0, 0, 1, 0, 0);
    if (this.drawn) {
      const d = this.drawn, [u, w] = v.toScreen(d.x, d.y), zoom = v.scale / d.scale;
      const size = zoom * ratio / d.ratio;
      c.drawImage(this.bitmap, Math.round((u - d.width / 2 * zoom) * ratio), Math.round((w - d.height / 2 * zoom) * ratio),
        this.bitmap.width * size, this.bitmap.height * size);
    }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const labels = this.labels = new Labels(c, v, colours.ground);
    for (const box of this.kept) labels.keep(...box);
    this.label(labels);
    for (const overlay of this.overlays) overlay(c, v, this.model, labels);
    this.marks(c);
    this.names(labels);
    for (const robot of this.robots) this.drawRobot(c, robot);
    labels.draw();
    this.rule(c);
  }
  // Ask for a bitmap where the last one does not fit the window; one at a time.
  refresh() {
    const { viewport: v, drawn: d, ratio } = this;
    if (this.waiting || !this.model.members || !v.width || !v.height) return;
    if (!this.stale && d && this.covers(d) && (d.scale === v.scale || this.zooms(d))) return;
    const width = v.width * (1 + 2 * BORDER), height = v.height * (1 + 2 * BORDER);
    const wide = width / v.scale, high = height / v.scale;
    this.waiting = true; this.stale = false;
    this.worker.postMessage({ view: { x: v.x, y: v.y, scale: v.scale, ratio, width, height, left: v.x - wide / 2,
      right: v.x + wide / 2, bottom: v.y - high / 2, top: v.y + high / 2 } });
  }
  // Whether the scale is changing, and a scaled bitmap does meanwhile: the worker would take a core for itself.
  zooms(d) {
    const { viewport: v } = this, now = performance.now();
    if (v.scale !== this.scale) Object.assign(this, { scale: v.scale, since: now });
    if (now - this.since >= REST || Math.max(v.scale / d.scale, d.scale / v.scale) > BLUR) return false;
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.ask(), REST);
    return true;
  }
  covers(d) {
    const { viewport: v } = this, du = NEAR * v.width, dv = NEAR * v.height;
    const [left, bottom] = v.toPlane(-du, v.height + dv), [right, top] = v.toPlane(v.width + du, -dv);
    return left >= d.left && right <= d.right && bottom >= d.bottom && top <= d.top;
  }
  marks(c) {
    const { model: m, viewport: v } = this;
    c.strokeStyle = colours.select; c.lineWidth = 3;
    for (const { a, b, dashed } of this.ways) {
      const [i, j] = [m.rowOf(a), m.rowOf(b)];
      // Components lie beside each other as there is room.
      if (i === undefined || j === undefined || m.nodes.component[i] !== m.nodes.component[j]) continue;
      c.setLineDash(dashed ? [6, 5] : []);
      c.beginPath(); c.moveTo(...v.toScreen(m.x[i], m.y[i])); c.lineTo(...v.toScreen(m.x[j], m.y[j])); c.stroke();
    }
    c.setLineDash([]);
    if (this.selected >= 0 && m.nodes.state?.[this.selected]) {
      const [u, w] = v.toScreen(m.x[this.selected], m.y[this.selected]);
      c.strokeStyle = colours.select; c.lineWidth = 2;
      c.beginPath(); c.arc(u, w, RING, 0, 7); c.stroke();
    }
  }
  // Names of components where there are several, and of nodes.
  names(labels) {
    const { model: m, viewport: v } = this;
    if (m.components.length > 1)
      m.components.forEach(({ anchor, floor }, k) => {
        const box = m.boxes[k], [dx, dy] = m.offset(k), [u, w] = v.toScreen(box[0] + dx, box[3] + dy);
        labels.at(u, w - 14, `component ${k}${floor ? `, floor ${floor}` : ""}`, "component", hue(anchor));
      });
    if (v.scale < NAMED) return;
    const [left, bottom] = v.toPlane(0, v.height), [right, top] = v.toPlane(v.width, 0);
    for (const row of m.order) {
      if (row === this.selected) continue;
      if (m.x[row] < left || m.x[row] > right || m.y[row] < bottom || m.y[row] > top) continue;
      const text = m.name(row), [u, w] = v.toScreen(m.x[row], m.y[row]);
      labels.at(u + 9, w - 4, text, "node", colours.soft, 6.2 * text.length);
    }
  }
  // Robots come first: no text lies on one, and each has its name, with what it does where there is room. The selected
  // node has its name at every scale: among many, that of its neighbour would lie in its ring.
  label(labels) {
    const { model: m, viewport: v } = this, placed = this.robots.map(robot => [robot, ...v.toScreen(robot.x, robot.y)]);
    for (const [, u, w] of placed) labels.keep(u - 10, w - 7, u + 10, w + 7);
    if (this.selected >= 0 && m.nodes.state?.[this.selected]) {
      const [u, w] = v.toScreen(m.x[this.selected], m.y[this.selected]);
      labels.keep(u - RING, w - RING, u + RING, w + RING);
      labels.beside(u, w, [m.name(this.selected)], "selected", colours.select);
    }
    for (const [robot, u, w] of placed)
      labels.beside(u, w, [words(robot), robot.name], "robot", robot.alive ? colours.robot : colours.soft);
  }
  drawRobot(c, robot) {
    const { viewport: v } = this, colour = robot.alive ? colours.robot : colours.soft;
    const [u, w] = v.toScreen(robot.x, robot.y);
    c.save();
    c.translate(u, w); c.rotate(-robot.heading);
    if (robot.ellipse) {
      const { major, minor, angle } = robot.ellipse;
      c.strokeStyle = c.fillStyle = colour;
      c.beginPath();
      c.ellipse(0, 0, SIGMAS * major * v.scale, SIGMAS * minor * v.scale, -angle, 0, 7);
      c.globalAlpha = 0.15; c.fill(); c.globalAlpha = 0.7; c.lineWidth = 1; c.stroke(); c.globalAlpha = 1;
    }
    c.beginPath(); c.moveTo(13, 0); c.lineTo(-8, 7); c.lineTo(-4, 0); c.lineTo(-8, -7); c.closePath();
    c.fillStyle = colour; c.fill();
    c.strokeStyle = robot.name === this.robot ? colours.select : colours.ground; c.lineWidth = 2; c.stroke();
    c.restore();
  }
  // A ruler of a round length.
  rule(c) {
    const { viewport: v } = this, aim = RULE / v.scale, power = 10 ** Math.floor(Math.log10(aim));
    const length = [5, 2, 1].map(k => k * power).find(one => one <= aim) * v.scale;
    const right = v.width - 14, base = v.height - 14;
    c.strokeStyle = c.fillStyle = colours.soft; c.lineWidth = 1.5;
    c.beginPath(); c.moveTo(right - length, base - 5); c.lineTo(right - length, base); c.lineTo(right, base);
    c.lineTo(right, base - 5); c.stroke();
    c.font = "11px system-ui, sans-serif"; c.textAlign = "right";
    c.fillText(`${+(length / v.scale).toPrecision(2)} m`, right, base - 8);
    c.textAlign = "left";
  }
}
