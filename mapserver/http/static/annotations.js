// What people have said about the map: named places, closures, preferences and portals. GET /annotations; older servers
// have none.
import { ask, byId, inOrder, listed, when } from "./dom.js";
import { colours } from "./colours.js";

const question = inOrder();
let annotations = [], offered = true;

export const placeNames = () => annotations.filter(one => one.body.kind === "place").map(one => one.name);
export const placeNamed = name => annotations.find(one => one.body.kind === "place" && one.name === name);
// The node at a place, or the one that its area, edge or plan hangs on.
export const nodeOf = ({ body }) => body.node || body.area?.anchor || body.edge?.[0] || body.pairs?.[0].node || body.a;
// The corners of all areas, on the plane.
export const areaCorners = model => annotations.flatMap(({ body: { area } }) => {
  const anchor = model.rowOf(area?.anchor);
  return anchor === undefined ? [] : area.corners.map(([x, y]) => model.inNode(anchor, x, y));
});

// What it is, in a word or two; in the list with its figures.
const kindOf = ({ body }) => body.kind === "floor" ? `floor ${body.label}`
  : body.kind === "preference" ? (body.factor < 1 ? "preferred" : "avoided") : body.kind;
const more = ({ begin_ns: begin, end_ns: end, factor, means, note }) => [
  [begin && ` from ${utc(begin)}`, end && ` until ${utc(end)}`].filter(Boolean).join(""),
  factor && `: cost times ${factor}`, means && `: ${means}`, note && `, ${note}`].filter(Boolean).join("");
const utc = stamp_ns => when(stamp_ns).replace(/:\d\d UTC$/, " UTC");
// A closure holds between its times.
const holds = ({ begin_ns: begin, end_ns: end }) =>
  !(begin && Date.now() * 1e6 < begin) && !(end && Date.now() * 1e6 >= end);
const colourOf = ({ kind, factor }) => ({ closure: colours.bad, preference: factor > 1 ? colours.warn : colours.good })[kind]
  || colours.accent;

export async function loadAnnotations(select) {
  if (!offered) return;
  const isLate = question(), answer = await ask("annotations");
  if (isLate()) return;
  offered = answer.status !== 404;
  if (answer.error) return;
  annotations = (answer.annotations || []).filter(one => one.in_force !== false && !one.removed && one.body);
  byId("named").hidden = !annotations.length;
  listed(byId("places"), annotations.map(one => (
    { text: one.name, key: `${one.body.kind} ${one.name}`, act: () => select(nodeOf(one) || ""), after: [` ${kindOf(one)}${more(one.body)}`] })));
  return placeNames();
}
export function drawAnnotations(c, viewport, model, labels) {
  for (const { name, body } of annotations) {
    const edge = body.edge || (body.kind === "portal" ? [body.a, body.b] : null);
    const colour = colourOf(body), ink = holds(body) ? 1 : 0.4;
    c.strokeStyle = c.fillStyle = colour; c.lineWidth = 2;
    const at = id => model.rowOf(id) ?? null;
    let label = null;
    if (body.area) {
      const anchor = at(body.area.anchor);
      if (anchor === null) continue;
      const corners = body.area.corners.map(([x, y]) => viewport.toScreen(...model.inNode(anchor, x, y)));
      c.beginPath(); corners.forEach(([u, v], k) => k ? c.lineTo(u, v) : c.moveTo(u, v)); c.closePath();
      c.globalAlpha = 0.15 * ink; c.fill(); c.globalAlpha = ink; c.stroke();
      label = [0, 1].map(k => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length);
    } else if (edge) {
      const [a, b] = edge.map(at);
      if (a === null || b === null) continue;
      const [from, to] = [a, b].map(row => viewport.toScreen(model.x[row], model.y[row]));
      c.globalAlpha = ink; c.lineWidth = 4; c.setLineDash(body.edge ? [] : [3, 5]);
      c.beginPath(); c.moveTo(...from); c.lineTo(...to); c.stroke();
      c.setLineDash([]);
      label = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
    } else if (body.node) {
      const row = at(body.node);
      if (row === null) continue;
      label = viewport.toScreen(model.x[row], model.y[row]);
      c.beginPath(); c.arc(...label, 6, 0, 7); c.stroke();
    } else continue;
    c.globalAlpha = 1;
    // An edge is named by its nodes unless a person has named it, a floor by its map, a pin by its node.
    const words = body.edge?.join(" ") === name || ["floor", "pin"].includes(body.kind) ? kindOf({ body }) : name;
    labels.beside(...label, [words], "name", colour);
  }
}
