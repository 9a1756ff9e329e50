// What people type for a node: its id, the name of a place, a position x,y of the largest component, or one on a floor plan, with
// the plan's name before it.
import { nodeOf, placeNamed, placeNames } from "./annotations.js";
import { fromPlan, planNames } from "./plans.js";
import { within } from "./selection.js";

const NUMBER = "[-+]?(?:\\d+\\.?\\d*|\\.\\d+)";
const POSITION = new RegExp(`^${NUMBER},\\s*${NUMBER}$`), AHEAD = new RegExp(`^${NUMBER},\\s*${NUMBER}(?=,?(\\s|$))`);
const AFTER_NAME = new RegExp(`^\\s+(${NUMBER}),\\s*(${NUMBER})(?=[\\s,]|$)`);
const REACH = 2; // m from a position to its node, as on the server

const longestFirst = names => names.sort((a, b) => b.length - a.length);
// The words of a text, between blanks or commas. Names of places may have blanks, positions have a comma, and one on a plan has
// the plan's name before it.
export function wordsOf(text) {
  const places = longestFirst(placeNames()), words = [];
  const plans = longestFirst(planNames());
  const onPlan = name => text.startsWith(name) && AFTER_NAME.exec(text.slice(name.length));
  const begins = name => text.startsWith(name) && /^([\s,]|$)/.test(text.slice(name.length));
  while ((text = text.replace(/^[\s,]+/, ""))) {
    const plan = plans.find(onPlan), word = plan ? plan + onPlan(plan)[0]
      : places.find(begins) || (AHEAD.exec(text) || /^[^\s,]+/.exec(text))[0];
    words.push(POSITION.test(word) ? word.replace(/\s+/, "") : word);
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
// The node nearest to a position on a plan.
function nodeOnPlan(word, name, [, x, y], model) {
  const parts = fromPlan(name, Number(x), Number(y)).filter(([component]) => model.members?.[component]);
  if (!parts.length) return { lacks: `Plan ${name} lies under no part of the map now.` };
  const rows = parts.map(([component, x, y]) =>
    model.nearest(...model.placed([x, y, 0], component).slice(0, 2), REACH, model.members[component]));
  const row = rows.find(one => one >= 0);
  return row === undefined ? { lacks: `Nothing is mapped within ${REACH} m of ${word}.` } : { node: model.name(row) };
}
// The plan of which a word is a position, and what comes after its name: [name, match]; else nothing.
function planOf(word) {
  for (const name of longestFirst(planNames())) {
    const after = word.startsWith(name) && AFTER_NAME.exec(word.slice(name.length));
    if (after && name.length + after[0].length === word.length) return [name, after];
  }
  return null;
}
// As a goal for the server, which knows no plans by these words: a position on a plan is the nearest node.
export function goalOf(word, model) {
  return planOf(word) ? nodeNamed(word, model) : { node: word };
}
// The node that a word means, or why it means none: `{ node }` or `{ lacks }`.
export function nodeNamed(word, model) {
  if (model.rowOf(word) !== undefined) return { node: word };
  const plan = planOf(word);
  if (plan) return nodeOnPlan(word, ...plan, model);
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
