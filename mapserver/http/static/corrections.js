// What people have corrected, each of which can be taken back: GET and POST /constraints.
import { add, ask, button, byId } from "./dom.js";

const list = byId("corrections");

export async function correct(request) {
  const headers = { "Content-Type": "application/json" };
  const body = JSON.stringify({ by: "page", ...request });
  const answer = await ask("constraints", { method: "POST", headers, body });
  await listCorrections("");
  return answer;
}
export async function listCorrections(whyNot) {
  const answer = await ask("constraints");
  const made = answer.constraints || [];
  list.textContent = "";
  byId("corrected").hidden = !made.length;
  if (whyNot) add(list, "li", whyNot, "soft");
  for (const { number, words, time, in_force: inForce } of made.reverse()) {
    const item = add(list, "li", "", inForce ? "" : "soft");
    add(item, "small", `${time} UTC `);
    item.append(words + " ");
    if (!inForce || whyNot) continue;
    const undo = button(item, "Take back", async () => {
      undo.disabled = true;
      const { error } = await correct({ undo: number });
      if (error) add(list.firstElementChild, "p", error, "bad");
    });
  }
}
