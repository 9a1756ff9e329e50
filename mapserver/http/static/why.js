"use strict";
const byId = id => document.getElementById(id), result = byId("result");
const SVG = "http://www.w3.org/2000/svg", BAD_PX = 10;
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
function add(parent, name, text, kind) {
  const child = parent.appendChild(document.createElement(name));
  if (text) child.textContent = text;
  if (kind) child.className = kind;
  return child;
}
function draw(parent, name, values) {
  const child = parent.appendChild(document.createElementNS(SVG, name));
  for (const key in values) child.setAttribute(key, values[key]);
  return child;
}
function colour(px) {
  const at = 4 * Math.min(px === null ? BAD_PX : px, BAD_PX) / BAD_PX, k = Math.min(Math.floor(at), 3);
  return "rgb(" + COLOURS[k].map((c, i) => Math.round(c + (at - k) * (COLOURS[k + 1][i] - c))) + ")";
}
function picture(parent, pair) {
  const nodes = [pair.a, pair.b], [left, right] = nodes.map(node => node.image);
  const gap = 0.06 * left[0], shift = [0, left[0] + gap];
  const svg = draw(parent, "svg", { role: "img",
    viewBox: [-2, -14, shift[1] + right[0] + 4, Math.max(left[1], right[1]) + 16].join(" ") });
  nodes.forEach(({ id, image: [width, height] }, side) => {
    draw(svg, "rect", { x: shift[side], y: 0, width, height, fill: "#f7f5f0", stroke: "#555" });
    draw(svg, "text", { x: shift[side], y: -4, "font-size": 9 }).textContent = id;
  });
  const agree = new Set(pair.shared.map(String));
  function line([i, j], values) {
    const [x, y] = pair.a.pixels[i], [u, v] = pair.b.pixels[j];
    draw(svg, "line", { x1: x, y1: y, x2: u + shift[1], y2: v, ...values });
  }
  for (const match of pair.matches)
    if (!agree.has(String(match))) line(match, { stroke: "#9a9a9a", "stroke-width": 0.5, class: "alike" });
  pair.shared.forEach((match, k) =>
    line(match, { stroke: colour(pair.residuals_px[k]), "stroke-width": 1.1, class: "agree" }));
  nodes.forEach(({ pixels }, side) => pixels.forEach(([x, y]) =>
    draw(svg, "circle", { cx: x + shift[side], cy: y, r: 1.3, fill: "#333" })));
  const alike = pair.matches.filter(match => !agree.has(String(match))).length;
  add(parent, "small", "Dots are landmarks; images are not kept. " +
    `${pair.shared.length} agree on one pose: dark where it predicts them, yellow where it is ` +
    `${BAD_PX} px off. ${alike} match and do not agree: grey.`);
}
const metres = ([x, y, turn]) =>
  `${x.toFixed(3)} m ahead, ${y.toFixed(3)} m left, ${(turn * 180 / Math.PI).toFixed(1)}\u00b0`;
function pose(gaussian) {
  const sigma = gaussian.sigma;
  return `${metres(gaussian.mean)} (sigma ${sigma[0].toFixed(3)} m, ${sigma[1].toFixed(3)} m, ` +
    `${(sigma[2] * 180 / Math.PI).toFixed(1)}\u00b0)`;
}
function to(parent, a, b, words) {
  const link = add(parent, "a", words);
  link.href = "why?" + new URLSearchParams({ a, b });
}
function showPair(pair) {
  const box = add(result, "section", "", pair.standing === "linked" || pair.standing === "own" ? "good" : "");
  add(box, "p", `${pair.a.id} and ${pair.b.id}: ${pair.standing}: ${pair.reason}.`);
  if (pair.evidence.aliased)
    add(box, "p", `${pair.evidence.aliased} of the landmarks that agree are found at other places too.`);
  if (pair.a_from_b) add(box, "p", "Seen from the first, the second is " + pose(pair.a_from_b) + ".");
  if (pair.misfit) add(box, "p", `In the map it is ${pose(pair.misfit.merged_a_from_b)}; off by ` +
    `${metres(pair.misfit.off)}, ${Math.sqrt(pair.misfit.strain2).toFixed(1)} standard deviations` +
    (pair.misfit.alone ? "; nothing else connects them." : "."));
  if (pair.probability !== null) {
    const percent = pair.probability > 0.9999 ? "over 99.99" : (100 * pair.probability).toFixed(2);
    add(box, "p", `Right with ${percent} %, by the rest of the map.`);
  }
  if (pair.other_links.length) {
    const agree = pair.other_links.filter(w => w.agrees).length;
    add(box, "p", `${agree} of ${pair.other_links.length} other links between the same pieces of map agree:`);
    const list = add(box, "ul");
    // Of many that agree some leave their lines to those that do not.
    const ranked = pair.other_links.slice().sort((v, w) => v.distance2 - w.distance2);
    const against = ranked.filter(w => !w.agrees);
    const shown = ranked.filter(w => w.agrees).slice(0, 12 - Math.min(against.length, 6));
    for (const w of [...shown, ...against.slice(0, 12 - shown.length)]) {
      const item = add(list, "li");
      to(item, w.a, w.b, `${w.a} - ${w.b}`);
      item.append(`: ${w.agrees ? "agrees" : "contradicts"}, ${Math.sqrt(w.distance2).toFixed(1)} standard ` +
        `deviations, ${w.kept ? "stands" : "refused"}`);
    }
  }
  for (const words of [...pair.claims, ...pair.constraints.map(constraintWords)]) add(box, "p", words);
  picture(box, pair);
}
function constraintWords(r) {
  const when = new Date(r.stamp_ns / 1e6).toISOString().slice(0, 16).replace("T", " ");
  const what = r.ends[0] === r.ends[1] ? (r.apart ? "is retired" : "is in use again")
    : r.apart ? "shall not be linked" : "may be linked again";
  return `${when} UTC ${r.who || "a person"} decided: ${[...new Set(r.ends)].join(" and ")} ${what}` +
    (r.because ? `: \u201c${r.because}\u201d` : "");
}
function showMaps(maps) {
  if (!maps.length) add(result, "section", "There are no two maps.");
  maps.forEach(showTwo);
}
function showTwo(one) {
  const box = add(result, "section", "", one.joined ? "good" : "");
  add(box, "p", one.reason);
  if (!one.joined)
    add(box, "p", `${one.refused} links refused, ${one.unverified} candidate pairs without a common pose.`);
  if (one.nearest.length) add(box, "p", one.joined ? "Weakest links:" : "Nearest to a link:");
  const list = add(box, "ul");
  for (const n of one.nearest) {
    const item = add(list, "li");
    to(item, n.a, n.b, `${n.a} - ${n.b}`);
    const lacks = n.lacks.split("; ").filter(words => !one.reason.includes(words));
    item.append(": " + [`${n.matches} match, ${n.inliers} agree`, ...lacks].join("; "));
  }
  for (const words of one.constraints.map(constraintWords)) add(box, "p", words);
}
function showHops(box, hops) {
  const list = add(box, "ol");
  for (const hop of hops) {
    const item = add(list, "li");
    to(item, hop.a, hop.b, `${hop.a} - ${hop.b}`);
    item.append(`: ${hop.distance.toFixed(2)} m, ${(hop.turn * 180 / Math.PI).toFixed(0)}°, ` +
      `cost ${hop.cost.toFixed(2)}; ${hop.kind}: ${hop.words}`);
  }
}
function showRoute(route) {
  const box = add(result, "section", "", route.found ? "good" : "failed");
  add(box, "p", `${route.start} to ${route.goal}: ` +
    `${route.found ? "the route is" : "there is no way"}: ${route.reason}.`);
  if (route.hops.length) showHops(box, route.hops);
  if (route.gaps.length) {
    add(box, "p", route.found ? "Not driven, and so not taken:" : "What is missing:");
    showHops(box, route.gaps);
  }
  if (route.apart) showTwo(route.apart);
}
async function past() {
  let answer;
  try { answer = await (await fetch("history")).json(); } catch (error) { return; }
  const newest = (answer.history || []).slice(-30).reverse();
  byId("past").hidden = !newest.length;
  for (const one of newest)
    add(byId("past").lastElementChild, "li", `${one.time} UTC: ${one.kind}: ${one.words}`);
}
async function explain() {
  const asked = new URLSearchParams(location.search);
  const [a, b] = ["a", "b"].map(name => byId(name).value = (asked.get(name) || "").trim());
  const path = asked.get("route") ? "route" : "explain";
  const query = a || b ? "?" + new URLSearchParams({ a, b }) : "";
  if (query) document.title = `${a} ${path === "route" ? "to" : "and"} ${b} - Mapweave`;
  result.textContent = "Asking ...";
  for (let tries = 0; tries < 5; tries++) {
    let reply, answer;
    try {
      reply = await fetch(path + query);
      answer = await reply.json();
    } catch (error) { answer = { error: "The map server does not answer: " + error.message }; }
    if (reply && reply.status === 503) {
      await new Promise(done => setTimeout(done, 1000 * (answer.retry_after || 1)));
      continue;
    }
    result.textContent = "";
    if (answer.error) add(result, "section", answer.error, "failed");
    else if (answer.maps) showMaps(answer.maps);
    else if (answer.hops) showRoute(answer);
    else showPair(answer);
    return;
  }
  result.textContent = "";
  add(result, "section", "The map server is too busy; try again in a minute.", "failed");
}
explain();
past();
