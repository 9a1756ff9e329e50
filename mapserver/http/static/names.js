// What people type for a node: its id, the name of a place, or a position x,y of the largest component.
import { nodeOf, placeNamed, placeNames } from "./annotations.js";
import { within } from "./selection.js";

const POSITION = /^[-+]?(\d+\.?\d*|\.\d+),[-+]?(\d+\.?\d*|\.\d+)$/;
const REACH = 2; // m from a position to its node, as on the server

// The words of a text, between blanks or commas. Names of places may have blanks, positions have a comma.
export function wordsOf(text) {
  const places = placeNames().sort((a, b) => b.length - a.length), words = [];
  const begins = name => text.startsWith(name) && /^([\s,]|$)/.test(text.slice(name.length));
  while ((text = text.replace(/^[\s,]+/, ""))) {
    const plain = /^\S+/.exec(text)[0].replace(/,+$/, "");
    const word = places.find(begins) || (POSITION.test(plain) ? plain : /^[^\s,]+/.exec(text)[0]);
    words.push(word);
    text = text.slice(word.length);
  }
  return words;
}
// The nearest node of the area to its middle.
function nodeInArea({ anchor, corners }, model) {
  const row = model.rowOf(anchor);
  if (row === undefined) return "";
  const plane = corners.map(([x, y]) => model.inNode(row, x, y));
  const [x, y] = [0, 1].map(k => plane.reduce((sum, corner) => sum + corner[k], 0) / plane.length);
  const inside = model.members[model.nodes.component[row]].filter(one => within(plane, model.x[one], model.y[one]));
  const nearest = model.nearest(x, y, Infinity, inside);
  return nearest < 0 ? "" : model.name(nearest);
}
// The node that a word means, or why it means none: `{ node }` or `{ lacks }`.
export function nodeNamed(word, model) {
  if (model.rowOf(word) !== undefined) return { node: word };
  const place = placeNamed(word);
  if (place) {
    const node = place.body.area ? nodeInArea(place.body.area, model) : nodeOf(place);
    return model.rowOf(node) === undefined ? { lacks: `No node of the map is at place ${word} now.` } : { node };
  }
  if (!POSITION.test(word)) return { lacks: `Neither a node nor a place is called \u201c${word}\u201d.` };
  const [dx, dy] = model.offset(0), [x, y] = word.split(",").map(Number);
  const row = model.nearest(x + dx, y + dy, REACH, model.members?.[0] || []);
  return row < 0 ? { lacks: `Nothing is mapped within ${REACH} m of ${word}.` } : { node: model.name(row) };
}
