// Where robots go: the goals of their missions, the places that they must pass before, and the ways there.
import { colours } from "./colours.js";

const DRIVEN = new Set(["sent", "running"]); // of missions, those with a way
const POLE = 16, FLAG = 9, DOT = 3;          // px

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
export function drawGoals(c, viewport, goals, labels) {
  for (const { name, alive, way, goal, passed } of goals) {
    c.strokeStyle = c.fillStyle = alive ? colours.robot : colours.soft;
    c.lineWidth = 3; c.lineJoin = "round"; c.globalAlpha = 0.7;
    c.beginPath();
    way.forEach(([x, y, component], k) => {
      // Parts of the map lie beside each other as there is room.
      if (k && way[k - 1][2] === component) c.lineTo(...viewport.toScreen(x, y));
      else c.moveTo(...viewport.toScreen(x, y));
    });
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
