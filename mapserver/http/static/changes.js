// The one place where changes of the map leave the page: POST /constraints, /annotations and /plans. For those who may
// not change the map it holds the reason, and everything that changes it is disabled.
import { ask } from "./dom.js";

const NAME = "mapweave.name";
const watchers = [];

export const permission = { allowed: false, why: "The map server has not answered yet.", name: "" };
try { permission.name = localStorage.getItem(NAME) || ""; } catch { /* storage may be switched off */ }

export function permit(allowed, why = "") {
  Object.assign(permission, { allowed, why });
  for (const watcher of watchers) watcher(permission);
}
export function onPermission(watcher) { watchers.push(watcher); watcher(permission); }
export function callMe(name) {
  permission.name = name;
  try { localStorage.setItem(NAME, name); } catch { /* likewise */ }
}

// The server's answer, or an object with `error`. `content` is an object, or a file or form for /plans. With
// `check: true` the server only says what the change would do.
export async function change(path, content) {
  if (!permission.allowed) return { error: permission.why, status: 403 };
  if (content instanceof FormData) return ask(path, { method: "POST", body: content });
  // A file is what it contains, whatever its ending.
  if (content instanceof Blob)
    return ask(path, { method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: content });
  const by = permission.name || "page";
  const body = JSON.stringify({ [path === "annotations" ? "who" : "by"]: by, ...content });
  const answer = await ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body });
  if (!answer.error && !content.check) document.dispatchEvent(new CustomEvent("mapchanged"));
  return answer;
}
