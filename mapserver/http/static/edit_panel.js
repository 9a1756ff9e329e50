// The tab Edit: what is selected, a form for each kind of edit, what the server says it would do, and then does. Forms
// stay as they are when the kind, the tab or the selection changes, so nothing that was typed is lost.
import { add, button, byId, counted, say } from "./dom.js";
import { change, callMe, onPermission, permission } from "./changes.js";
import { EDITORS } from "./editors.js";
import { placeNamed } from "./annotations.js";
import { nodeNamed, wordsOf } from "./names.js";

const PLAN = "plan";  // has a form of its own, see plan_editor.js
const MOST_NAMES = 40; // in the field of nodes; of more it says how many

export class EditPanel {
  // `planning` is called when another kind is chosen, `moved` when the map is to be drawn again.
  constructor(model, selection, drawing, { planning, moved }) {
    Object.assign(this, { model, selection, drawing, planning, moved, kind: "", checked: "", lacks: "", forms: new Map(), number: 0 });
    selection.changed = () => this.selected();
    drawing.changed = () => this.drawn();
    const kinds = byId("edit-kind"), groups = new Map();
    for (const editor of EDITORS) {
      if (!groups.has(editor.group)) {
        const group = add(kinds, "optgroup");
        group.label = editor.group;
        groups.set(editor.group, group);
      }
      groups.get(editor.group).append(new Option(editor.label, editor.id));
      this.forms.set(editor.id, this.fields(editor));
    }
    kinds.append(new Option("Floor plan", PLAN));
    kinds.addEventListener("change", () => this.show(kinds.value));
    byId("edit-form").addEventListener("submit", event => { event.preventDefault(); this.check(); });
    byId("edit-form").addEventListener("input", () => { this.lines(); this.forget(); });
    byId("edit-apply").addEventListener("click", () => this.apply());
    byId("edit-nodes").addEventListener("change", () => this.typed());
    byId("edit-clear").addEventListener("click", () => { drawing.cancel(); selection.clear(); });
    byId("edit-within").addEventListener("click", () => selection.set(selection.rows().map(row => model.name(row))));
    byId("draw-finish").addEventListener("click", () => drawing.finish());
    for (const shape of ["rectangle", "polygon"])
      byId(`draw-${shape}`).addEventListener("click", () => {
        drawing.begin(drawing.shape === shape ? "" : shape);
        if (drawing.shape) byId("canvas").focus();
      });
    byId("edit-name").value = permission.name;
    byId("edit-name").addEventListener("change", () => callMe(byId("edit-name").value.trim()));
    onPermission(({ allowed, why }) => {
      byId("edit-refused").hidden = allowed;
      byId("edit-refused").textContent = why;
      for (const set of document.querySelectorAll("#edit fieldset.editing")) set.disabled = !allowed;
    });
    this.show(EDITORS[0].id);
  }
  // The name of the login, which the server records.
  sign(name) {
    permission.name = name;
    byId("edit-who").hidden = true;
  }
  fields({ id, fields, more }) {
    const set = add(byId("edit-kinds"), "div", "", "fields"), inputs = {};
    set.hidden = true;
    const depending = [];
    let details = null;
    if (more) {
      details = document.createElement("details");
      add(details, "summary", more);
    }
    for (const { name, label, options, more: hidden, when, ...attributes } of fields) {
      const line = add(hidden ? details : set, "label", label), input = add(line, options ? "select" : "input");
      input.id = `edit-${id}-${name}`;
      for (const [value, words] of options || []) input.append(new Option(words, value));
      for (const [key, value] of Object.entries(attributes)) input[key] = value;
      inputs[name] = input;
      if (when) depending.push([line, input, when]);
    }
    if (details) set.append(details);
    return { set, inputs, details, depending };
  }
  // Fields that are shown for some values of others only.
  lines() {
    for (const [line, input, when] of this.forms.get(this.kind)?.depending || [])
      line.hidden = input.disabled = !when(this.values());
  }
  // Which kind of edit, from the list or from another panel.
  show(kind) {
    this.kind = byId("edit-kind").value = kind;
    this.editor = EDITORS.find(editor => editor.id === kind);
    byId("plan-editor").hidden = kind !== PLAN;
    byId("edit-form").hidden = byId("edit-selection").hidden = kind === PLAN;
    byId("edit-hint").textContent = this.editor?.hint || "An image of the building, laid under the map by places on both.";
    for (const [id, { set, inputs }] of this.forms) {
      set.hidden = id !== kind;
      // What is hidden must not keep the form from being sent.
      for (const input of Object.values(inputs)) input.disabled = id !== kind;
    }
    this.lines();
    byId("edit-answer").textContent = "";
    this.drawing.cancel();
    this.forget();
    this.planning();
  }
  // After the selection, the map or a field has changed, what was checked does not hold any more.
  forget() {
    this.number++;
    this.checked = "";
    byId("edit-apply").disabled = true;
    this.counts();
  }
  selected() {
    const { selection } = this, { names, area } = selection;
    byId("edit-nodes").value = names.length > MOST_NAMES ? "" : names.join(" ");
    byId("edit-nodes").placeholder = names.length > MOST_NAMES ? `${names.length} nodes` : "r0.1.17 kitchen 3.1,-2";
    this.lacks = "";
    byId("edit-within").disabled = !area;
    byId("edit-clear").disabled = !area && !names.length;
    byId("edit-answer").textContent = "";
    this.forget();
    this.moved();
  }
  counts() {
    const { selection, model, editor } = this, { names, area } = selection;
    let words = this.lacks ? this.lacks : area && !selection.corners().length ? `${area.anchor}, on which the area hangs, is not on the map any more.` : area ? `An area of ${selection.size().toFixed(1)} m\u00b2 at ${area.anchor}: ${selection.words()}.`
      : names.length ? `${selection.words()}.` : "Nothing to change yet. Click nodes on the map, type them, or draw an area.";
    if (editor?.whole?.(this.values()) && names.length === 1) {
      const row = model.rowOf(names[0]), map = model.nodes.map[row];
      words = row === undefined ? `${names[0]} is not on the map.`
        : `Map ${model.maps[map]}: ${selection.words(model.order.filter(one => model.nodes.map[one] === map))}.`;
    }
    if (editor?.id === "link" && names.length === 2) {
      const [a, b] = names.map(name => model.nodes.component[model.rowOf(name)]);
      if (a !== undefined && b !== undefined)
        words += a === b ? ` Both are in component ${a} already.`
          : ` It joins component ${a} (${counted(model.members[a].length, "node")}) and component ${b} (${counted(model.members[b].length, "node")}).`;
    }
    say(byId("edit-counts"), words);
    byId("edit-counts").className = this.lacks ? "bad" : "";
    byId("edit-check").disabled = Boolean(this.lacks);
    byId("edit-nodes").setAttribute("aria-invalid", Boolean(this.lacks));
  }
  typed() {
    const input = byId("edit-nodes"), text = input.value, words = wordsOf(text);
    const area = words.length === 1 && placeNamed(words[0])?.body.area;
    if (area) { this.selection.take(area); return; }
    const found = words.map(word => nodeNamed(word, this.model)), lacks = found.find(one => one.lacks)?.lacks || "";
    // What was selected before must not be changed in the place of what is typed.
    this.selection.set(lacks ? [] : found.map(one => one.node));
    if (!lacks) return;
    input.value = text;
    this.lacks = lacks;
    byId("edit-clear").disabled = false;
    this.counts();
  }
  drawn() {
    const { shape } = this.drawing;
    for (const one of ["rectangle", "polygon"]) byId(`draw-${one}`).setAttribute("aria-pressed", shape === one);
    byId("draw-finish").hidden = shape !== "polygon";
    byId("draw-finish").disabled = this.drawing.corners.length < 3;
    say(byId("draw-hint"), this.drawing.hint());
    this.moved();
  }
  values() {
    const inputs = Object.entries(this.forms.get(this.kind)?.inputs || {});
    return Object.fromEntries(inputs.map(([name, input]) => [name, input.value.trim()]));
  }
  say(words, kind, more = "") {
    const box = byId("edit-answer");
    box.textContent = "";
    const answer = add(box, "div", "", `box ${kind}`);
    add(answer, "p", words);
    if (more) add(answer, "p", more);
    answer.scrollIntoView({ block: "nearest" });
  }
  request() {
    const { path, content } = this.editor.request(this.selection, this.values());
    return { path, content: { ...content, because: byId("edit-because").value.trim() } };
  }
  // Ask the server what it would do.
  async check() {
    let request;
    try { request = this.request(); } catch (error) { this.say(error.message, "failed"); return; }
    const answer = await this.send(request, true);
    if (!answer) return;
    const { details } = this.forms.get(this.kind), { moreWhen } = this.editor;
    if (answer.error && details && moreWhen.test(answer.error)) details.open = true;
    if (answer.error) { this.say(answer.error, "failed"); return; }
    this.checked = JSON.stringify(request);
    byId("edit-apply").disabled = false;
    this.say(answer.said, "");
  }
  async apply() {
    if (!this.checked || !byId("edit-form").reportValidity()) return;
    const answer = await this.send(JSON.parse(this.checked), false);
    if (!answer) return;
    if (answer.error) { this.say(answer.error, "failed"); return; }
    this.forget();
    this.say(answer.said, "good", "It is in the Timeline, where it can be taken back.");
  }
  // The answer; none if something else has been asked meanwhile.
  async send({ path, content }, check) {
    const number = ++this.number;
    byId("edit-apply").disabled = true;
    this.say("Asking ...", "");
    const answer = await change(path, check ? { ...content, check } : content);
    if (number !== this.number) {
      // What was done is shown in any case.
      if (!check) this.say(answer.error || answer.said, answer.error ? "failed" : "good");
      else if (byId("edit-answer").textContent === "Asking ...") byId("edit-answer").textContent = "";
      return null;
    }
    if (!check && answer.error) byId("edit-apply").disabled = false;
    return answer;
  }
}
