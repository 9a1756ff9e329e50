// Robots: the list of all, and one with its missions. POST /robots/...
import { add, ask, button, byId, counted, degrees, fixed, listed, made, percent, retitled, say, seconds, updateFacts } from "./dom.js";
import { goalOf, wordsOf } from "./names.js";
import { onPlans } from "./plans.js";

const QUIET = 5; // s without a status
const KINDS = { sent: "warn", running: "good", done: "good", failed: "bad", refused: "bad", replaced: "warn" }; // of missions
let panel = null;

const known = new Map(); // robot: its last pose, and the anchor of the component in which that is

// Where a robot is drawn; while it does not know where it is, where it was last, in grey.
export function poseOf({ robot: name, alive, merged_from_robot: pose, component, status }, model) {
  const there = Boolean(pose) && component >= 0;
  if (there) known.set(name, { pose, anchor: model.components[component]?.anchor });
  const last = known.get(name), number = there ? component : model.components.findIndex(one => one.anchor === last?.anchor);
  if (!last || number < 0) return null;
  const [x, y, heading] = model.placed(last.pose, number);
  return { name, alive: alive && there, x, y, heading, doing: there ? status?.status.doing || "" : "was here last",
    ellipse: there ? ellipseOf(status?.status.covariance) : null };
}
// Axes of the covariance [xx, xy, yy, heading] of the position, in the robot's frame.
function ellipseOf(covariance) {
  if (!covariance || !(covariance[0] + covariance[2] > 0)) return null;
  const [xx, xy, yy] = covariance, middle = (xx + yy) / 2, reach = Math.hypot((xx - yy) / 2, xy);
  return { major: Math.sqrt(middle + reach), minor: Math.sqrt(Math.max(middle - reach, 0)),
    angle: Math.atan2(2 * xy, xx - yy) / 2 };
}
// A robot that waits or gives way says for what.
const SAID = /^(waiting|stepping aside)/;
const doingOf = ({ doing, detail }) => SAID.test(doing) && detail ? `${doing}: ${detail}` : doing;
const life = robot => robot.before || robot.lost ? ["as last shown", "soft"] : !robot.alive ? ["gone", "bad"] : robot.age > QUIET ? ["silent", "warn"] : ["alive", "good"];
function missionWords(mission, shares = true) {
  if (!mission) return "";
  const { order, state, progress, reason } = mission, { goal: written, node } = order;
  const goal = written && node && written !== node ? `${written} (${node})` : written || node || "";
  const share = shares && state === "running" && progress ? ` ${percent(progress)}` : "", why = reason ? `: ${reason}` : "";
  return `${order.kind}${goal ? " to " + goal : ""}, ${state}${share}${why} (by ${order.by})`;
}
export function listRobots(robots, select, none) {
  listed(byId("robots"), robots.map(robot => {
    const [word, kind] = life(robot), status = robot.status, after = [made("span", ` ${word}`, kind)];
    if (robot.over_quota) after.push(made("span", ", over its quota", "bad"));
    if (robot.accusation) after.push(Object.assign(made("span", " not trusted", "bad"), { title: robot.accusation }));
    const parts = [status && doingOf(status.status), status?.battery != null ? `battery ${percent(status.battery)}` : "",
      robot.component < 0 ? "not on the map" : "", robot.place && `at ${robot.place}`, robot.floor && `floor ${robot.floor}`];
    return { text: robot.robot, act: () => select(robot.robot), after: [...after, " " + parts.filter(Boolean).join(", ")] };
  }));
  if (!robots.length) add(byId("robots"), "li", none, "soft");
}
// The frame of the panel is made once, so that a goal can be typed while statuses come. Stop is above all that changes
// its height, and in view on a phone.
export function showRobot(name, whyNot, goal, model) {
  const box = byId("selected");
  retitled(box, `Robot ${name}`);
  panel = { name, facts: document.createElement("div"), portal: null, words: null, given: "" };
  if (whyNot) { add(box, "p", whyNot, "soft"); box.append(panel.facts); return; }
  const form = add(box, "form", "", "actions"), input = add(form, "input"), via = add(form, "input");
  input.id = "goal"; input.value = goal; input.placeholder = "node, x,y, place or home"; input.setAttribute("list", "names");
  input.setAttribute("aria-label", `Where to send ${name}`);
  via.id = "via"; via.placeholder = "by way of, in order";
  via.setAttribute("aria-label", `Places that ${name} must pass before, in order`);
  const why = add(form, "input");
  why.id = "mission-because"; why.placeholder = "why, for the history";
  why.setAttribute("aria-label", `Why ${name} is sent or stopped, for the history`);
  add(form, "button", "Send");
  const actions = add(box, "div", "", "actions"), words = add(box, "p");
  words.setAttribute("role", "status");
  panel.words = words;
  const mine = panel;
  const give = async path => {
    words.className = ""; words.textContent = "Asking ...";
    const said = why.value.trim() ? "&" + new URLSearchParams([["because", why.value.trim()]]) : "";
    const answer = await ask(`robots/${encodeURIComponent(name)}/${path}${said}`, { method: "POST" });
    words.className = answer.error ? "bad" : KINDS[answer.state] || "good";
    words.textContent = answer.error || answer.said || missionWords(answer, false);
    mine.given = answer.order?.id || "";
  };
  form.addEventListener("submit", event => {
    event.preventDefault();
    const named = [input.value.trim(), ...wordsOf(via.value)].map(word => goalOf(word, model));
    const unknown = named.find(({ lacks }) => lacks), [goal, ...passed] = named.map(({ node }) => node);
    if (unknown) { words.className = "bad"; words.textContent = unknown.lacks; return; }
    give("go?" + new URLSearchParams([["goal", goal], ["by", "page"], ...passed.map(word => ["via", word])]));
  });
  button(actions, "Explore", () => give("explore?by=page"));
  button(actions, "Stop", () => give("stop?by=page"));
  panel.portal = button(actions, "Taken through", () => give("portal-done?by=page"));
  panel.portal.hidden = true;
  box.append(panel.facts);
}
export const leaveRobot = () => { panel = null; };
export function updateRobot(robots) {
  if (!panel) return;
  const robot = robots.find(one => one.robot === panel.name);
  if (!robot) { panel.facts.textContent = "It is not known to the server any more."; return; }
  const portal = robot.status?.status.portal;
  if (panel.portal) panel.portal.hidden = !portal || portal.done;
  // What was said of a mission given here holds until it is over.
  const mission = robot.status?.mission;
  if (panel.given && mission?.order.id === panel.given) {
    panel.words.className = KINDS[mission.state] || "";
    say(panel.words, missionWords(mission, false));
  }
  const status = robot.status, [word, kind] = life(robot), pose = robot.merged_from_robot;
  const [xx = 0, , yy = 0, hh = 0] = (status?.status.covariance || []).map(Math.sqrt);
  const spread = xx + yy > 0 ? ` (sigma ${xx.toFixed(3)}, ${yy.toFixed(3)} m, ${degrees(hh)})` : "";
  updateFacts(panel.facts, [
    ["state", word, kind],
    ["held against it", robot.accusation, "bad"],
    ["last heard", robot.lost ? "before the map server was gone" : robot.before ? "before the server began" : `${seconds(robot.age)} ago`],
    ["doing", status && `${status.status.doing}${status.status.detail ? ": " + status.status.detail : ""}`],
    ["mission", status && missionWords(status.mission)],
    ["on the map", pose ? `${fixed(pose[0])}, ${fixed(pose[1])} m, ${degrees(pose[2])}${spread}` : "not known"],
    ["on the plan", onPlans(pose, robot.component)],
    ["place", robot.place],
    ["floor", robot.floor],
    ["nodes", status && `${status.status.nodes}, ${status.placed} placed by the server`],
    ["last node on the server", robot.newest],
    ["links with other maps", robot.newest && robot.links],
    ["not merged", robot.apart, "warn"],
    ["not yet on the server", status && `${counted(status.unsent, "change")}${robot.lag ? ", one for " + seconds(robot.lag) : ""}`],
    ["images skipped", status && status.skipped],
    ["battery", status?.battery != null ? percent(status.battery) : ""],
    ["sees the server", status && (status.linked ? "yes" : "no")],
    ["quota", robot.over_quota, "bad"],
    ["trouble", robot.alive && status?.last_error
      ? `${status.last_error}${status.error_age >= 1 ? ` (for ${seconds(status.error_age)})` : ""}` : "", "bad"],
  ]);
}
