const ROWS = [
  { title: "TTC [s]", names: ["ttc"], most: 10, least: 0, line: "threshold" },
  { title: "distance of the boxes [m]", names: ["gap"], most: 60, least: 0 },
  { title: "speed [m/s]", names: ["ego_speed", "adversary_speed"], least: 0 },
  { title: "acceleration [m/s²]", names: ["ego_acceleration", "adversary_acceleration"], line: 0 },
];
const DASHES = { best: [], first: [7, 4], raw: [2, 3] };
const EDGE = { left: 44, right: 10, top: 16, gap: 24 };

/** Four series over one time axis; the lines on one canvas, the cursor on another. */
class Charts {
  constructor(lines, cursor, scene, moments, threshold) {
    Object.assign(this, { lines, cursorCanvas: cursor, scene, threshold });
    this.all = [...ROWS, ...scene.notes.map(([name]) => ({ title: `${name} (your driver)`, names: [`note ${name}`], free: true }))];
    this.moments = moments.filter((m) => m.key !== "raw_closest");
    this.resize();
  }

  resize() {
    sharpen(this.cursorCanvas);
    Object.assign(this, sharpen(this.lines));
    this.colours = palette();
  }

  x(frame) { return EDGE.left + ((frame - this.from) / Math.max(1, this.to - this.from)) * (this.width - EDGE.left - EDGE.right); }

  /** The frame under a place on the canvas. */
  frameAt(px) {
    const part = (px - EDGE.left) / (this.width - EDGE.left - EDGE.right);
    return Math.round(this.from + Math.min(Math.max(part, 0), 1) * (this.to - this.from));
  }

  /** Draw the lines of some attempts between two frames. */
  draw(attempts, from, to) {
    Object.assign(this, { from, to });
    const c = this.lines.getContext("2d"), k = this.colours;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    const tall = (this.height - 18) / this.all.length;
    this.rows = this.all.map((row, i) => ({ row, top: tall * i + EDGE.top + (i ? 4 : 12), bottom: tall * (i + 1) - 4 }));
    for (const m of this.moments) {
      const f = (m.time - this.scene.start) / this.scene.step;
      if (f < from || f > to) continue;
      c.strokeStyle = k.soft;
      c.setLineDash([2, 3]);
      line(c, this.x(f), 14, this.x(f), this.height - 18);
    }
    c.setLineDash([]);
    this.nameMoments(c);
    for (const one of this.rows) this.drawRow(c, one, attempts);
    this.drawAxis(c);
  }

  /** Names over the dotted lines, to the right or to the left; where there is room for few, the important ones. */
  nameMoments(c) {
    const taken = [], order = ["contact", "closest", "trigger", "alarm", "min_ttc"];
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = this.colours.soft;
    c.textAlign = "left";
    for (const m of [...this.moments].sort((a, b) => order.indexOf(a.key) - order.indexOf(b.key))) {
      const f = (m.time - this.scene.start) / this.scene.step, wide = c.measureText(m.name).width;
      if (f < this.from || f > this.to) continue;
      const free = (x) => x >= 0 && x + wide <= this.width && taken.every(([left, right]) => x + wide < left || x > right);
      const x = [this.x(f) + 2, this.x(f) - wide - 2].find(free);
      if (x === undefined) continue;
      c.fillText(m.name, x, 10);
      taken.push([x - 6, x + wide + 6]);
    }
  }

  drawRow(c, { row, top, bottom }, attempts) {
    const k = this.colours, [low, high] = this.range(row, attempts);
    const y = (v) => bottom - ((v - low) / (high - low)) * (bottom - top);
    c.font = "11px system-ui, sans-serif";
    c.strokeStyle = k.line;
    c.fillStyle = k.soft;
    c.lineWidth = 1;
    for (const tick of ticks(low, high)) {
      line(c, EDGE.left, y(tick), this.width - EDGE.right, y(tick));
      c.textAlign = "right";
      c.fillText(signed(tick, tick % 1 ? 1 : 0), EDGE.left - 5, y(tick) + 4);
    }
    const mark = row.line === "threshold" ? this.threshold : row.line;
    if (mark !== undefined && mark !== null) {
      c.strokeStyle = k.soft;
      line(c, EDGE.left, y(mark), this.width - EDGE.right, y(mark));
    }
    c.save();
    c.beginPath();
    c.rect(EDGE.left, top - 1, this.width - EDGE.left - EDGE.right, bottom - top + 2);
    c.clip();
    for (const a of [...attempts].reverse()) {
      for (const name of row.names) this.curve(c, a, name, y, row.names.length > 1);
    }
    c.restore();
    c.textAlign = "left";
    c.fillStyle = k.ink;
    c.font = "600 12px system-ui, sans-serif";
    c.fillText(row.title, EDGE.left + 4, top - 3);
    let x = EDGE.left + 14 + c.measureText(row.title).width;
    for (const who of row.names.length > 1 ? ["ego", "adversary"] : []) {
      c.fillStyle = k[`${who}-text`];
      c.fillText(who, x, top - 3);
      x += c.measureText(who).width + 10;
    }
  }

  curve(c, attempt, name, y, pair) {
    if (!attempt.curve) return;
    const k = this.colours;
    c.strokeStyle = pair ? (name.startsWith("ego") ? k.ego : k.adversary) : attempt.key === "best" ? k.ink : k[attempt.key] || k.first;
    c.lineWidth = attempt.key === "best" ? 2 : 1.7;
    c.setLineDash(DASHES[attempt.key] || [7, 4]);
    c.beginPath();
    let on = false;
    for (let f = Math.max(this.from, attempt.curve.first); f <= this.to; f++) {
      const value = valueAt(attempt, name, f);
      if (value === null) { on = false; continue; }
      if (on) c.lineTo(this.x(f), y(value)); else c.moveTo(this.x(f), y(value));
      on = true;
    }
    c.stroke();
    c.setLineDash([]);
  }

  range(row, attempts) {
    let low = row.free ? Infinity : row.least ?? -2, high = row.free ? -Infinity : row.most ? Math.min(row.most, 4) : row.least === 0 ? 5 : 2;
    for (const a of attempts) {
      for (const name of row.names) {
        for (let f = this.from; f <= this.to; f++) {
          const v = valueAt(a, name, f);
          if (v === null) continue;
          low = Math.min(low, row.least ?? v);
          high = Math.max(high, row.most ? Math.min(v, row.most) : v);
        }
      }
    }
    if (row.free && !(high - low > 1e-9)) return Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
    return row.free ? [low, high + 0.04 * (high - low)] : [low, high * 1.04];
  }

  drawAxis(c) {
    const k = this.colours, start = this.scene.start, step = this.scene.step;
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = k.soft;
    c.textAlign = "center";
    for (const t of ticks(start + this.from * step, start + this.to * step, Math.max(3, Math.floor(this.width / 90)))) {
      c.fillText(`${Math.round(t * 10) / 10} s`, Math.min(this.x((t - start) / step), this.width - 16), this.height - 4);
    }
  }

  /** Draw the cursor at a frame. */
  drawCursor(frame) {
    const c = this.cursorCanvas.getContext("2d"), x = Math.round(this.x(frame)) + 0.5;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    c.strokeStyle = this.colours.accent;
    c.lineWidth = 2;
    line(c, x, 12, x, this.height - 16);
  }
}

function line(c, x1, y1, x2, y2) {
  c.beginPath();
  c.moveTo(x1, y1);
  c.lineTo(x2, y2);
  c.stroke();
}

/** Round numbers from low to high, about `most` of them. */
function ticks(low, high, most = 3) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough) || rough, found = [];
  for (let t = Math.ceil(low / step - 1e-9) * step; t <= high + 1e-9; t += step) found.push(t);
  return found;
}
