// Floor plans under the map: GET /plans and their images. A map file of before has none.
import { isDark } from "./colours.js";
import { ask, byId, degrees, fixed, inOrder } from "./dom.js";

const LARGEST = 16e6; // px; browsers may refuse larger canvases
const AGAIN = 3000;   // ms, after which an image that has not come is asked for again
const images = new Map(), inverted = new Map(); // by digest
const question = inOrder();
let plans = [], offered = true;
// The plan that is being edited takes the place of the one of its name: `{ name, image, parts }`.
export const draft = { plan: null };

export const planNamed = name => plans.find(one => one.name === name);
export const planNames = () => plans.map(one => one.name);

// Where a pose of the merged map is on each plan that lies there, in words: `office 9.00, 7.00 m, 90 deg`.
export function onPlans(pose, component) {
  const words = [];
  for (const { name, parts } of plans) {
    const part = parts.find(one => one.component === component);
    if (!part || !pose) continue;
    const [x, y, turn] = part.plan_from_merged, c = Math.cos(turn), s = Math.sin(turn);
    const heading = Math.atan2(Math.sin(turn + pose[2]), Math.cos(turn + pose[2]));
    words.push(`${name} ${fixed(x + c * pose[0] - s * pose[1])}, ${fixed(y + s * pose[0] + c * pose[1])} m, ${degrees(heading)}`);
  }
  return words.join("; ");
}
// Where a position on a plan is in the frames of the components under which the plan lies: [[component, x, y], ...].
export function fromPlan(name, x, y) {
  return planNamed(name).parts.map(({ component, plan_from_merged: [px, py, turn] }) => {
    const c = Math.cos(turn), s = Math.sin(turn), dx = x - px, dy = y - py;
    return [component, c * dx + s * dy, c * dy - s * dx];
  });
}
export async function loadPlans(loaded) {
  if (!offered) return;
  const isLate = question(), answer = await ask("plans");
  if (isLate()) return;
  offered = answer.status !== 404;
  if (answer.error) return;
  plans = answer.plans || [];
  for (const { plan } of plans) imageOf(plan.image.sha256, loaded);
  loaded();
}
export function imageOf(sha256, loaded = () => {}) {
  if (!images.has(sha256)) {
    const image = new Image();
    images.set(sha256, image);
    // The connection may have been lost for a moment.
    image.addEventListener("error", () => setTimeout(() => { images.delete(sha256); imageOf(sha256, loaded); }, AGAIN));
    image.src = `plan-images/${sha256}.png`;
  }
  const image = images.get(sha256);
  if (!image.complete) image.addEventListener("load", loaded);
  return image;
}
// In the dark theme black on white becomes white on black: on white its colours could not be read.
export function inTheme(sha256, image) {
  if (!isDark()) return image;
  const { naturalWidth: width, naturalHeight: height } = image;
  if (width * height > LARGEST) return image;
  if (!inverted.has(sha256)) {
    const made = Object.assign(document.createElement("canvas"), { width, height }), c = made.getContext("2d");
    c.drawImage(image, 0, 0);
    c.globalCompositeOperation = "difference"; c.fillStyle = "#fff"; c.fillRect(0, 0, width, height);
    // What is transparent stays so.
    c.globalCompositeOperation = "destination-in"; c.drawImage(image, 0, 0);
    inverted.set(sha256, made);
  }
  return inverted.get(sha256);
}
const shown = () => [...plans.filter(one => one.name !== draft.plan?.name), ...draft.plan ? [draft.plan] : []];

export function drawPlans(c, viewport, model) {
  let drawn = false;
  c.globalAlpha = byId("opacity").value / 100;
  for (const { plan, parts } of shown()) {
    const image = images.get(plan.image?.sha256);
    if (!image?.complete || !image.naturalWidth) continue;
    for (const { component, merged_from_image: [a, b, e, d, x, y] } of parts) {
      const [dx, dy] = model.offset(component), [u, v] = viewport.toScreen(x + dx, y + dy), s = viewport.scale;
      c.save();
      // The page's v points down, the plane's y up.
      c.transform(s * a, -s * b, s * e, -s * d, u, v);
      c.drawImage(inTheme(plan.image.sha256, image), 0, 0);
      c.restore();
      drawn = true;
    }
  }
  c.globalAlpha = 1;
  byId("opacity-label").hidden = !drawn;
}
