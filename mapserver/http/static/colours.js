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
const system = matchMedia("(prefers-color-scheme: dark)");
export const isDark = () => system.matches;
export function followTheme(changed) {
  read();
  system.addEventListener("change", () => { read(); changed(); });
}
// A component keeps its colour as long as its anchor stays.
export function hue(anchor) {
  if (!given.has(anchor)) given.set(anchor, given.size);
  return colours.hues[given.get(anchor) % colours.hues.length];
}
export const edgeColour = kind => ["driven", "loop", "merged"].includes(kind) ? colours[kind] : colours.own;
