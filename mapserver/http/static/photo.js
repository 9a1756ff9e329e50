// Where a photo was taken, or why that is not known: POST /relocalize.
import { add, ask, button, byId, degrees, fixed, side } from "./dom.js";
import { onPlans } from "./plans.js";

const LONGEST = 2048; // px; the server makes photos smaller anyway
const result = byId("answer");

const TAKEN = ["image/jpeg", "image/png"];
const MANY = 3; // times as many matches as are needed: rarely by chance

// What is sent: the file itself, or a JPEG of it if it is large or of another kind; null if it is no image.
async function prepared(file) {
  try {
    const image = await createImageBitmap(file), scale = Math.min(1, LONGEST / Math.max(image.width, image.height));
    if (TAKEN.includes(file.type) && (scale === 1 || file.size < 2e6)) return file;
    const canvas = document.createElement("canvas");
    canvas.width = Math.round(image.width * scale); canvas.height = Math.round(image.height * scale);
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return await new Promise(done => canvas.toBlob(done, "image/jpeg", 0.92));
  } catch (error) { return null; }
}
function table(candidates, show) {
  const made = add(result, "table"), head = made.insertRow();
  for (const name of ["place", "ahead", "left", "turned", "probability"]) add(head, "th", name);
  for (const c of candidates) {
    const [x, y, turn] = c.node_from_robot.mean, row = made.insertRow();
    const away = m => c.distance_known ? `${fixed(m)} m` : "not known";
    const place = add(row, "td");
    button(place, c.node, () => show(c.node));
    const where = [c.place, c.floor && `floor ${c.floor}`].filter(Boolean).join(", ");
    if (where) add(place, "div", where);
    const plan = onPlans(c.merged_from_robot?.mean, c.component);
    if (plan) add(place, "div", `on plan ${plan}`);
    const probability = (100 * c.probability).toFixed(0) + " %";
    for (const text of [away(x), away(y), degrees(turn), probability]) add(row, "td", text);
  }
}
function whyNot(similar, show) {
  if (!similar?.length) return;
  add(result, "p", "It looks most like:");
  const list = add(result, "ul");
  for (const place of similar) {
    const item = add(list, "li");
    button(item, place.node, () => show(place.node));
    const short = place.inliers < place.needed ? `; ${place.needed} are needed` : "";
    const counts = place.lacks.includes("are needed") ? ""
      : ` ${place.matches} landmarks match, ${place.inliers} agree on one pose${short}.`;
    item.append(` ${place.lacks}.${counts}`);
    if (place.turn !== null && Math.abs(place.turn) > 0.12) item.append(` Turn by ${side(place.turn)} and try again.`);
    else if (place.turn !== null) item.append(" Go a step aside and try again.");
  }
  if (similar.every(({ matches, needed }) => matches < needed))
    add(result, "p", "None of them need be the place: no robot may have mapped what the photo shows. Turn, or go a few steps, "
      + "and try again.");
  if (similar.some(({ matches, inliers, needed }) => matches >= MANY * needed && inliers < needed))
    add(result, "p", "Many landmarks match, but not where this camera would see them: check the height of the lens and the "
      + "angle of view above, and hold the camera level.");
}
let file = null, asked = 0;
async function locate(found, show) {
  if (!file) return;
  const number = ++asked;
  const query = new URLSearchParams();
  for (const name of ["height_m", "hfov"]) if (byId(name).value) query.set(name, byId(name).value);
  result.className = ""; result.textContent = "Looking ...";
  const busy = () => { if (number === asked) result.textContent = "Many robots ask at present, waiting ..."; };
  const body = await prepared(file), headers = { "Content-Type": body?.type };
  if (number !== asked) return;
  URL.revokeObjectURL(byId("shown").src);
  if (body) byId("shown").src = URL.createObjectURL(body);
  byId("shown").hidden = !body;
  const answer = body ? await ask("relocalize?" + query, { method: "POST", headers, body }, busy)
    : { error: `${file.name} is no image that can be read: choose a JPEG or PNG.` };
  if (number !== asked) return;
  result.textContent = "";
  if (answer.error) { result.className = "box failed"; result.textContent = answer.error; found([]); return; }
  const good = answer.certainty === "found" || answer.certainty === "place";
  result.className = good ? "box good" : answer.certainty === "unknown" ? "box failed" : "box";
  result.dataset.certainty = answer.certainty;
  add(result, "p", `${answer.certainty}: ${answer.reason}`);
  if (answer.candidates.length) table(answer.candidates, show);
  whyNot(answer.similar, show);
  found(answer.candidates);
}
export function listenForPhotos(opened, found, show) {
  const take = one => {
    if (!one) return;
    file = one;
    opened();
    locate(found, show);
  };
  byId("image").addEventListener("change", () => take(byId("image").files[0]));
  for (const id of ["height_m", "hfov"]) byId(id).addEventListener("change", () => locate(found, show));
  const drop = byId("drop"), files = event => [...(event.dataTransfer?.types || [])].includes("Files");
  document.addEventListener("dragover", event => { if (files(event)) { event.preventDefault(); drop.hidden = false; } });
  document.addEventListener("dragleave", event => { if (!event.relatedTarget) drop.hidden = true; });
  document.addEventListener("drop", event => {
    drop.hidden = true;
    if (!files(event)) return;
    event.preventDefault();
    take(event.dataTransfer.files[0]);
  });
}
