// What people have said about the map: named places, closures, preferences and portals. GET /annotations; older servers
// have none.
import { add, ask, button, byId } from "./dom.js";
import { colours } from "./colours.js";

let annotations = [], offered = true;

export const placeNames = () => annotations.filter(one => one.body.kind === "place").map(one => one.name);
export const placeNamed = name => annotations.find(one => one.body.kind === "place" && one.name === name);
// The node at a place, or the one that its area, edge or plan hangs on.
export const nodeOf = ({ body }) => body.node || body.area?.anchor || body.edge?.[0] || body.pairs?.[0].node || body.a;

const kindOf = ({ body }) => body.kind === "floor" ? `floor ${body.label}` : body.kind;

export async function loadAnnotations(select) {
  if (!offered) return;
  const answer = await ask("annotations");
  offered = answer.status !== 404;
  if (answer.error) return;
  annotations = (answer.annotations || []).filter(one => one.in_force !== false && !one.removed && one.body);
  const list = byId("places");
  list.textContent = "";
  byId("named").hidden = !annotations.length;
  for (const one of annotations) {
    const item = add(list, "li");
    button(item, one.name, () => select(nodeOf(one) || ""));
    item.append(` ${kindOf(one)}`);
  }
  return placeNames();
}
export function drawAnnotations(c, viewport, model, labels) {
  for (const { name, body } of annotations) {
    const edge = body.edge || (body.kind === "portal" ? [body.a, body.b] : null);
    const colour = { closure: colours.bad, preference: colours.good }[body.kind] || colours.accent;
    c.strokeStyle = c.fillStyle = colour; c.lineWidth = 2;
    const at = id => model.rowOf(id) ?? null;
    let label = null;
    if (body.area) {
      const anchor = at(body.area.anchor);
      if (anchor === null) continue;
      const corners = body.area.corners.map(([x, y]) => viewport.toScreen(...model.inNode(anchor, x, y)));
      c.beginPath(); corners.forEach(([u, v], k) => k ? c.lineTo(u, v) : c.moveTo(u, v)); c.closePath();
      c.globalAlpha = 0.15; c.fill(); c.globalAlpha = 1; c.stroke();
      label = [0, 1].map(k => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length);
    } else if (edge) {
      const [a, b] = edge.map(at);
      if (a === null || b === null) continue;
      const [from, to] = [a, b].map(row => viewport.toScreen(model.x[row], model.y[row]));
      c.lineWidth = 4; c.setLineDash(body.edge ? [] : [3, 5]);
      c.beginPath(); c.moveTo(...from); c.lineTo(...to); c.stroke();
      c.setLineDash([]);
      label = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
    } else if (body.node) {
      const row = at(body.node);
      if (row === null) continue;
      label = viewport.toScreen(model.x[row], model.y[row]);
      c.beginPath(); c.arc(...label, 6, 0, 7); c.stroke();
    } else continue;
    // An edge is named by its nodes unless a person has named it, a floor by its map.
    const words = body.edge?.join(" ") === name || body.kind === "floor" ? kindOf({ body }) : name;
    labels.beside(...label, [words], "name", colour);
  }
}
