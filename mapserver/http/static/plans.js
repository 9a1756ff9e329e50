// Floor plans under the map: GET /plans and their images. A map file of before has none.
import { ask } from "./dom.js";

const FAINT = 0.5;
const images = new Map(); // by digest
let plans = [], offered = true;

export async function loadPlans(loaded) {
  if (!offered) return;
  const answer = await ask("plans");
  offered = answer.status !== 404;
  if (answer.error) return;
  plans = answer.plans || [];
  for (const { name, plan } of plans) {
    if (images.has(plan.image.sha256)) continue;
    const image = new Image();
    images.set(plan.image.sha256, image);
    image.onload = loaded;
    image.src = `plans/${name.split("/").map(encodeURIComponent).join("/")}.png`;
  }
  loaded();
}
export function drawPlans(c, viewport, model) {
  c.globalAlpha = FAINT;
  for (const { plan, parts } of plans) {
    const image = images.get(plan.image.sha256);
    if (!image?.complete || !image.naturalWidth) continue;
    for (const { component, merged_from_image: [a, b, e, d, x, y] } of parts) {
      const [dx, dy] = model.offset(component), [u, v] = viewport.toScreen(x + dx, y + dy), s = viewport.scale;
      c.save();
      // The page's v points down, the plane's y up.
      c.transform(s * a, -s * b, s * e, -s * d, u, v);
      c.drawImage(image, 0, 0);
      c.restore();
    }
  }
  c.globalAlpha = 1;
}
