// The form of a floor plan: an image, pairs of places by clicking the plan and the map in turn, and how well they fit.
// After each pair the server fits the plan and says the residuals; nothing is kept before Save.
import { add, button, byId, fixed, say } from "./dom.js";
import { change } from "./changes.js";
import { colours } from "./colours.js";
import { draft, planNamed, planNames } from "./plans.js";
import { PlanPane, mark } from "./plan_pane.js";

const SNAP = 14;  // px: a click so near to a node means the node
const LEAST = 3;  // pairs
const YAML = /\.ya?ml$/i;

export class PlanEditor {
  constructor(model, viewport, moved) {
    Object.assign(this, { model, viewport, moved, open: false, image: null, origin: null, pairs: [], place: null, pixel: null,
      fit: null, number: 0, saved: "" });
    this.pane = new PlanPane(byId("plan-canvas"), (u, v) => this.clickedPlan(u, v));
    byId("plan-file").addEventListener("change", () => this.take([...byId("plan-file").files]));
    byId("plan-choice").addEventListener("change", () => this.load(byId("plan-choice").value));
    byId("plan-name").addEventListener("input", () => this.drafted());
    byId("plan-scale").addEventListener("change", () => this.changed());
    byId("plan-editor").addEventListener("submit", event => { event.preventDefault(); this.save(); });
    byId("plan-delete").addEventListener("click", () => this.remove());
    this.show();
  }
  show(open = this.open) {
    this.open = open;
    byId("plan-pane").hidden = !open || !this.image;
    document.querySelector("main").classList.toggle("planning", open && Boolean(this.image));
    this.list();
    this.pane.resize();
    this.words();
    this.drafted();
  }
  // Plans come and go while the form is open.
  list() {
    const choice = byId("plan-choice"), names = planNames(), kept = names.includes(this.saved) ? this.saved : choice.value;
    // A list that is open stays open.
    if (names.join("\n") !== [...choice.options].slice(1).map(one => one.value).join("\n") || !choice.options.length)
      choice.replaceChildren(new Option("A new plan", ""), ...names.map(name => new Option(name, name)));
    choice.value = names.includes(kept) ? kept : "";
    if (choice.value === this.saved) this.saved = "";
    byId("plan-delete").hidden = !choice.value;
  }
  // An image, or a map.yaml with its image.
  async take(files) {
    const yaml = files.find(file => YAML.test(file.name)), image = files.find(file => !YAML.test(file.name));
    if (!files.length) return;
    if (!image) { this.say("Choose the image together with its map.yaml: both files at once.", "failed"); return; }
    this.say("Sending the image ...", "");
    let content = image;
    if (yaml) {
      content = new FormData();
      content.append("image", image); content.append("map", yaml);
    }
    const answer = await change("plans", content);
    if (answer.error) { this.say(answer.error, "failed"); return; }
    const { sha256, width, height, metres_per_pixel: scale, origin } = answer;
    this.image = { sha256, width, height, file: image.name.slice(-255) };
    this.origin = origin || null;
    if (scale) byId("plan-scale").value = scale;
    if (!byId("plan-name").value) byId("plan-name").value = (yaml || image).name.replace(/\.[^.]*$/, "").slice(0, 64);
    byId("plan-answer").textContent = "";
    this.shown();
    this.changed();
  }
  shown() {
    this.pane.image = this.image;
    this.show();
    this.pane.fit();
  }
  load(name) {
    const placed = planNamed(name), plan = placed?.plan;
    Object.assign(this, { image: plan?.image || null, origin: plan?.origin || null, place: null, pixel: null,
      pairs: (plan?.pairs || []).map(pair => ({ ...pair })), fit: placed || null });
    this.number++;
    byId("plan-name").value = name;
    byId("plan-scale").value = plan?.metres_per_pixel || "";
    byId("plan-answer").textContent = "";
    if (this.image) this.shown(); else this.show();
    this.report();
  }
  clickedPlan(u, v) {
    if (u < 0 || v < 0 || u > this.image.width || v > this.image.height) {
      byId("plan-next").textContent = "That is beside the plan: click on its image.";
      return;
    }
    this.pixel = { u: +u.toFixed(1), v: +v.toFixed(1) };
    this.join();
  }
  // A click on the map at a point of the plane.
  clickedMap(x, y) {
    const { model } = this, near = model.nearest(x, y, SNAP / this.viewport.scale);
    const row = near >= 0 ? near : model.nearest(x, y, Infinity);
    if (row < 0) return;
    const [dx, dy] = near >= 0 ? [0, 0] : model.toNode(row, x, y);
    this.place = { node: model.name(row), x: +dx.toFixed(3), y: +dy.toFixed(3) };
    this.join();
  }
  join() {
    if (this.place && this.pixel) {
      this.pairs.push({ ...this.place, ...this.pixel });
      this.place = this.pixel = null;
      this.changed();
    } else this.words();
    this.draw();
  }
  content(name) {
    const scale = byId("plan-scale").value;
    return { name, body: { kind: "plan", image: this.image, pairs: this.pairs, ...this.origin ? { origin: this.origin } : {},
      ...scale ? { metres_per_pixel: Number(scale) } : {} } };
  }
  // After each pair: what the server's fit says.
  async changed() {
    const number = ++this.number;
    this.fit = null;
    this.words();
    this.report();
    if (!this.image || this.pairs.length < LEAST) { this.drafted(); return; }
    const name = byId("plan-name").value.trim() || "plan", kept = planNamed(name);
    // The server refuses what it has already, which fits as before.
    if (kept && this.isOf(kept.plan)) { this.fit = kept; this.report(); this.drafted(); return; }
    const answer = await change("annotations", { ...this.content(name), check: true });
    if (number !== this.number) return;
    this.fit = answer.error ? { reason: answer.error, parts: [] } : answer.plan;
    this.report();
    this.drafted();
  }
  // Whether a plan that is kept is the one of the form.
  isOf({ image, pairs, metres_per_pixel: scale }) {
    const words = list => list.map(({ node, x, y, u, v }) => [node, x || 0, y || 0, u, v].join()).join("\n");
    return image.sha256 === this.image.sha256 && (scale || 0) === Number(byId("plan-scale").value)
      && words(pairs) === words(this.pairs);
  }
  // The plan as it is fitted now, under the map.
  drafted() {
    const name = byId("plan-name").value.trim();
    draft.plan = this.open && this.image && this.fit ? { name, plan: { image: this.image }, parts: this.fit.parts } : null;
    this.draw();
  }
  draw() {
    this.pane.marks = { pairs: this.pairs, pixel: this.pixel };
    this.pane.draw();
    this.moved();
  }
  words() {
    say(byId("plan-next"), !this.image ? "" : this.pixel ? "Now click the same place on the map."
      : this.place ? "Now click the same place on the plan."
        : `${this.pairs.length ? "" : `${LEAST} pairs or more, far apart. `}Click a place on the plan, then the same place on the map.`);
    byId("plan-save").disabled = !this.image || this.pairs.length < LEAST;
  }
  report() {
    const list = byId("plan-pairs"), words = byId("plan-fit"), fitted = new Map();
    list.textContent = words.textContent = "";
    for (const part of this.fit?.parts || []) {
      for (const pair of part.pairs) fitted.set(pair.number, pair);
      const given = part.scale_sigmas || byId("plan-scale").value;
      add(words, "p", `Component ${part.component}: ${+part.metres_per_pixel.toPrecision(4)} m/px` +
        (given ? ` as given, ${+part.fitted_scale.toPrecision(4)} by the pairs (${part.scale_sigmas.toFixed(1)} sigma)`
          : " by the pairs") + `; residuals ${part.rms.toFixed(2)} m rms, sigma ${part.sigma.toFixed(2)} m amid the pairs.`);
      for (const doubt of part.doubts) add(words, "p", doubt, "warn");
    }
    if (this.fit?.reason) add(words, "p", this.fit.reason, "warn");
    this.pairs.forEach((pair, k) => {
      const item = add(list, "li"), off = fitted.get(k + 1);
      const place = pair.x || pair.y ? `${pair.node} ${fixed(pair.x)}, ${fixed(pair.y)} m` : pair.node;
      item.append(`${place} = ${pair.u.toFixed(0)}, ${pair.v.toFixed(0)} px `);
      if (off) add(item, "span", `off by ${off.off.toFixed(2)} m, from the others ${off.off_others.toFixed(2)} m `,
        off.chance * this.pairs.length < 0.01 ? "bad" : "soft");
      button(item, "Remove", () => {
        this.pairs.splice(k, 1);
        this.changed();
        this.draw();
        byId("plan-pairs").querySelectorAll("button")[Math.min(k, this.pairs.length - 1)]?.focus();
      }).setAttribute("aria-label", `Remove pair ${k + 1}`);
    });
  }
  async save() {
    const because = byId("plan-because").value.trim(), name = byId("plan-name").value.trim();
    this.say("Saving ...", "");
    const answer = await change("annotations", { ...this.content(name), because });
    if (!answer.error) this.saved = name;
    this.list();
    this.say(answer.error || answer.said, answer.error ? "failed" : "good");
  }
  async remove() {
    const because = byId("plan-because").value.trim(), name = byId("plan-choice").value;
    const answer = await change("annotations", { name, body: { kind: "plan" }, removed: true, because });
    // The form keeps what it has: Save brings the plan back.
    this.say(answer.error || answer.said, answer.error ? "failed" : "good");
  }
  say(words, kind) {
    byId("plan-answer").textContent = "";
    add(byId("plan-answer"), "p", words, `box ${kind}`);
  }
  // On the map: each place, and a line to where the plan has it.
  drawMarks(c, viewport) {
    if (!this.open || !this.image) return;
    const { model } = this, at = ({ node, x, y }) => {
      const row = model.rowOf(node);
      return row === undefined ? null : viewport.toScreen(...model.inNode(row, x, y));
    };
    c.strokeStyle = c.fillStyle = colours.robot;
    this.pairs.forEach((pair, k) => {
      const point = at(pair), row = model.rowOf(pair.node);
      if (!point) return;
      const part = this.fit?.parts.find(one => one.component === model.nodes.component[row]);
      if (part) {
        const [a, b, e, d, x, y] = part.merged_from_image, [dx, dy] = model.offset(part.component);
        const there = viewport.toScreen(a * pair.u + e * pair.v + x + dx, b * pair.u + d * pair.v + y + dy);
        c.lineWidth = 2; c.beginPath(); c.moveTo(...point); c.lineTo(...there); c.stroke();
      }
      mark(c, ...point, k + 1);
    });
    const point = this.place && at(this.place);
    if (point) mark(c, ...point, "");
  }
}
