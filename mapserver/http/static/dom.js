// Elements, numbers in words, and questions to the server.
export const byId = id => document.getElementById(id);
// The noun is in the singular.
export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
const SVG = "http://www.w3.org/2000/svg";

export function add(parent, name, text, kind) {
  const child = parent.appendChild(document.createElement(name));
  if (text) child.textContent = text;
  if (kind) child.className = kind;
  return child;
}
export function made(name, text, kind) { return add(document.createDocumentFragment(), name, text, kind); }
// Words of a status, which are not read out again while they stay.
export function say(element, words) { if (element.textContent !== words) element.textContent = words; }
// A new title of a panel; the focus goes to it if what had the focus there is gone.
export function retitled(panel, words) {
  const focused = panel.contains(document.activeElement);
  panel.textContent = "";
  const title = add(panel, "h2", words);
  title.tabIndex = -1;
  if (focused) title.focus();
}
export function draw(parent, name, values) {
  const child = parent.appendChild(document.createElementNS(SVG, name));
  for (const key in values) child.setAttribute(key, values[key]);
  return child;
}
export function button(parent, text, act) {
  const made = add(parent, "button", text);
  made.type = "button";
  made.addEventListener("click", act);
  return made;
}
// A list with a button in each item, `{ text, key, act, before, after }`: what stays is the same element, so that a press and
// the focus hold while the rest changes. An item is known by its key, the text unless it is given.
export function listed(list, items) {
  const there = new Map([...list.children].map(one => [one.dataset.key, one]));
  const kept = items.map(({ text, key = text, act, before = [], after = [] }) => {
    const item = there.get(key) || document.createElement("li");
    there.delete(key);
    const choice = item.querySelector("button") || button(item, text, () => {});
    choice.onclick = act;
    for (const part of [...item.childNodes]) if (part !== choice) part.remove();
    choice.before(...before);
    choice.after(...after);
    item.dataset.key = key;
    return item;
  });
  for (const one of [...list.children]) if (!kept.includes(one)) one.remove();
  kept.forEach((one, k) => { if (list.children[k] !== one) list.insertBefore(one, list.children[k] || null); });
}
const known = rows => rows.filter(([, value]) => value !== null && value !== undefined && value !== "");
export function facts(parent, rows) {
  const list = add(parent, "dl");
  for (const [name, value, kind] of known(rows)) {
    add(list, "dt", name);
    add(list, "dd", String(value), kind);
  }
  return list;
}
// The same again: what stays is the same element, so that its text can be marked, copied and read while the rest changes.
export function updateFacts(parent, rows) {
  const list = parent.querySelector("dl"), shown = known(rows), names = [...list?.querySelectorAll("dt") || []];
  if (!list || names.length !== shown.length || names.some((one, k) => one.textContent !== shown[k][0])) {
    parent.textContent = "";
    facts(parent, rows);
    return;
  }
  shown.forEach(([, value, kind = ""], k) => {
    const there = names[k].nextSibling;
    if (there.className !== kind) there.className = kind;
    say(there, String(value));
  });
}
// No -0, nor -0.00.
export const fixed = (value, digits = 2) => (Math.round(value * 10 ** digits) / 10 ** digits + 0).toFixed(digits);
export const degrees = rad => `${Math.round(rad * 180 / Math.PI) + 0}\u00b0`;
export const percent = share => share > 0.9999 ? "over 99.99 %" : `${(100 * share).toFixed(share > 0.99 ? 2 : 0)} %`;
export const metres = ([x, y, turn]) =>
  `${x.toFixed(3)} m ahead, ${y.toFixed(3)} m left, ${(turn * 180 / Math.PI).toFixed(1)}\u00b0`;
export const side = turn => `${Math.abs(turn * 180 / Math.PI).toFixed(0)}\u00b0 to the ${turn > 0 ? "left" : "right"}`;
export const seconds = s => s < 90 ? `${s.toFixed(s < 10 ? 1 : 0)} s` : s < 5400 ? `${(s / 60).toFixed(0)} min`
  : `${(s / 3600).toFixed(1)} h`;
export const when = stamp_ns => new Date(stamp_ns / 1e6).toISOString().slice(0, 19).replace("T", " ") + " UTC";

// Of answers that overtake each other: call it with a question, and what it returns with the answer, which is late if a later
// question has been answered already.
export function inOrder() {
  let asked = 0, answered = 0;
  return () => { const number = ++asked; return () => number <= answered || !(answered = number); };
}
// The answer as JSON, or an object with `error`; a busy server is asked again.
export async function ask(path, options, busy) {
  for (let tries = 0; tries < 5; tries++) {
    let reply, answer;
    try {
      reply = await fetch(path, options);
      answer = await reply.json();
    } catch (error) { return { error: "The map server does not answer: " + error.message, status: 0 }; }
    if (reply.status !== 503 || !answer.retry_after) return reply.ok ? answer : { status: reply.status, ...answer };
    if (busy) busy();
    await new Promise(done => setTimeout(done, 1000 * answer.retry_after));
  }
  return { error: "The map server is too busy; try again in a minute.", status: 503 };
}
