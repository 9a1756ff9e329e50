// A worker that draws nodes and edges into a bitmap: with many of them this takes longer than a frame.
// It takes `{ map }`, which holds until the next one, and `{ view }`, to which it answers `{ bitmap, view }`.
const CHUNK = 400;        // lines in one path: long paths take much longer
const FAR = 14;           // px a metre, below which nodes are squares
const HEADING = 1.8;      // length of a heading by the size of its node

let map = null;

onmessage = ({ data }) => {
  if (data.map) map = data.map;
  if (!data.view) return;
  const bitmap = paint(data.view);
  postMessage({ bitmap, view: data.view }, [bitmap]);
};

function paint(view) {
  const { ratio, width, height } = view, canvas = new OffscreenCanvas(Math.ceil(width * ratio), Math.ceil(height * ratio));
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  paintEdges(c, view);
  paintNodes(c, view);
  return canvas.transferToImageBitmap();
}
function paintEdges(c, d) {
  const { x, y, kinds, colours } = map, { a, b, kind, probability, count } = map.edges;
  const lines = {}, shortest = 1.5 / d.scale;
  for (let row = 0; row < count; row++) {
    if (!kind[row]) continue;
    const i = a[row], j = b[row];
    if (Math.max(x[i], x[j]) < d.left || Math.min(x[i], x[j]) > d.right) continue;
    if (Math.max(y[i], y[j]) < d.bottom || Math.min(y[i], y[j]) > d.top) continue;
    if (Math.abs(x[i] - x[j]) + Math.abs(y[i] - y[j]) < shortest) continue;
    const name = kinds[kind[row]], doubtful = name === "merged" && probability[row] < 0.9;
    (lines[doubtful ? "doubtful" : name] ||= []).push(i, j);
  }
  for (const name of ["mapped", "turned", "driven", "loop", "merged", "doubtful"]) {
    const ends = lines[name] || [], merged = name === "merged" || name === "doubtful";
    c.strokeStyle = colours[name === "doubtful" ? "merged" : name];
    // Lines of one pixel take a fifth of the time of wider ones.
    c.lineWidth = d.scale < FAR ? 1 / d.ratio : merged ? 1.6 : name === "driven" ? 1.8 : 1;
    c.setLineDash(name === "doubtful" ? [5, 4] : []);
    for (let k = 0; k < ends.length; k += 2 * CHUNK) {
      c.beginPath();
      for (let n = k; n < Math.min(ends.length, k + 2 * CHUNK); n += 2) {
        c.moveTo((x[ends[n]] - d.left) * d.scale, (d.top - y[ends[n]]) * d.scale);
        c.lineTo((x[ends[n + 1]] - d.left) * d.scale, (d.top - y[ends[n + 1]]) * d.scale);
      }
      c.stroke();
    }
  }
  c.setLineDash([]);
}
function paintNodes(c, d) {
  const { x, y, state, superseded, members, hues } = map;
  const inside = row => x[row] >= d.left && x[row] <= d.right && y[row] >= d.bottom && y[row] <= d.top;
  members.forEach((rows, component) => {
    c.fillStyle = c.strokeStyle = hues[component];
    for (const faint of [true, false]) {
      c.globalAlpha = faint ? 0.35 : 1;
      const shown = rows.filter(row => (state[row] === superseded) === faint && inside(row));
      if (d.scale < FAR) paintSquares(c, d, shown); else paintDots(c, d, shown);
    }
  });
  c.globalAlpha = 1;
}
function paintSquares(c, d, rows) {
  const size = Math.min(3, Math.max(1.5, d.scale / 4));
  for (const row of rows)
    c.fillRect((map.x[row] - d.left) * d.scale - size / 2, (d.top - map.y[row]) * d.scale - size / 2, size, size);
}
// Disks one by one, headings as one path of thin lines: a path with both takes three times as long.
function paintDots(c, d, rows) {
  const size = Math.min(7, 2.5 + d.scale / 18), { x, y, heading } = map;
  c.lineWidth = 1;
  for (let k = 0; k < rows.length; k += CHUNK) {
    const some = rows.slice(k, k + CHUNK), tips = new Path2D();
    for (const row of some) {
      const u = (x[row] - d.left) * d.scale, w = (d.top - y[row]) * d.scale;
      c.beginPath();
      c.arc(u, w, size / 2 + 0.7, 0, 7);
      c.fill();
      tips.moveTo(u, w);
      tips.lineTo(u + HEADING * size * Math.cos(heading[row]), w - HEADING * size * Math.sin(heading[row]));
    }
    c.stroke(tips);
  }
}
