/** The map of where it happened: one network at a time, a sign an episode. */
class Places {
  constructor(canvas, open) {
    this.canvas = canvas;
    this.open = open;
    this.rows = [];
    this.chosen = 0;
    this.lines = new Map();
    canvas.addEventListener("click", (e) => { const i = this.nearest(e.offsetX, e.offsetY); if (i !== null) this.open(i); });
    canvas.addEventListener("pointermove", (e) => { const i = this.nearest(e.offsetX, e.offsetY); canvas.title = i === null ? "" : plain(`${columns.network[i]}, ${columns.ego[i]}, seed ${columns.seed[i]}`); });
  }

  async choose(k) {
    this.chosen = k;
    if (!this.lines.has(k)) this.lines.set(k, await roadLines(data.maps[k]));
    this.draw(this.rows);
  }

  /** Where a place [m] is on the canvas. */
  at(x, y) { return [this.width / 2 + (x - this.middle[0]) * this.scale, this.height / 2 - (y - this.middle[1]) * this.scale]; }

  draw(rows) {
    this.rows = rows;
    const map = this.lines.get(this.chosen);
    if (!map) return;
    Object.assign(this, sharpen(this.canvas));
    const here = rows.filter((i) => data.map[i] === this.chosen);
    this.here = here;
    this.bounds = this.bounds || new Map();
    if (!this.bounds.has(this.chosen)) this.bounds.set(this.chosen, boundsOf(this.chosen));
    this.frame(this.bounds.get(this.chosen));
    const c = this.canvas.getContext("2d"), k = palette();
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    c.strokeStyle = k.other;
    c.globalAlpha = 0.6;
    c.lineWidth = Math.max(0.8, Math.min(3 * this.scale, 4));
    c.beginPath();
    for (const line of map.lines) line.forEach(([x, y], n) => { const p = this.at(x, y); n ? c.lineTo(...p) : c.moveTo(...p); });
    c.stroke();
    c.globalAlpha = 0.85;
    for (const kind of DRAWN.map((each) => each.key).reverse()) {
      c.fillStyle = c.strokeStyle = { serious: k.adversary, strict: k.adversary, valid: k.adversary, collision: k.ego, critical: k.raw, calm: k.soft }[kind];
      for (const i of here) if (classes[i] === kind) sign(c, kind, ...this.at(data.x[i], data.y[i]));
    }
    c.globalAlpha = 1;
    c.fillStyle = k.ink;
    const bar = [2000, 1000, 500, 200, 100, 50, 20, 10].find((m) => m * this.scale <= this.width / 4) || 5;
    c.fillRect(10, this.height - 12, bar * this.scale, 3);
    c.font = "600 12px system-ui, sans-serif";
    c.fillText(`${bar} m`, 10, this.height - 17);
  }

  frame([left, right, low, high]) {
    this.middle = [(left + right) / 2, (low + high) / 2];
    this.scale = Math.min(this.width / (right - left + 120), this.height / (high - low + 120));
  }

  nearest(px, py) {
    let best = null, least = 12;
    for (const i of this.here || []) {
      const [x, y] = this.at(data.x[i], data.y[i]), away = Math.hypot(x - px, y - py);
      if (away < least && data.page[i]) { least = away; best = i; }
    }
    return best;
  }
}

/** Left, right, low, high [m] of the episodes' places on a network. */
function boundsOf(chosen) {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (let i = 0; i < total; i++) {
    if (data.map[i] !== chosen) continue;
    left = Math.min(left, data.x[i]);
    right = Math.max(right, data.x[i]);
    low = Math.min(low, data.y[i]);
    high = Math.max(high, data.y[i]);
  }
  return [left, right, low, high];
}

function sign(c, kind, x, y) {
  c.beginPath();
  if (kind === "collision") c.rect(x - 4, y - 4, 8, 8);
  else if (kind === "serious") { for (const [dx, dy] of [[0, -7], [6, 0], [0, 7], [-6, 0]]) c.lineTo(x + dx, y + dy); c.closePath(); }
  else if (kind === "critical") { c.moveTo(x, y - 5); c.lineTo(x + 5, y + 4); c.lineTo(x - 5, y + 4); c.closePath(); }
  else c.arc(x, y, 4.5, 0, 7);
  c.lineWidth = 1.5;
  if (kind === "calm" || kind === "valid") c.stroke(); else c.fill();
  if (kind !== "valid") return;
  c.beginPath();
  c.arc(x, y, 2, 0, 7);
  c.fill();
}

async function roadLines(map) {
  const reader = new Columns(await inflated(map.blob));
  const [xs, ys] = [0, 1].map((axis) => map.lines.map((n) => reader.next(n, 1, 0.1).map((v) => v + map.origin[axis])));
  return { lines: xs.map((line, k) => Array.from(line, (x, n) => [x, ys[k][n]])) };
}
