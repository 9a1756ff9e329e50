// What people have corrected and said, newest first, with what came after it: GET /constraints and /annotations. What
// holds can be taken back, and of annotations what held before can be restored.
import { add, ask, button, byId, inOrder } from "./dom.js";
import { change, onPermission } from "./changes.js";

const list = byId("corrections"), question = inOrder();
let entries = [], allowed = false;

// What takes the last entry of a name back: what held before holds again.
function undoing(made, number) {
  const { name, body, removed } = made[number], kind = body.kind;
  const before = made.slice(0, number).findLast(one => one.name === name && one.body.kind === kind);
  return before && !before.removed ? { name, body: before.body, because: before.because }
    : removed ? null : { name, body: { kind }, removed: true };
}
// Entries, each with the one that came after it about the same, and the last one about it.
function chained(made, about) {
  const next = new Map(), last = new Map();
  return made.slice().reverse().map(one => {
    const key = about(one), after = next.get(key);
    next.set(key, one);
    if (!after) last.set(key, one);
    return { ...one, after, last: last.get(key) };
  }).reverse();
}
export async function listCorrections() {
  const isLate = question(), [{ constraints }, { annotations }] = await Promise.all([ask("constraints"), ask("annotations")]);
  // Without an answer the list stays.
  if (!constraints || !annotations || isLate()) return;
  entries = [
    ...chained(constraints, one => JSON.stringify(one.about)).map(one =>
      ({ ...one, undo: one.in_force ? ["constraints", { undo: one.number }] : null })),
    ...chained(annotations, one => `${one.body.kind} ${one.name}`).map((one, number) => {
      const { name, body, because, removed, after, last } = one;
      const same = last.in_force && JSON.stringify(last.body) === JSON.stringify(body);
      const content = !after ? undoing(annotations, number) : removed || same ? null : { name, body, because };
      return { ...one, undo: content && ["annotations", content] };
    }),
  ].sort((a, b) => b.stamp_ns - a.stamp_ns);
  show();
}
function show() {
  const focus = [...list.querySelectorAll("button")].indexOf(document.activeElement);
  list.textContent = "";
  byId("corrected").hidden = !entries.length;
  for (const { words, time, in_force: holds, after, undo } of entries) {
    const item = add(list, "li", "", holds ? "" : "soft");
    add(item, "small", `${time} UTC `);
    item.append(words + " ");
    if (after) add(item, "div", `Replaced ${after.time} UTC: ${after.words}`);
    if (!undo || !allowed) continue;
    const does = after ? "Restore" : "Take back", back = button(item, does, async () => {
      back.disabled = true;
      const { error } = await change(...undo);
      if (!error) return;
      back.disabled = false;
      item.querySelector(".bad")?.remove();
      add(item, "p", error, "bad").setAttribute("role", "alert");
    });
    back.setAttribute("aria-label", `${does}: ${words}`);
  }
  const buttons = list.querySelectorAll("button");
  if (focus >= 0) buttons[Math.min(focus, buttons.length - 1)]?.focus();
}
onPermission(permission => { allowed = permission.allowed; show(); });
document.addEventListener("mapchanged", listCorrections);
