// Where robots go: the goals of their missions, the places that they must pass before, and the ways there.
import { colours } from "./colours.js";

const DRIVEN = new Set(["sent", "running"]); // of missions, those with a way
const POLE = 16, FLAG = 9, DOT = 3;          // px
const OFF = 1;                               // px by which a way is drawn beside its points, at most

// Each with the points of its way on the plane from where it is drawn; null between parts of the map.
export function goalsOf(robots, drawn, model) {
  return robots.flatMap(({ robot: name, alive, status, ahead = [] }) => {
    const { order, state } = status?.mission || {}, at = id => {
      const row = model.rowOf(id);
      return row === undefined || !model.nodes.state[row] ? null : [model.x[row], model.y[row], model.nodes.component[row]];
    };
    if (!order?.node || !DRIVEN.has(state)) return [];
    const from = drawn.find(one => one.name === name), nodes = ahead.map(at).filter(Boolean);
    const way = from && nodes.length ? [[from.x, from.y, nodes[0][2]], ...nodes] : [];
    return [{ name, alive, way, goal: at(order.node), passed: order.via.slice(status.status.passed).map(at).filter(Boolean) }];
  });
}
// The points of a line that are needed for it to pass all others within `most` (Ramer, Douglas, Peucker): each
// joint of a wide line takes as long as a short line.
export function simplified(points, most) {
  const kept = new Set([0, points.length - 1]), open = [[0, points.length - 1]];
  while (open.length) {
    const [first, last] = open.pop(), [x, y] = points[first], dx = points[last][0] - x, dy = points[last][1] - y;
    const length2 = dx * dx + dy * dy || 1;
    let farthest = 0, at = -1;
    for (let k = first + 1; k < last; k++) {
      const u = points[k][0] - x, v = points[k][1] - y, share = Math.min(1, Math.max(0, (u * dx + v * dy) / length2));
      const off = Math.hypot(u - share * dx, v - share * dy);
      if (off > farthest) { farthest = off; at = k; }
    }
    if (farthest > most) { kept.add(at); open.push([first, at], [at, last]); }
  }
  return points.filter((_, k) => kept.has(k));
}
// The lines of a way, for scales up to the next power of two: they are not sought again for each frame.
function linesOf(goal, scale) {
  const octave = Math.ceil(Math.log2(scale));
  if (goal.octave !== octave) {
    const lines = [];
    goal.way.forEach((point, k, way) => {
      // Parts of the map lie beside each other as there is room.
      if (k && way[k - 1][2] === point[2]) lines.at(-1).push(point); else lines.push([point]);
    });
    Object.assign(goal, { octave, lines: lines.map(points => simplified(points, OFF / 2 ** octave)) });
  }
  return goal.lines;
}
export function drawGoals(c, viewport, goals, labels) {
  for (const one of goals) {
    const { name, alive, goal, passed } = one;
    c.strokeStyle = c.fillStyle = alive ? colours.robot : colours.soft;
    c.lineWidth = 3; c.lineJoin = "round"; c.globalAlpha = 0.7;
    c.beginPath();
    for (const line of linesOf(one, viewport.scale))
      line.forEach(([x, y], k) => k ? c.lineTo(...viewport.toScreen(x, y)) : c.moveTo(...viewport.toScreen(x, y)));
    c.stroke();
    c.globalAlpha = 1; c.lineWidth = 2;
    for (const [x, y] of passed) {
      c.beginPath(); c.arc(...viewport.toScreen(x, y), 2 * DOT, 0, 7); c.stroke();
    }
    if (!goal) continue;
    const [u, v] = viewport.toScreen(goal[0], goal[1]);
    c.beginPath(); c.moveTo(u, v); c.lineTo(u, v - POLE); c.stroke();
    c.beginPath(); c.moveTo(u, v - POLE - 1); c.lineTo(u + FLAG + 3, v - POLE + FLAG / 2); c.lineTo(u, v - POLE + FLAG); c.fill();
    c.beginPath(); c.arc(u, v, DOT, 0, 7); c.fill();
    labels.keep(u - DOT, v - POLE, u + FLAG + 3, v + DOT);
    labels.beside(u, v, [`goal of ${name}`], "robot", c.fillStyle);
  }
}
