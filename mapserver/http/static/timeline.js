// What has happened to the maps, newest first.
import { add, byId } from "./dom.js";

const MOST = 300;
const KINDS = { joined: "good", parted: "warn", "kept apart": "warn", "set apart": "warn", implausible: "warn", failed: "bad" };
const NAMES = /\b[a-z0-9][a-z0-9_-]*\.\d+(?:\.\d+)?\b/g;
const NUMBER = /^\d+\./;

// Names of nodes and maps in the words become buttons. The name of a robot may be a number: then its map must be there, as
// `1.9,-0.25` is a position.
export function addEvents(events, select, isMap) {
  const list = byId("history");
  for (const { time, kind, words } of events) {
    const item = document.createElement("li");
    list.prepend(item);
    add(item, "small", `${time} UTC `);
    add(item, "span", `${kind}: `, KINDS[kind]);
    let last = 0;
    for (const match of words.matchAll(NAMES)) {
      if (NUMBER.test(match[0]) && !isMap(match[0].split(".", 2).join("."))) continue;
      item.append(words.slice(last, match.index));
      const choice = add(item, "button", match[0]);
      choice.type = "button";
      choice.addEventListener("click", () => select(match[0]));
      last = match.index + match[0].length;
    }
    item.append(words.slice(last));
  }
  while (list.children.length > MOST) list.lastElementChild.remove();
}
export const clearEvents = () => { byId("history").textContent = ""; };
