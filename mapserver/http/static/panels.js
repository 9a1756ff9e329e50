// The tabs beside the map.
import { byId } from "./dom.js";

const tabs = [...document.querySelectorAll("[role=tab]")];

export const isOpen = name => !byId(name).hidden;
export function openTab(name, focus = false) {
  const left = document.activeElement?.closest("[role=tabpanel]");
  for (const tab of tabs) {
    const open = tab.getAttribute("aria-controls") === name;
    tab.setAttribute("aria-selected", open);
    tab.tabIndex = open ? 0 : -1;
    byId(tab.getAttribute("aria-controls")).hidden = !open;
    if (open && focus) tab.focus();
  }
  // The focus does not stay on what is hidden: the next key would begin at the top of the page.
  if (left?.hidden) byId(name).focus();
  document.dispatchEvent(new CustomEvent("tabopened"));
}
export function listenToTabs(opened) {
  tabs.forEach((tab, k) => {
    const name = tab.getAttribute("aria-controls");
    tab.addEventListener("click", () => { openTab(name); opened(name); });
    tab.addEventListener("keydown", event => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = tabs[(k + step + tabs.length) % tabs.length].getAttribute("aria-controls");
      openTab(next, true);
      opened(next);
    });
  });
}
