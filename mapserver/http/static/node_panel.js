// One node: GET /nodes/NODE.
import { add, ask, button, byId, counted, draw, facts, fixed, retitled, when } from "./dom.js";
import { onPlans } from "./plans.js";
import { drawView } from "./views.js";

const box = byId("selected");
let latest = "";

function pose({ mean, sigma }) {
  const turn = rad => `${fixed(rad * 180 / Math.PI, 1)}\u00b0`;
  return `${fixed(mean[0])}, ${fixed(mean[1])} m, ${turn(mean[2])} ` +
    `(sigma ${sigma[0].toFixed(3)}, ${sigma[1].toFixed(3)} m, ${turn(sigma[2])})`;
}
function picture(parent, node) {
  const { image: [width, height], pixels } = node.node, faded = new Set(node.faded);
  const svg = draw(parent, "svg", { class: "picture", role: "img", viewBox: `-1 -1 ${width + 2} ${height + 2}`,
    "aria-label": `${counted(pixels.length, "landmark")} in the image of ${node.node.id}` });
  const red = faded.size ? "; red: faded" : "";
  const words = add(parent, "small", `The landmarks in its image, ${width} x ${height} px${red}`);
  drawView(svg, node.node, 0, node.no_view, () => {
    svg.setAttribute("aria-label", `The view of ${node.node.id} with its ${counted(pixels.length, "landmark")}`);
    words.textContent = `Its view with the landmarks${red}`;
  }, why => words.append(`. No view: ${why}.`));
  draw(svg, "rect", { x: 0, y: 0, width, height, class: "frame" });
  pixels.forEach(([cx, cy], k) =>
    draw(svg, "circle", { cx, cy, r: width / 130, class: faded.has(k) ? "faded" : "landmark" }));
}
export async function showNode(name, { select, why, send, edit }) {
  latest = name;
  const node = await ask("nodes/" + encodeURIComponent(name));
  if (latest !== name) return;
  retitled(box, `Node ${name}`);
  if (node.error) { add(box, "p", node.error, "bad"); return; }
  const fate = node.superseded;
  facts(box, [
    ["map", node.map],
    ["floor", node.floor],
    ["in the merged map", node.merged_from_robot ? pose(node.merged_from_robot) : "nowhere"],
    ["on the plan", onPlans(node.merged_from_robot?.mean, node.component)],
    ["in its own map", pose(node.map_from_robot)],
    ["landmarks", `${node.landmarks}, ${node.with_depth} with a depth, ${node.faded.length} faded`],
    ["on the wire", `${node.bytes} bytes`],
    ["taken", node.stamp_ns > 1e18 ? when(node.stamp_ns) : `at ${(node.stamp_ns / 1e9).toFixed(1)} s of its robot's clock`],
    ["superseded", fate ? `by ${fate.by}, ${fate.distance.toFixed(2)} m off, ${counted(fate.found, "landmark")} found again` : "no"],
  ]);
  const actions = add(box, "div", "", "actions");
  if (fate) button(actions, `Show ${fate.by}`, () => select(fate.by));
  send(actions, name);
  button(actions, "Edit", () => edit(name));
  picture(box, node);
  add(box, "h3", "Edges and links");
  const list = add(box, "ul", "", "list");
  for (const { node: other, kind, shared } of node.neighbours) {
    const item = add(list, "li");
    button(item, other, () => select(other));
    item.append(` ${kind}` + (shared ? `, ${counted(shared, "landmark")} ` : " "));
    button(item, "why", () => why(name, other)).setAttribute("aria-label", `Why ${name} and ${other} are joined`);
  }
}
export const forget = () => { latest = ""; };
