// The merged map as columns of numbers, laid out on one plane: components have frames of their own, so each is
// put beside the others.
const TYPES = { rows: Uint32Array, map: Uint32Array, number: Float64Array, x: Float32Array, y: Float32Array,
  heading: Float32Array, component: Uint32Array, state: Uint8Array, a: Uint32Array, b: Uint32Array,
  kind: Uint8Array, probability: Float32Array };
export const SUPERSEDED = 2;
const GAP = 4;            // m between two components
const STRAY_SHARE = 0.02; // of the nodes, at most so many are strays

function decode(name, text) {
  // A loop takes a fifth of the time of Uint8Array.from with a function.
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return new TYPES[name](bytes.buffer);
}
function take(table, sent, whole) {
  const rows = whole ? null : decode("rows", sent.rows);
  for (const name in sent) {
    if (name === "count" || name === "rows") continue;
    const values = decode(name, sent[name]);
    if (whole) { table[name] = values; continue; }
    const old = table[name], column = old.length === sent.count ? old : new TYPES[name](sent.count);
    if (column !== old) column.set(old.subarray(0, sent.count));
    for (let k = 0; k < rows.length; k++) column[rows[k]] = values[k];
    table[name] = column;
  }
  table.count = sent.count;
}

// Without strays: an end of the sorted values that is farther from the rest than half of what the rest spans.
function range(values) {
  const sorted = Float64Array.from(values).sort(), most = Math.max(1, Math.floor(STRAY_SHARE * sorted.length));
  let low = 0, high = sorted.length - 1;
  for (let k = 0; k < most && high - k > 2; k++)
    if (sorted[k + 1] - sorted[k] > 0.5 * (sorted[high] - sorted[k + 1])) low = k + 1;
  for (let k = 0; k < most && high - low > 2; k++) {
    const at = sorted.length - 1 - k;
    if (sorted[at] - sorted[at - 1] > 0.5 * (sorted[at - 1] - sorted[low])) high = at - 1;
  }
  return [sorted[low], sorted[high]];
}

export class MapModel {
  constructor() {
    this.nodes = { count: 0 }; this.edges = { count: 0 }; this.maps = []; this.kinds = []; this.components = [];
    this.x = this.y = new Float64Array(0); this.order = []; this.links = []; this.version = 0;
    this.offsets = new Map(); this.slots = new Map();
  }
  apply(message) {
    take(this.nodes, message.nodes, message.whole);
    take(this.edges, message.edges, message.whole);
    Object.assign(this, { maps: message.maps, kinds: message.kinds, components: message.components,
      version: message.version });
    this.numbers = new Map(this.maps.map((name, k) => [name, k]));
    this.arrange();
  }
  arrange() {
    const { count, x, y, component, state } = this.nodes, boxes = this.components.map(() => [1e9, 1e9, -1e9, -1e9]);
    const members = this.components.map(() => []);
    this.rows = new Map();
    for (let row = 0; row < count; row++) {
      if (!state[row]) continue;
      members[component[row]].push(row);
      this.rows.set(this.nodes.map[row] * 2 ** 32 + this.nodes.number[row], row);
      const box = boxes[component[row]];
      box[0] = Math.min(box[0], x[row]); box[1] = Math.min(box[1], y[row]);
      box[2] = Math.max(box[2], x[row]); box[3] = Math.max(box[3], y[row]);
    }
    this.place(boxes);
    Object.assign(this, { boxes, members });
    this.order = members.flat();
    this.x = new Float64Array(count); this.y = new Float64Array(count);
    for (const row of this.order) {
      const [dx, dy] = this.offset(component[row]);
      this.x[row] = x[row] + dx; this.y[row] = y[row] + dy;
    }
    this.links = [];
    const kinds = this.edges.kind;
    for (let row = 0; row < this.edges.count; row++)
      if (kinds[row] && this.kinds[kinds[row]] === "merged") this.links.push(row);
  }
  // The first component stays where its frame is, the others stand in rows below: those that were there before in their order,
  // then the larger ones. A component keeps its place as long as it fits there.
  place(boxes) {
    const anchors = this.components.map(({ anchor }) => anchor), before = [...this.slots.keys()];
    const fits = boxes.every((box, k) => {
      const slot = this.slots.get(anchors[k]);
      return slot && box[0] >= slot[0] && box[1] >= slot[1] && box[2] <= slot[2] && box[3] <= slot[3];
    });
    if (fits && boxes.length === this.slots.size) return;
    this.slots.clear(); this.offsets.clear();
    const rank = k => before.includes(anchors[k]) ? before.indexOf(anchors[k]) : before.length + k;
    const order = [...boxes.keys()].sort((a, b) => rank(a) - rank(b));
    const width = Math.max(10, ...boxes.map(box => box[2] - box[0]));
    let left = 0, top = 0, deepest = 0;
    order.forEach((k, n) => {
      const box = boxes[k], anchor = anchors[k], room = 0.15 * Math.max(box[2] - box[0], box[3] - box[1], 4);
      this.slots.set(anchor, [box[0] - room, box[1] - room, box[2] + room, box[3] + room]);
      if (!n) {
        this.offsets.set(anchor, [0, 0]);
        left = this.left = box[0]; top = box[1] - GAP;
        return;
      }
      const wide = box[2] - box[0], high = box[3] - box[1];
      if (left > this.left && left + wide > this.left + width) { left = this.left; top -= deepest + GAP; deepest = 0; }
      this.offsets.set(anchor, [left - box[0], top - box[3]]);
      left += wide + GAP; deepest = Math.max(deepest, high);
    });
  }
  offset(component) { return this.offsets.get(this.components[component]?.anchor) || [0, 0]; }
  name(row) { return `${this.maps[this.nodes.map[row]]}.${this.nodes.number[row]}`; }
  rowOf(name = "") {
    const at = name.lastIndexOf("."), map = this.numbers?.get(name.slice(0, at));
    return map === undefined ? undefined : this.rows.get(map * 2 ** 32 + Number(name.slice(at + 1)));
  }
  // A pose [x, y, heading] of a component on the plane.
  placed(pose, component) {
    const [dx, dy] = this.offset(component);
    return [pose[0] + dx, pose[1] + dy, pose[2]];
  }
  // A point of a node's frame on the plane.
  inNode(row, x, y) {
    const c = Math.cos(this.nodes.heading[row]), s = Math.sin(this.nodes.heading[row]);
    return [this.x[row] + c * x - s * y, this.y[row] + s * x + c * y];
  }
  // A point of the plane in a node's frame.
  toNode(row, x, y) {
    const c = Math.cos(this.nodes.heading[row]), s = Math.sin(this.nodes.heading[row]);
    const dx = x - this.x[row], dy = y - this.y[row];
    return [c * dx + s * dy, c * dy - s * dx];
  }
  nearest(x, y, reach, rows = this.order) {
    let best = -1, least = reach * reach;
    for (const row of rows) {
      const d = (this.x[row] - x) ** 2 + (this.y[row] - y) ** 2;
      if (d < least) { least = d; best = row; }
    }
    return best;
  }
  nearestLink(x, y, reach, rows = this.links) {
    let best = -1, least = reach * reach;
    for (const row of rows) {
      const a = this.edges.a[row], b = this.edges.b[row];
      const ux = this.x[b] - this.x[a], uy = this.y[b] - this.y[a], length = ux * ux + uy * uy;
      const t = length ? Math.min(1, Math.max(0, ((x - this.x[a]) * ux + (y - this.y[a]) * uy) / length)) : 0;
      const d = (x - this.x[a] - t * ux) ** 2 + (y - this.y[a] - t * uy) ** 2;
      if (d < least) { least = d; best = row; }
    }
    return best;
  }
  nearestEdge(x, y, reach) {
    const kinds = this.edges.kind || [];
    return this.nearestLink(x, y, reach, [...kinds.keys()].filter(row => kinds[row]));
  }
  // [left, bottom, right, top] of some nodes, without strays; null without any.
  bounds(rows = this.order) {
    if (!rows.length) return null;
    const [left, right] = range(rows.map(row => this.x[row])), [bottom, top] = range(rows.map(row => this.y[row]));
    return [left, bottom, right, top];
  }
}
