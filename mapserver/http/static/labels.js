// Texts on the map, none of which lies on another: what is asked for first comes first, and what finds no room is left
// out. Drawn last, over everything else.
const MOST = 400, OUTLINED = 100;
const ABOVE = 11, BELOW = 3;  // px that a line reaches from its base
const LINE = 15;              // px from line to line
const BESIDE = 14;            // px from a point
const LINES = 4;              // so many above and below a point are tried
const STYLES = { robot: "600 12px system-ui, sans-serif", name: "600 13px system-ui, sans-serif",
  component: "12px system-ui, sans-serif", node: "11px system-ui, sans-serif",
  selected: "600 11px system-ui, sans-serif" };

export class Labels {
  constructor(c, { width, height }, ground) {
    Object.assign(this, { c, width, height, ground, taken: [], texts: [] });
  }
  // Keep a box free of texts: left, top, right, bottom.
  keep(...box) { this.taken.push(box); }
  // A text with its base line's left end at a point. Returns it; null if there is no room.
  at(left, base, text, style, colour, wide = this.widthOf(text, style)) {
    const box = [left, base - ABOVE, left + wide, base + BELOW];
    if (this.texts.length >= MOST) return null;
    if (box[0] < 0 || box[2] > this.width || box[1] < 0 || box[3] > this.height) return null;
    if (this.taken.some(t => t[0] < box[2] && t[2] > box[0] && t[1] < box[3] && t[3] > box[1])) return null;
    this.taken.push(box);
    const label = { text, left, base, wide, style, colour };
    this.texts.push(label);
    return label;
  }
  // The first of some texts that has room beside a point: above or below, right or left, then further lines.
  beside(u, v, texts, style, colour) {
    if (u < 0 || v < 0 || u > this.width || v > this.height) return null;
    const sizes = texts.map(text => [text, this.widthOf(text, style)]);
    for (let line = 0; line < LINES; line++)
      for (const [text, wide] of sizes)
        for (const left of [u + BESIDE, u - BESIDE - wide])
          for (const base of [v - 10 - LINE * line, v + 20 + LINE * line]) {
            const label = this.at(left, base, text, style, colour, wide);
            if (label) return label;
          }
    return null;
  }
  widthOf(text, style) {
    this.c.font = STYLES[style];
    return this.c.measureText(text).width;
  }
  draw() {
    const { c } = this;
    c.textBaseline = "alphabetic"; c.textAlign = "left"; c.lineWidth = 3; c.strokeStyle = this.ground;
    for (const { text, left, base, style, colour } of this.texts) {
      c.font = STYLES[style]; c.fillStyle = colour;
      // A name that a dot covers in part could be read as another. Of many the outline takes too long.
      if (style !== "node" || this.texts.length <= OUTLINED) c.strokeText(text, left, base);
      c.fillText(text, left, base);
    }
  }
}
