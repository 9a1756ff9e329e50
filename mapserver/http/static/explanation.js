// Why two nodes or maps are one, or are not, and why a route leads as it does: GET /explain and GET /route.
import { add, ask, button, byId, counted, degrees, draw, metres, percent } from "./dom.js";
import { drawView } from "./views.js";

const BAD_PX = 10;
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const SHOWN = 12;
const result = byId("result");

function colour(px) {
  const at = 4 * Math.min(px === null ? BAD_PX : px, BAD_PX) / BAD_PX, k = Math.min(Math.floor(at), 3);
  return "rgb(" + COLOURS[k].map((c, i) => Math.round(c + (at - k) * (COLOURS[k + 1][i] - c))) + ")";
}
// Both views with the landmarks that match, one below the other, as the panel is narrow; the images where their robots
// have kept them.
function picture(parent, pair) {
  const nodes = [pair.a, pair.b], [above, below] = nodes.map(node => node.image);
  const wide = Math.max(above[0], below[0]), px = wide / 320, shift = [0, above[1] + 22 * px];
  const agreement = `${counted(pair.shared.length, "landmark")} of ${pair.a.id} and ${pair.b.id} agree`;
  const svg = draw(parent, "svg", { role: "img", class: "picture",
    "aria-label": agreement,
    viewBox: [-2 * px, -18 * px, wide + 4 * px, shift[1] + below[1] + 20 * px].join(" ") });
  const seen = [], words = add(parent, "small");
  nodes.forEach((node, k) => {
    const { id, image: [width, height] } = node;
    drawView(svg, node, shift[k], pair.no_views[id], () => {
      seen.push(id);
      svg.setAttribute("aria-label", `${agreement}, drawn over the view of ${seen.sort().join(" and ")}`);
    }, why => { words.append(` No view of ${id}: ${why}.`); });
    draw(svg, "rect", { x: 0, y: shift[k], width, height, class: "frame" });
    draw(svg, "text", { x: 0, y: shift[k] - 5 * px, "font-size": 13 * px }).textContent = id;
  });
  const agree = new Set(pair.shared.map(String));
  const line = ([i, j], values) => {
    const [x, y] = pair.a.pixels[i], [u, v] = pair.b.pixels[j];
    draw(svg, "line", { x1: x, y1: y, x2: u, y2: v + shift[1], ...values });
  };
  for (const match of pair.matches)
    if (!agree.has(String(match))) line(match, { "stroke-width": 0.5 * px, class: "alike" });
  pair.shared.forEach((match, k) =>
    line(match, { stroke: colour(pair.residuals_px[k]), "stroke-width": 1.1 * px, class: "agree" }));
  nodes.forEach(({ pixels }, k) => pixels.forEach(([x, y]) =>
    draw(svg, "circle", { cx: x, cy: y + shift[k], r: 1.3 * px, class: "landmark" })));
  const alike = pair.matches.filter(match => !agree.has(String(match))).length;
  words.prepend(`Dots are landmarks. ${pair.shared.length} agree on one pose: dark where it predicts them, yellow where it is ` +
    `${BAD_PX} px off. ${alike} match and do not agree: grey.`);
}
function pose({ mean, sigma }) {
  return `${metres(mean)} (sigma ${sigma[0].toFixed(3)} m, ${sigma[1].toFixed(3)} m, ` +
    `${(sigma[2] * 180 / Math.PI).toFixed(1)}\u00b0)`;
}
function to(parent, a, b, words) {
  const link = add(parent, "a", words);
  link.href = "why?" + new URLSearchParams({ a, b });
  link.addEventListener("click", event => {
    if (event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    explain({ a, b });
  });
}
const deviations = distance2 => `${Math.sqrt(distance2).toFixed(1)} standard deviations`;

function showPair(pair) {
  const good = pair.standing === "linked" || pair.standing === "own";
  const box = add(result, "section", "", good ? "box good" : "box");
  add(box, "p", `${pair.a.id} and ${pair.b.id}: ${pair.standing}: ${pair.reason}.`);
  if (pair.probability !== null) add(box, "p", `Right with ${percent(pair.probability)}, by the rest of the map.`);
  if (pair.evidence.aliased)
    add(box, "p", `${pair.evidence.aliased} of the landmarks that agree are found at other places too.`);
  picture(box, pair);
  if (pair.a_from_b) add(box, "p", "Seen from the first, the second is " + pose(pair.a_from_b) + ".");
  if (pair.misfit) add(box, "p", `In the map it is ${pose(pair.misfit.merged_a_from_b)}; off by ` +
    `${metres(pair.misfit.off)}, ${deviations(pair.misfit.strain2)}` +
    (pair.misfit.alone ? "; nothing else connects them." : "."));
  if (pair.other_links.length) showOthers(box, pair.other_links);
  for (const words of [...pair.claims, ...pair.constraints.map(one => one.words)]) add(box, "p", words);
  const edit = { linked: ["unmerge", "Undo this link"], own: null }[pair.standing];
  if (edit !== null) {
    const [kind, words] = edit || ["link", "Link them by hand"];
    button(add(box, "div", "", "actions"), words, () => explanation.edit(kind, [pair.a.id, pair.b.id]));
  }
}
function showOthers(box, links) {
  const agree = links.filter(w => w.agrees).length;
  add(box, "p", `${agree} of ${links.length} other links between the same pieces of map agree:`);
  const list = add(box, "ul");
  // Of many that agree some leave their lines to those that do not.
  const ranked = links.slice().sort((v, w) => v.distance2 - w.distance2), against = ranked.filter(w => !w.agrees);
  const shown = ranked.filter(w => w.agrees).slice(0, SHOWN - Math.min(against.length, SHOWN / 2));
  for (const w of [...shown, ...against.slice(0, SHOWN - shown.length)]) {
    const item = add(list, "li");
    to(item, w.a, w.b, `${w.a} - ${w.b}`);
    item.append(`: ${w.agrees ? "agrees" : "contradicts"}, ${deviations(w.distance2)}, ${w.kept ? "stands" : "refused"}`);
  }
}
function showTwo(one) {
  const box = add(result, "section", "", one.joined ? "box good" : "box");
  add(box, "p", one.reason);
  if (one.over.length) {
    add(box, "p", "By way of:");
    const steps = add(box, "ol"), way = [one.first, ...one.over, one.second];
    way.slice(1).forEach((name, k) => to(add(steps, "li"), way[k], name, `${way[k]} - ${name}`));
  }
  if (!one.joined)
    add(box, "p", `${counted(one.refused, "link")} refused, ${counted(one.unverified, "candidate pair")} without a common pose.`);
  if (one.nearest.length) add(box, "p", one.joined ? "Weakest links:" : "Nearest to a link:");
  const list = add(box, "ul");
  for (const n of one.nearest) {
    const item = add(list, "li");
    to(item, n.a, n.b, `${n.a} - ${n.b}`);
    const lacks = n.lacks.split("; ").filter(words => !one.reason.includes(words));
    item.append(": " + [`${n.matches} match, ${n.inliers} agree`, ...lacks].join("; "));
  }
  for (const { words } of one.constraints) add(box, "p", words);
}
function showHops(box, hops) {
  const list = add(box, "ol");
  for (const hop of hops) {
    const item = add(list, "li");
    to(item, hop.a, hop.b, `${hop.a} - ${hop.b}`);
    item.append(`: ${hop.distance.toFixed(2)} m, ${degrees(hop.turn)}, cost ${hop.cost.toFixed(2)}; ` +
      `${hop.kind}: ${hop.words}`);
  }
}
function showRoute(route) {
  const box = add(result, "section", "", route.found ? "box good" : "box failed");
  const outcome = route.found ? "the route is" : "there is no way";
  add(box, "p", `${route.start} to ${route.goal}: ${outcome}: ${route.reason}.`);
  if (route.hops.length) showHops(box, route.hops);
  if (route.gaps.length) {
    add(box, "p", route.found ? "Not driven, and so not taken:" : "What is missing:");
    showHops(box, route.gaps);
  }
  if (route.apart) showTwo(route.apart);
}

// Called with what is shown, and to edit what is shown.
export const explanation = { shown: () => {}, edit: () => {} };

let asked = 0;

// Ask, show, and put the question into the address.
export async function explain({ a = "", b = "", route = false }, keep = true) {
  byId("a").value = a; byId("b").value = b;
  const query = new URLSearchParams(a || b ? { a, b } : {});
  const address = new URLSearchParams(query);
  if (route) address.set("route", "1");
  if (keep) history.pushState(null, "", "why" + (a || b ? "?" + address : ""));
  document.title = a || b ? `${a} ${route ? "to" : "and"} ${b} - Mapweave` : "Mapweave";
  // The focus does not go with the link that was followed.
  if (result.contains(document.activeElement)) result.focus();
  result.textContent = "Asking ...";
  const number = ++asked;
  const answer = await ask((route ? "route" : "explain") + (a || b ? "?" + query : ""));
  if (number !== asked) return;
  result.textContent = "";
  if (answer.error) add(result, "section", answer.error, "box failed");
  else if (answer.hops) showRoute(answer);
  else if (!answer.maps) showPair(answer);
  else if (answer.maps.length) {
    for (const words of answer.accusations || []) add(result, "section", words, "box failed");
    answer.maps.forEach(showTwo);
  } else add(result, "section", "There are no two maps.", "box");
  explanation.shown(answer);
}
export function explainAddress() {
  const query = new URLSearchParams(location.search);
  const [a, b] = ["a", "b"].map(name => (query.get(name) || "").trim());
  return explain({ a, b, route: Boolean(query.get("route")) }, false);
}
byId("form").addEventListener("submit", event => {
  event.preventDefault();
  explain({ a: byId("a").value.trim(), b: byId("b").value.trim(), route: event.submitter?.name === "route" });
});
byId("all").addEventListener("click", event => { event.preventDefault(); explain({}); });
