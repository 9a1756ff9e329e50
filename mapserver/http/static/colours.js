// Colours of the page's theme, also for the canvas; they follow the system's light and dark.
const NAMES = ["ground", "panel", "ink", "soft", "line", "accent", "good", "warn", "bad", "own", "driven", "loop", "merged",
  "robot", "select"];
export const colours = {};
const given = new Map();

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colours[name] = style.getPropertyValue("--" + name).trim();
  colours.hues = style.getPropertyValue("--hues").trim().split(/\s+/);
}
// Nothing but its changes: Chromium sends none where `matches` of the same list is read before it has sent it.
const system = matchMedia("(prefers-color-scheme: dark)");
let dark = false;
export const isDark = () => dark;
export function followTheme(changed) {
  const follow = is => { dark = is; read(); };
  follow(system.matches);
  system.addEventListener("change", ({ matches }) => { follow(matches); changed(); });
}
// A component keeps its colour as long as its anchor stays.
export function hue(anchor) {
  if (!given.has(anchor)) given.set(anchor, given.size);
  return colours.hues[given.get(anchor) % colours.hues.length];
}
export const edgeColour = kind => ["driven", "loop", "merged"].includes(kind) ? colours[kind] : colours.own;
