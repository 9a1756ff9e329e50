// Mouse, touch and keyboard on a canvas: pan, zoom, choose. `drag` may take a drag with one finger for itself; `keys`
// are more keys.
const STILL = 5;    // px within which a press is a choice
const STEP = 60;    // px by an arrow key
const KEY_ZOOM = 1.3;

export function listen(canvas, viewport, { moved, chosen, fit, next = () => {}, drag = () => false, keys: more = {} }) {
  const pointers = new Map();
  let travelled = 0, began = [0, 0];
  const at = event => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const spread = () => {
    const [[u, v], [r, s]] = [...pointers.values()];
    return { middle: [(u + r) / 2, (v + s) / 2], distance: Math.hypot(u - r, v - s) };
  };
  canvas.addEventListener("pointerdown", event => {
    // The end of a press that opens a menu is not heard of; other buttons do nothing here.
    if (event.button) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, began = at(event));
    travelled = pointers.size > 1 ? Infinity : 0;
  });
  canvas.addEventListener("pointermove", event => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    if (event.pointerType === "mouse" && !(event.buttons & 1)) { pointers.delete(event.pointerId); return; }
    const now = at(event), pinch = pointers.size === 2 ? spread() : null;
    pointers.set(event.pointerId, now);
    travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (pinch) {
      const { middle, distance } = spread();
      viewport.pan(middle[0] - pinch.middle[0], middle[1] - pinch.middle[1]);
      if (pinch.distance > 0) viewport.zoom(distance / pinch.distance, ...middle);
    } else if (travelled > STILL && !(travelled < Infinity && drag(began, now, false)))
      viewport.pan(now[0] - before[0], now[1] - before[1]);
    moved();
  });
  const up = event => {
    if (!pointers.delete(event.pointerId) || event.type !== "pointerup") return;
    if (travelled <= STILL) chosen(...at(event), event.shiftKey);
    else if (travelled < Infinity) drag(began, at(event), true);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    viewport.zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)), ...at(event));
    moved();
  }, { passive: false });
  canvas.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const keys = {
      ArrowLeft: () => viewport.pan(STEP, 0), ArrowRight: () => viewport.pan(-STEP, 0),
      ArrowUp: () => viewport.pan(0, STEP), ArrowDown: () => viewport.pan(0, -STEP),
      "+": () => viewport.zoom(KEY_ZOOM), "=": () => viewport.zoom(KEY_ZOOM), "-": () => viewport.zoom(1 / KEY_ZOOM),
      0: fit, Enter: () => chosen(viewport.width / 2, viewport.height / 2, event.shiftKey), n: () => next(1),
      p: () => next(-1), ...more,
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
    moved();
  });
}
