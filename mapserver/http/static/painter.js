// Draws the map. Nodes and edges go into a bitmap that is larger than the window: panning moves it, and it is
// drawn again when the window leaves it, when the zoom has come to rest, or when the map has changed.
import { colours, edgeColour, hue } from "./colours.js";
import { byId } from "./dom.js";
import { Labels } from "./labels.js";
import { SUPERSEDED } from "./map_model.js";

const BORDER = 0.35;      // of the window's size, on each side of the bitmap
const CHUNK = 400;        // lines in one path: long paths take much longer
const REST = 120;         // ms without a further zoom
const QUICK = 12;         // ms: a bitmap that takes no longer is drawn at once
const NAMED = 38;         // px a metre, from which on nodes have names
const RULE = 90;          // px, longest ruler
const SIGMAS = 2;         // of the ellipse about a robot

const words = robot => robot.name + (robot.doing ? `: ${robot.doing}` : "");

export class Painter {
  constructor(canvas, model, viewport) {
    Object.assign(this, { canvas, model, viewport, robots: [], underlays: [], overlays: [], selected: -1, link: -1, robot: "" });
    this.bitmap = document.createElement("canvas");
    this.drawn = null; this.cost = 0; this.waiting = 0; this.asked = false; this.kept = [];
  }
  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = window.devicePixelRatio || 1;
    Object.assign(this.viewport, { width, height });
    this.ratio = ratio;
    this.canvas.width = Math.round(width * ratio); this.canvas.height = Math.round(height * ratio);
    // The buttons and the ruler.
    const { offsetLeft: left, offsetTop: top, offsetWidth: wide, offsetHeight: high } = byId("tools");
    this.kept = [[left, top, left + wide, top + high], [width - 14 - RULE, height - 32, width, height]];
    this.drawn = null;
    this.ask();
  }
  changed() { this.drawn = null; this.ask(); }
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
      c.drawImage(this.bitmap, Math.round((u - d.width / 2 * zoom) * ratio), Math.round((w - d.height / 2 * zoom) * ratio),
        this.bitmap.width * zoom, this.bitmap.height * zoom);
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
  refresh() {
    const d = this.drawn, v = this.viewport;
    if (d) {
      const [left, bottom] = v.toPlane(0, v.height), [right, top] = v.toPlane(v.width, 0);
      const inside = left >= d.left && right <= d.right && bottom >= d.bottom && top <= d.top;
      if (d.scale === v.scale && inside) return;
      clearTimeout(this.waiting);
      if (d.scale !== v.scale && this.cost > QUICK) {
        this.waiting = setTimeout(() => this.changed(), REST);
        return;
      }
    }
    const began = performance.now();
    this.paint();
    this.cost = performance.now() - began;
  }
  paint() {
    const { viewport: v, ratio, bitmap } = this;
    const width = v.width * (1 + 2 * BORDER), height = v.height * (1 + 2 * BORDER);
    if (bitmap.width !== Math.ceil(width * ratio) || bitmap.height !== Math.ceil(height * ratio)) {
      bitmap.width = Math.ceil(width * ratio); bitmap.height = Math.ceil(height * ratio);
    }
    const wide = width / v.scale, high = height / v.scale;
    this.drawn = { x: v.x, y: v.y, scale: v.scale, width, height, left: v.x - wide / 2, right: v.x + wide / 2,
      bottom: v.y - high / 2, top: v.y + high / 2 };
    const c = bitmap.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    this.paintEdges(c);
    this.paintNodes(c);
  }
  paintEdges(c) {
    const { drawn: d, model: m } = this, { a, b, kind, probability } = m.edges, lines = {};
    const x = m.x, y = m.y, shortest = 1.5 / d.scale;
    for (let row = 0; row < m.edges.count; row++) {
      if (!kind[row]) continue;
      const i = a[row], j = b[row];
      if (Math.max(x[i], x[j]) < d.left || Math.min(x[i], x[j]) > d.right) continue;
      if (Math.max(y[i], y[j]) < d.bottom || Math.min(y[i], y[j]) > d.top) continue;
      if (Math.abs(x[i] - x[j]) + Math.abs(y[i] - y[j]) < shortest) continue;
      const name = m.kinds[kind[row]], doubtful = name === "merged" && probability[row] < 0.9;
      (lines[doubtful ? "doubtful" : name] ||= []).push(i, j);
    }
    for (const name of ["mapped", "turned", "driven", "loop", "merged", "doubtful"]) {
      const ends = lines[name] || [], merged = name === "merged" || name === "doubtful";
      c.strokeStyle = edgeColour(name === "doubtful" ? "merged" : name);
      c.lineWidth = merged ? 1.6 : name === "driven" ? 1.8 : 1.2;
      c.setLineDash(name === "doubtful" ? [5, 4] : []);
      for (let k = 0; k < ends.length; k += 2 * CHUNK) {
        c.beginPath();
        for (let n = k; n < Math.min(ends.length, k + 2 * CHUNK); n += 2) {
          c.moveTo((x[ends[n]] - d.left) * d.scale, (d.top - y[ends[n]]) * d.scale);
          c.lineTo((x[ends[n + 1]] - d.left) * d.scale, (d.top - y[ends[n + 1]]) * d.scale);
        }
        c.stroke();
      }
    }
    c.setLineDash([]);
  }
  paintNodes(c) {
    const { drawn: d, model: m } = this, { state, heading } = m.nodes, far = d.scale < 14;
    const size = far ? Math.min(3, Math.max(1.5, d.scale / 4)) : Math.min(7, 2.5 + d.scale / 18);
    m.members?.forEach((rows, component) => {
      c.fillStyle = c.strokeStyle = hue(m.components[component].anchor);
      c.lineWidth = 1.4;
      for (const faint of [true, false]) {
        c.globalAlpha = faint ? 0.35 : 1;
        for (const row of rows) {
          if ((state[row] === SUPERSEDED) !== faint) continue;
          const x = m.x[row], y = m.y[row];
          if (x < d.left || x > d.right || y < d.bottom || y > d.top) continue;
          const u = (x - d.left) * d.scale, w = (d.top - y) * d.scale;
          if (far) { c.fillRect(u - size / 2, w - size / 2, size, size); continue; }
          c.beginPath();
          c.arc(u, w, size / 2, 0, 7);
          c.moveTo(u, w);
          c.lineTo(u + 1.8 * size * Math.cos(heading[row]), w - 1.8 * size * Math.sin(heading[row]));
          c.fill(); c.stroke();
        }
      }
      c.globalAlpha = 1;
    });
  }
  marks(c) {
    const { model: m, viewport: v } = this;
    if (this.link >= 0 && m.edges.kind[this.link]) {
      c.strokeStyle = colours.select; c.lineWidth = 3;
      c.beginPath();
      c.moveTo(...v.toScreen(m.x[m.edges.a[this.link]], m.y[m.edges.a[this.link]]));
      c.lineTo(...v.toScreen(m.x[m.edges.b[this.link]], m.y[m.edges.b[this.link]]));
      c.stroke();
    }
    if (this.selected >= 0 && m.nodes.state?.[this.selected]) {
      const [u, w] = v.toScreen(m.x[this.selected], m.y[this.selected]);
      c.strokeStyle = colours.select; c.lineWidth = 2;
      c.beginPath(); c.arc(u, w, 10, 0, 7); c.stroke();
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
      if (m.x[row] < left || m.x[row] > right || m.y[row] < bottom || m.y[row] > top) continue;
      const text = m.name(row), [u, w] = v.toScreen(m.x[row], m.y[row]);
      labels.at(u + 9, w - 4, text, "node", colours.soft, 6.2 * text.length);
    }
  }
  // Robots come first: no text lies on one, and each has its name, with what it does where there is room.
  label(labels) {
    const placed = this.robots.map(robot => [robot, ...this.viewport.toScreen(robot.x, robot.y)]);
    for (const [, u, w] of placed) labels.keep(u - 10, w - 7, u + 10, w + 7);
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
