// The page: what comes over the WebSocket goes to the map and the panels, what is chosen on one shows on all.
import { add, button, byId, counted, draw, listed, made, say } from "./dom.js";
import { colours, edgeColour, followTheme, hue } from "./colours.js";
import { areaCorners, drawAnnotations, loadAnnotations } from "./annotations.js";
import { permit } from "./changes.js";
import { listCorrections } from "./corrections.js";
import { Drawing } from "./drawing.js";
import { EditPanel } from "./edit_panel.js";
import { explain, explainAddress, explanation } from "./explanation.js";
import { drawGoals, goalsOf } from "./goals.js";
import { admitted } from "./login.js";
import { forget, showNode } from "./node_panel.js";
import { leaveRobot, listRobots, poseOf, showRobot, updateRobot } from "./robot_panel.js";
import { listen } from "./input.js";
import { listenForPhotos } from "./photo.js";
import { isOpen, listenToTabs, openTab } from "./panels.js";
import { MapModel } from "./map_model.js";
import { nodeNamed } from "./names.js";
import { crosshair } from "./plan_pane.js";
import { drawPlans, loadPlans } from "./plans.js";
import { Painter } from "./painter.js";
import { PlanEditor } from "./plan_editor.js";
import { Selection } from "./selection.js";
import { addEvents, clearEvents } from "./timeline.js";
import { Viewport } from "./viewport.js";
import { watch } from "./live.js";

const PICK = 14;              // px about what is pressed
const EDGE = 30;              // px from the edge of the map, at which the selected robot is moved to its middle
const NEAR = 0.25;            // of the extent of the map, within which robots and areas beside it are shown too
const MOST_NAMES = 500;       // in the list that helps searching
const SAID_EVERY = 10000;       // ms, between two looks at annotations and plans

const model = new MapModel(), viewport = new Viewport(), painter = new Painter(byId("canvas"), model, viewport);
const moved = () => painter.ask();
const selection = new Selection(model), drawing = new Drawing(viewport, corners => selection.enclose(corners));
const planEditor = new PlanEditor(model, viewport, moved);
const panel = new EditPanel(model, selection, drawing, { moved, planning: openPlan });
const page = { robots: [], goals: [], commands: false, whyNot: "", node: "", robot: "", photo: [], places: [],
  readOnly: false, loading: true, areas: "" };
// For tests and measurements.
window.mapweave = { model, viewport, painter, page, selection, drawing, planEditor };

// A screen reader reads what is selected, where the focus does not move to it.
function announce(what) {
  if (!byId("selected").contains(document.activeElement)) say(byId("announcement"), what);
}
function selectNode(name, move = true) {
  const row = model.rowOf(name);
  page.node = name; page.robot = painter.robot = ""; painter.ways = [];
  leaveRobot();
  painter.selected = row ?? -1;
  if (row !== undefined && move) viewport.show(model.x[row], model.y[row]);
  openTab("selected");
  announce(`Node ${name}`);
  showNode(name, { select: selectNode, why: (a, b) => showWhy({ a, b }), send: offerToSend, edit: addToEdited });
  painter.ask();
}
function offerToSend(parent, name) {
  if (!page.commands) return;
  for (const { robot, alive } of page.robots)
    if (alive) button(parent, `Send ${robot} here`, () => {
      selectRobot(robot, name);
      byId("goal").form.requestSubmit();
    });
}
function openPlan() { planEditor.show(isOpen("edit") && byId("edit-kind").value === "plan"); }
function edit(kind, names) {
  openTab("edit");
  panel.show(kind);
  selection.set(names);
}
function addToEdited(name) {
  openTab("edit");
  if (panel.kind === "plan") panel.show("link");
  selection.toggle(name);
}
function selectRobot(name, goal = page.node, move = true) {
  page.robot = painter.robot = name;
  forget();
  openTab("selected");
  announce(`Robot ${name}`);
  showRobot(name, page.whyNot, goal, model);
  updateRobot(page.robots);
  const robot = painter.robots.find(one => one.name === name);
  if (robot && move) viewport.show(robot.x, robot.y);
  painter.ask();
}
// The selected robot is followed while it is in view: a person who has looked elsewhere goes on to see that.
function follow(before, now) {
  const [was, is] = [before, now].map(robots => robots.find(one => one.name === page.robot));
  if (was && is && viewport.holds(was.x, was.y, 0) && !viewport.holds(is.x, is.y, EDGE)) viewport.show(is.x, is.y, 0);
}
function showWhy(question) {
  openTab("why");
  return explain(question);
}
// On the map: the two nodes that are explained, or the steps of a route; dashed what joins none. All of it is in view.
function markWays({ a, b, standing, hops = [], gaps = [] }) {
  painter.ways = a?.id ? [{ a: a.id, b: b.id, dashed: !["linked", "own"].includes(standing) }]
    : [...hops, ...gaps.map(gap => ({ ...gap, dashed: true }))];
  const rows = painter.ways.flatMap(way => [way.a, way.b]).map(name => model.rowOf(name)).filter(row => row !== undefined);
  if (!rows.every(row => viewport.holds(model.x[row], model.y[row], 0))) {
    const xs = rows.map(row => model.x[row]), ys = rows.map(row => model.y[row]);
    viewport.fit([Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)]);
    viewport.touched = true;
  }
  painter.ask();
}
function chosen(u, v, shift) {
  const [x, y] = viewport.toPlane(u, v), reach = PICK / viewport.scale;
  if (isOpen("edit") && drawing.shape) { drawing.corner(u, v); return; }
  if (isOpen("edit") && planEditor.open) { planEditor.clickedMap(x, y); return; }
  if (isOpen("edit") || shift) {
    const row = model.nearest(x, y, reach), edge = row < 0 ? model.nearestEdge(x, y, reach / 2) : -1;
    if (row >= 0) addToEdited(model.name(row));
    if (edge >= 0) edit(panel.kind, [model.edges.a[edge], model.edges.b[edge]].map(one => model.name(one)));
    return;
  }
  const robot = painter.robots.find(one => Math.hypot(one.x - x, one.y - y) < reach);
  if (robot) { selectRobot(robot.name, page.node, false); return; }
  const row = model.nearest(x, y, reach);
  if (row >= 0) { selectNode(model.name(row), false); return; }
  const link = model.nearestLink(x, y, reach / 2);
  if (link >= 0) showWhy({ a: model.name(model.edges.a[link]), b: model.name(model.edges.b[link]) });
}
function next(step) {
  if (!model.order.length) return;
  const at = model.order.indexOf(painter.selected);
  selectNode(model.name(model.order[(at + step + model.order.length) % model.order.length]));
  byId("canvas").focus();
}
function find(text) {
  const robot = page.robots.find(one => one.robot === text), { node, lacks } = nodeNamed(text, model);
  if (node) { selectNode(node); return; }
  if (robot) { selectRobot(robot.robot); return; }
  const map = model.numbers?.get(text);
  if (map !== undefined) {
    viewport.fit(model.bounds(model.order.filter(row => model.nodes.map[row] === map)));
    painter.ask();
    return;
  }
  if (/^[^.]+\.\d+\.\d+$/.test(text)) { selectNode(text); return; }
  byId("announcement").textContent = byId("query").title = lacks;
  byId("query").setCustomValidity(byId("query").title);
  byId("query").reportValidity();
}
// Of all nodes, and of the robots and the corners of areas that are not far from them.
function extent() {
  const box = model.bounds(), reach = box && NEAR * Math.max(box[2] - box[0], box[3] - box[1], 4);
  const grown = box?.slice();
  for (const [x, y] of [...painter.robots.map(robot => [robot.x, robot.y]), ...areaCorners(model)]) {
    if (!box || x < box[0] - reach || y < box[1] - reach || x > box[2] + reach || y > box[3] + reach) continue;
    grown[0] = Math.min(grown[0], x); grown[1] = Math.min(grown[1], y);
    grown[2] = Math.max(grown[2], x); grown[3] = Math.max(grown[3], y);
  }
  return grown;
}
function fit() { viewport.fit(extent()); viewport.touched = false; painter.ask(); }

function listComponents() {
  listed(byId("components"), model.components.map(({ anchor, nodes, maps, floor }, k) => {
    const swatch = made("span", "", "swatch");
    swatch.style.background = hue(anchor);
    const some = maps.length > 6 ? `${maps.slice(0, 6).join(", ")} and ${maps.length - 6} more` : maps.join(", ");
    return { text: `component ${k}`, before: [swatch],
      act: () => { viewport.fit(model.bounds(model.members[k])); painter.ask(); },
      after: [` ${floor ? `floor ${floor}, ` : ""}${counted(nodes, "node")} of ${some}`] };
  }));
}
function listNames() {
  const robots = page.robots.map(one => one.robot);
  const names = [...page.places, ...robots, ...model.maps];
  byId("names").replaceChildren(...names.slice(0, MOST_NAMES).map(name => new Option(name)));
}
function drawLegend() {
  const list = byId("legend");
  list.textContent = "";
  const kinds = [["mapped", "driven while mapping"], ["driven", "driven again"], ["loop", "recognised, one map"],
    ["merged", "link between maps"], ["doubtful", "link below 90 %"]];
  for (const [kind, words] of kinds) {
    const item = add(list, "li"), svg = draw(item, "svg", { viewBox: "0 0 30 10", "aria-hidden": true });
    const doubtful = kind === "doubtful", stroke = edgeColour(doubtful ? "merged" : kind);
    draw(svg, "line", { x1: 0, y1: 5, x2: 30, y2: 5, "stroke-width": 2.5, stroke,
      "stroke-dasharray": doubtful ? "5 4" : "none" });
    item.append(words);
  }
  const shapes = [["M2 5a4 4 0 1 0 8 0a4 4 0 1 0-8 0M6 5H20", colours.hues[0], "node, its heading"],
    ["M2 5a4 4 0 1 0 8 0a4 4 0 1 0-8 0M6 5H20", colours.hues[0], "superseded node", 0.35],
    ["M4 0L24 5L4 10L9 5Z", colours.robot, "robot, ellipse of 2 sigma"],
    ["M1 8.5H13V0H14.5L22 3L14.5 6V10.5H1Z", colours.robot, "goal of a robot, its way"]];
  for (const [d, colour, words, opacity = 1] of shapes) {
    const item = add(list, "li"), svg = draw(item, "svg", { viewBox: "0 0 30 10", "aria-hidden": true });
    draw(svg, "path", { d, fill: colour, stroke: colour, opacity });
    item.append(words);
  }
}
painter.underlays.push(drawPlans);
// Where the photo may have been taken.
painter.overlays.push((c, v, _, labels) => drawGoals(c, v, page.goals, labels), drawAnnotations,
(c, v) => {
  if (isOpen("edit")) selection.draw(c, v);
  drawing.draw(c, v);
  planEditor.drawMarks(c, v);
  if (isOpen("edit") && (drawing.shape || planEditor.open) && byId("canvas").matches(":focus-visible")) crosshair(c, v);
}, (c, v, _, labels) => {
  for (const { merged_from_robot, component, probability } of page.photo) {
    if (!merged_from_robot || component < 0) continue;
    const [x, y, heading] = model.placed(merged_from_robot.mean, component), [u, w] = v.toScreen(x, y);
    c.save();
    c.translate(u, w); c.rotate(-heading);
    c.fillStyle = c.strokeStyle = colours.accent; c.lineWidth = 2;
    c.globalAlpha = 0.25; c.beginPath(); c.moveTo(0, 0); c.arc(0, 0, 46, -0.5, 0.5); c.fill();
    c.globalAlpha = 1; c.beginPath(); c.arc(0, 0, 6, 0, 7); c.fill();
    c.restore();
    labels.beside(u, w, [`photo, ${(100 * probability).toFixed(0)} %`], "name", colours.accent);
  }
});

watch({
  hello({ name, commands, read_only, why_not }) {
    page.commands = commands;
    page.whyNot = why_not;
    if (name) panel.sign(name);
    page.readOnly = read_only;
    page.loading = true;
    page.heard = false;
    permit(commands, why_not);
    say(byId("connection"), read_only ? "map file" : "live");
    clearEvents();
  },
  map(message, bytes) {
    const selected = painter.selected >= 0 ? page.node : "";
    page.bytes = bytes;
    model.apply(message);
    page.goals = goalsOf(page.robots, painter.robots, model);
    byId("empty").hidden = model.order.length > 0;
    if (!viewport.touched) viewport.fit(extent());
    if (selected) painter.selected = model.rowOf(selected) ?? -1;
    panel.counts();
    listComponents();
    listNames();
    painter.changed();
    loadSaid();
  },
  state({ server, robots }) {
    showRobots(robots);
    byId("summary").textContent = server.summary + (server.settled === false ? ", still merging" : "");
    if (!server.loading) {
      byId("unattended").textContent = server.unattended || "";
      byId("unattended").hidden = !server.unattended;
    }
    if (page.loading && !server.loading) listCorrections();
    page.loading = Boolean(server.loading);
    // Lists are shown once they are filled, so that nothing jumps.
    if (!server.loading || robots.length || model.components.length) byId("fleet").classList.remove("waiting");
    if (!page.readOnly) say(byId("connection"), server.loading ? server.summary : "live");
    painter.ask();
  },
  events({ history }) {
    addEvents(history, name => model.rowOf(name) === undefined ? find(name) : selectNode(name), name => model.numbers?.has(name));
    if (page.heard) byId("announcement").textContent = history.slice(-3).map(({ words }) => words).join("; ");
    page.heard = true;
    if (history.some(({ kind }) => kind === "annotated")) loadSaid();
    if (!page.loading) listCorrections();
  },
}, (up, why) => {
  if (!up) permit(false, `The map server ${why ? `shows nothing: ${why}` : "does not answer"}. Nothing can be changed until it does. `
    + "What you have typed stays.");
  byId("connection").className = up ? "" : "lost";
  say(byId("connection"), up ? "live" : `${why || "no server"}, trying again`);
  // Nothing is known of them any more.
  if (!up && !page.readOnly) showRobots(page.robots.map(robot => ({ ...robot, alive: false, lost: true })));
}, admitted);
function showRobots(robots) {
  page.robots = robots;
  const before = painter.robots;
  painter.robots = robots.map(robot => poseOf(robot, model)).filter(Boolean);
  page.goals = goalsOf(robots, painter.robots, model);
  follow(before, painter.robots);
  if (!viewport.touched && painter.robots.some(({ x, y }) => !viewport.holds(x, y, EDGE))) viewport.fit(extent());
  listRobots(robots, name => selectRobot(name), page.readOnly ? "A map file has none." : "None has been heard of.");
  updateRobot(robots);
  painter.ask();
}
async function loadSaid() {
  loadPlans(() => { planEditor.list(); painter.ask(); });
  const places = await loadAnnotations(selectNode);
  if (!places) return;
  page.places = places;
  listNames();
  // Robots alone let the view stay as it is.
  const areas = String(areaCorners(model));
  if (!viewport.touched && areas !== page.areas) viewport.fit(extent());
  page.areas = areas;
  painter.ask();
}
setInterval(loadSaid, SAID_EVERY);

document.addEventListener("mapchanged", loadSaid);
document.addEventListener("tabopened", () => { openPlan(); moved(); });
byId("opacity").addEventListener("input", moved);

explanation.edit = edit;
explanation.shown = markWays;
followTheme(() => { drawLegend(); listComponents(); painter.changed(); planEditor.draw(); });
drawLegend();
listenToTabs(name => { if (name === "why" && !byId("result").textContent) explain({}, false); });
listen(byId("canvas"), viewport, { moved, chosen, fit, next,
  drag: (from, to, ended) => isOpen("edit") && drawing.drag(from, to, ended),
  keys: { Escape: () => drawing.cancel(), Backspace: () => drawing.back(),
    " ": () => { if (painter.selected >= 0) addToEdited(model.name(painter.selected)); byId("canvas").focus(); } } });
listenForPhotos(() => openTab("photo"), candidates => {
  page.photo = candidates;
  const best = candidates[0];
  if (best?.merged_from_robot && best.component >= 0)
    viewport.show(...model.placed(best.merged_from_robot.mean, best.component).slice(0, 2));
  painter.ask();
}, name => selectNode(name));
byId("search").addEventListener("submit", event => { event.preventDefault(); find(byId("query").value.trim()); });
byId("query").addEventListener("input", () => byId("query").setCustomValidity(""));
byId("fit").addEventListener("click", fit);
for (const [id, factor] of [["closer", 1.4], ["farther", 1 / 1.4]])
  byId(id).addEventListener("click", () => { viewport.zoom(factor); painter.ask(); });
addEventListener("popstate", () => { if (location.pathname.endsWith("/why")) { openTab("why"); explainAddress(); } });
new ResizeObserver(() => { painter.resize(); if (!viewport.touched) fit(); }).observe(byId("map"));
if (location.pathname.endsWith("/why")) { openTab("why"); admitted().then(explainAddress); }
