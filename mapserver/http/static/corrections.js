// What people have corrected and said, newest first, each of which can be taken back: GET /constraints and /annotations.
import { add, ask, button, byId } from "./dom.js";
import { change, onPermission } from "./changes.js";

const list = byId("corrections");
let entries = [], allowed = false;

// What takes the last entry of a name back: what held before holds again.
function undoing(made, number) {
  const { name, body, removed } = made[number], kind = body.kind;
  const before = made.slice(0, number).findLast(one => one.name === name && one.body.kind === kind);
  return before && !before.removed ? { name, body: before.body, because: before.because }
    : removed ? null : { name, body: { kind }, removed: true };
}
export async function listCorrections() {
  const [{ constraints }, { annotations }] = await Promise.all([ask("constraints"), ask("annotations")]);
  // Without an answer the list stays.
  if (!constraints || !annotations) return;
  const last = new Map(annotations.map(({ name, body }, number) => [`${body.kind} ${name}`, number]));
  entries = [
    ...constraints.map(({ number, words, time, stamp_ns, in_force }) =>
      ({ words, time, stamp_ns, holds: in_force, undo: in_force ? ["constraints", { undo: number }] : null })),
    ...annotations.map(({ name, body, words, time, stamp_ns, in_force }, number) => {
      const content = last.get(`${body.kind} ${name}`) === number ? undoing(annotations, number) : null;
      return { words, time, stamp_ns, holds: in_force, undo: content && ["annotations", content] };
    }),
  ].sort((a, b) => b.stamp_ns - a.stamp_ns);
  show();
}
function show() {
  list.textContent = "";
  byId("corrected").hidden = !entries.length;
  for (const { words, time, holds, undo } of entries) {
    const item = add(list, "li", "", holds ? "" : "soft");
    add(item, "small", `${time} UTC `);
    item.append(words + " ");
    if (!undo || !allowed) continue;
    const back = button(item, "Take back", async () => {
      back.disabled = true;
      const { error } = await change(...undo);
      if (!error) return;
      back.disabled = false;
      item.querySelector(".bad")?.remove();
      add(item, "p", error, "bad").setAttribute("role", "alert");
    });
    back.setAttribute("aria-label", `Take back: ${words}`);
  }
}
onPermission(permission => { allowed = permission.allowed; show(); });
document.addEventListener("mapchanged", listCorrections);
