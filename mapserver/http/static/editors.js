// What can be changed by a form: each kind of edit with its fields, and the request that it makes of the selection.
// A further kind is one more entry.
import { counted } from "./dom.js";

const lacks = words => { throw new Error(words); };

function nodes({ names, area }, count, what) {
  if (area) lacks(`${what} is about nodes: select them on the map or type them above, not an area.`);
  if (count ? names.length !== count : !names.length)
    lacks(`${what} is about ${count ? counted(count, "node") : "nodes"}: ${names.length} selected.`);
  return names;
}
// A node with some floor around, a way between two nodes, or an area.
function where({ names, area }, what, radius) {
  if (area) return { area };
  if (names.length === 1) return { node: names[0], radius: Number(radius) || 1 };
  if (names.length === 2) return { edge: names };
  return lacks(`${what} is about an area, one node with the floor around it, or two nodes with the way between them.`);
}
// All of some numbers, or none of them.
function numbers(texts, words) {
  if (texts.every(text => text === "")) return null;
  return texts.some(text => text === "") ? lacks(words) : texts.map(Number);
}
const named = ({ names, area }, given) =>
  given || (area ? lacks("Give the area a name.") : names.join(" "));
const time = text => text ? new Date(text).toISOString() : undefined;
const constraint = content => ({ path: "constraints", content });
const annotation = (name, body) => ({ path: "annotations", content: { name, body } });
const mapOf = name => name.slice(0, name.lastIndexOf("."));

const RADIUS = { name: "radius", label: "Radius, m", type: "number", value: 1, min: 0.1, step: 0.1 };
const BEGIN = { name: "begin", label: "From", type: "datetime-local" };
const END = { name: "end", label: "Until", type: "datetime-local" };
const windowed = ({ scope }) => scope === "window";

export const EDITORS = [
  { id: "link", group: "What is merged", label: "Link two places",
    hint: "Two nodes that see one place. The server asks their images, and whether the map allows it.",
    // Shown when the server asks for it.
    more: "By hand: where the second node is, seen from the first", moreWhen: /by hand/,
    fields: [
      { name: "x", label: "Ahead, m", type: "number", step: "any", more: true },
      { name: "y", label: "To the left, m", type: "number", step: "any", more: true },
      { name: "deg", label: "Turned left, deg", type: "number", step: "any", more: true },
    ],
    request(selection, { x, y, deg }) {
      const link = nodes(selection, 2, "A link");
      const pose = numbers([x, y, deg], "A pose by hand has three numbers: ahead, left and turned.");
      return constraint(pose ? { link, pose } : { link });
    } },
  { id: "unmerge", group: "What is merged", label: "Undo a link",
    hint: "Two nodes, or two maps, that do not show one place. They are not linked again.",
    fields: [{ name: "scope", label: "Undo", options: [["nodes", "the link of both nodes"],
      ["maps", "all links of both maps"]] }],
    request(selection, { scope }) {
      const both = nodes(selection, 2, "What is undone");
      return constraint({ unmerge: scope === "maps" ? both.map(mapOf) : both });
    } },
  { id: "retire", group: "What is merged", label: "Retire",
    hint: "It takes no part in the merge, in routes and in answers any more. Nothing is deleted. Times are this device's.",
    fields: [{ name: "scope", label: "Retire", options: [["selected", "the nodes or the area"],
      ["map", "the node's whole map"], ["window", "its map between times"]] },
      { ...BEGIN, step: 1, when: windowed }, { ...END, step: 1, when: windowed }],
    whole: ({ scope }) => scope !== "selected",
    request(selection, { scope, begin, end }) {
      if (scope === "window") {
        const [node] = nodes(selection, 1, "Retiring a time window");
        if (!begin && !end) lacks("A time window begins or ends: give one of the times, or both.");
        return constraint({ window: { map: mapOf(node), begin: time(begin), end: time(end) } });
      }
      if (scope === "map") return constraint({ retire: [mapOf(nodes(selection, 1, "Retiring a map")[0])] });
      return constraint(selection.area ? { area: selection.area } : { retire: nodes(selection, 0, "Retiring") });
    } },
  { id: "place", group: "What is said about it", label: "Name a place",
    hint: "A node or an area with a name, which stands wherever a node may stand.",
    fields: [{ name: "name", label: "Name", type: "text", required: true, maxLength: 64 }],
    request: (selection, { name }) => annotation(name, { kind: "place",
      ...selection.area ? { area: selection.area } : { node: nodes(selection, 1, "A place")[0] } }) },
  { id: "closure", group: "What is said about it", label: "Close a way or an area",
    hint: "No route leads through an area, the floor around one node, or the way between two. Times are this device's.",
    fields: [{ name: "name", label: "Name", type: "text", maxLength: 64, placeholder: "of an area" }, RADIUS,
      BEGIN, END],
    request: (selection, { name, radius, begin, end }) => annotation(named(selection, name), { kind: "closure",
      ...where(selection, "A closure", radius), begin_ns: time(begin), end_ns: time(end) }) },
  { id: "preference", group: "What is said about it", label: "Prefer or avoid",
    hint: "The cost of the ways there is multiplied by the factor: below 1 they are preferred, above 1 avoided.",
    fields: [{ name: "name", label: "Name", type: "text", maxLength: 64, placeholder: "of an area" }, RADIUS,
      { name: "factor", label: "Factor, 0.1 to 100", type: "number", value: 4, min: 0.1, max: 100, step: "any", required: true }],
    request: (selection, { name, radius, factor }) => annotation(named(selection, name), { kind: "preference",
      ...where(selection, "A preference", radius), factor: Number(factor) }) },
  { id: "floor", group: "What is said about it", label: "Label a floor",
    hint: "The floor of the map to which the node belongs. Maps on different floors are never linked.",
    fields: [{ name: "label", label: "Floor", type: "text", required: true, maxLength: 64 }],
    whole: () => true,
    request(selection, { label }) {
      const [node] = nodes(selection, 1, "A floor");
      return annotation(mapOf(node), { kind: "floor", node, label });
    } },
  { id: "portal", group: "What is said about it", label: "Lift, ramp or door",
    hint: "Two nodes, one at each side. A robot parks before it and asks to be taken through.",
    fields: [{ name: "name", label: "Name", type: "text", required: true, maxLength: 64 },
      { name: "means", label: "It is a", options: [["lift", "lift"], ["ramp", "ramp"], ["door", "door"]] },
      { name: "note", label: "Note", type: "text", maxLength: 120, placeholder: "where the key is" }],
    request(selection, { name, means, note }) {
      const [a, b] = nodes(selection, 2, "A portal");
      return annotation(name, { kind: "portal", a, b, means, note });
    } },
  { id: "pin", group: "What is said about it", label: "Pin a frame",
    hint: "The node keeps its present pose, or gets the one that you give, so the frame of its component never jumps.",
    fields: [
      { name: "x", label: "x, m", type: "number", step: "any", placeholder: "as it is" },
      { name: "y", label: "y, m", type: "number", step: "any", placeholder: "as it is" },
      { name: "deg", label: "Heading, deg", type: "number", step: "any", placeholder: "as it is" },
    ],
    request(selection, { x, y, deg }) {
      const [node] = nodes(selection, 1, "A pin"), pose = numbers([x, y, deg], "A pose has x, y and a heading.");
      return annotation(node, { kind: "pin", node,
        ...pose ? { merged_from_node: [pose[0], pose[1], pose[2] * Math.PI / 180] } : {} });
    } },
];
