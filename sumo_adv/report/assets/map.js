const SMALL = 13;  // px: a shorter vehicle gets a ring
const SEAM = 0.1;  // m: by so much a lane is drawn wider, so that no seam shows between neighbours
const FONT = "600 12px system-ui, sans-serif";

/** The map: the road on one canvas, drawn again only when the view changes, and what moves on another. */
class MapView {
  constructor(road, moving, scene) {
    this.roadCanvas = road;
    this.canvas = moving;
    this.scene = scene;
    this.view = { x: 0, y: 0, scale: 4 };
    this.follow = false;
    this.offset = { x: 0, y: 0 };
    this.beside = false;
    this.spot = { x: 0, y: 0, heading: 0 };
    this.paths = roadPaths(scene.lanes);
    this.painted = paintPaths(scene);
    this.lit = scene.stops.filter((stop) => stop.light);
    this.drawn = "";
    this.resize();
  }

  resize() {
    sharpen(this.roadCanvas);
    Object.assign(this, sharpen(this.canvas));
    this.colours = palette();
    this.drawn = "";
  }

  /** The attempts' parts of the canvas, in CSS pixels. */
  panels(attempts) {
    const list = this.beside ? attempts : attempts.slice(0, 1);
    const stacked = this.width < 640, n = Math.max(1, list.length);
    return list.map((attempt, k) => ({
      attempt,
      left: stacked ? 0 : (this.width * k) / n, top: stacked ? (this.height * k) / n : 0,
      width: stacked ? this.width : this.width / n, height: stacked ? this.height / n : this.height,
    }));
  }

  /** Show the paths of ego and adversaries in `attempts` from `from` to `to`, as large as the panels of `shown` allow. */
  fit(attempts, from, to, shown) {
    let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    for (const a of attempts) {
      for (const v of [a.egoVehicle, a.adversaryVehicle, ...a.supports]) {
        for (let f = from; v && f <= Math.min(to, a.to); f += 1) {
          if (!pose(v, f, this.spot)) continue;
          low = [Math.min(low[0], this.spot.x), Math.min(low[1], this.spot.y)];
          high = [Math.max(high[0], this.spot.x), Math.max(high[1], this.spot.y)];
        }
      }
    }
    if (!Number.isFinite(low[0])) return;
    const box = this.panels(shown)[0] || this;
    const scale = Math.min(box.width / (high[0] - low[0] + 24), box.height / (high[1] - low[1] + 24));
    this.view = { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale: Math.min(Math.max(scale, 0.4), 14) };
    this.offset = { x: 0, y: 0 };
  }

  /** Zoom by a factor; the place under (px, py) stays where it is. */
  zoom(factor, px, py) {
    const v = this.view, scale = Math.min(Math.max(v.scale * factor, 0.2), 60);
    if (!this.follow && px !== undefined) {
      const box = this.panelAt(px, py);
      v.x += (px - box.left - box.width / 2) * (1 / v.scale - 1 / scale);
      v.y -= (py - box.top - box.height / 2) * (1 / v.scale - 1 / scale);
    }
    v.scale = scale;
  }

  panelAt(px, py) {
    const found = this.shownPanels.find((p) => px >= p.left && px < p.left + p.width && py >= p.top && py < p.top + p.height);
    return found || this.shownPanels[0] || { left: 0, top: 0, width: this.width, height: this.height };
  }

  pan(dx, dy) {
    const to = this.follow ? this.offset : this.view;
    to.x -= dx / this.view.scale;
    to.y += dy / this.view.scale;
  }

  /** Draw a frame (any real number) of the attempts that are shown. */
  draw(attempts, frame) {
    this.shownPanels = this.panels(attempts);
    const at = this.shownPanels.map((p) => this.centre(p.attempt, frame));
    this.drawRoad(at);
    this.writeScale();
    const c = this.canvas.getContext("2d");
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.shownPanels.forEach((panel, k) => {
      c.save();
      c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      c.beginPath();
      c.rect(panel.left, panel.top, panel.width, panel.height);
      c.clip();
      const ghosts = this.beside ? [] : attempts.slice(1);
      this.drawPanel(c, panel, at[k], ghosts, frame);
      c.restore();
    });
  }

  centre(attempt, frame) {
    const ego = attempt.egoVehicle;
    if (this.follow && ego && pose(ego, Math.min(frame, attempt.to), this.spot)) {
      this.view.x = this.spot.x + this.offset.x;
      this.view.y = this.spot.y + this.offset.y;
    }
    return { x: this.view.x, y: this.view.y };
  }

  drawRoad(at) {
    const key = `${this.shownPanels.length};${this.view.scale};${at.map((p) => `${p.x},${p.y}`).join(";")}`;
    if (key === this.drawn) return;
    this.drawn = key;
    const c = this.roadCanvas.getContext("2d"), k = this.colours, s = this.view.scale * this.ratio;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = k.ground;
    c.fillRect(0, 0, this.roadCanvas.width, this.roadCanvas.height);
    this.shownPanels.forEach((panel, i) => {
      const r = this.ratio;
      c.save();
      c.setTransform(1, 0, 0, 1, 0, 0);
      c.beginPath();
      c.rect(panel.left * r, panel.top * r, panel.width * r, panel.height * r);
      c.clip();
      c.setTransform(s, 0, 0, -s, (panel.left + panel.width / 2) * r - at[i].x * s, (panel.top + panel.height / 2) * r + at[i].y * s);
      this.drawSurface(c, k);
      this.drawPaint(c, k, s);
      c.restore();
    });
  }

  /** Footways, then one surface of lanes and junctions: ends of lanes reach into junctions, neighbours overlap. */
  drawSurface(c, k) {
    c.lineJoin = "round";
    c.fillStyle = k.asphalt;
    for (const { path, width, kind } of this.paths.strips) {
      c.lineCap = kind === 2 ? "butt" : "square";
      c.lineWidth = width + (kind === 2 ? 0 : SEAM);
      c.strokeStyle = kind === 2 ? k.footway : k.asphalt;
      c.stroke(path);
    }
    c.fill(this.paths.areas);
    c.lineWidth = SEAM;
    c.stroke(this.paths.areas);
  }

  /** Lines along lanes and across them; those of traffic lights are drawn with what moves. */
  drawPaint(c, k, s) {
    c.lineCap = "butt";
    c.strokeStyle = k.marking;
    c.lineWidth = Math.max(0.15, 1.1 / s);
    c.stroke(this.painted.solid);
    c.setLineDash([3, 6]);
    c.stroke(this.painted.dashed);
    c.lineWidth = Math.max(0.5, 2 / s);
    c.setLineDash([0.5, 0.4]);
    c.stroke(this.painted.giveWay);
    c.setLineDash([]);
    c.stroke(this.painted.stop);
  }

  drawPanel(c, panel, at, ghosts, frame) {
    const s = this.view.scale, k = this.colours, a = panel.attempt;
    const ox = panel.left + panel.width / 2 - at.x * s, oy = panel.top + panel.height / 2 + at.y * s;
    const place = { s, ox, oy, panel };
    const now = Math.min(frame, a.to);
    this.drawLights(c, place, now);
    this.drawTrails(c, place, [a, ...ghosts], now);
    if (a.key === "best") this.drawPlan(c, place, now);
    this.drawOthers(c, place, a, now);
    for (const g of ghosts) this.drawPair(c, place, g, Math.min(frame, g.to), true);
    this.drawPair(c, place, a, now, false);
    c.font = FONT;
    c.textAlign = "left";
    if (this.beside || ghosts.length === 0) this.label(c, a.name + (a.key === "first" ? ": ego and adversary" : "") + (frame > a.to + 0.5 ? " (ended)" : ""), panel.left + 10, panel.top + 18, k[a.key] || k.ink);
    if (panel.left > 0 || panel.top > 0) {
      c.strokeStyle = k.soft;
      c.lineWidth = 1;
      c.strokeRect(panel.left - 0.5, panel.top - 0.5, panel.width + 1, panel.height + 1);
    }
  }

  /** Stop lines at traffic lights: a part for each connection, in the colour that it has then. */
  drawLights(c, { s, ox, oy }, frame) {
    const k = this.colours;
    c.lineWidth = Math.max(0.9 * s, 3);
    for (const { light, links, x, y } of this.lit) {
      const state = stateAt(light, frame), n = links.length;
      links.forEach((link, i) => {
        const at = (part) => [ox + (x[0] + (x[1] - x[0]) * part) * s, oy - (y[0] + (y[1] - y[0]) * part) * s];
        c.strokeStyle = { r: k.stop, R: k.stop, y: k.wait, Y: k.wait, u: k.wait, g: k.go, G: k.go }[state[link]] || k.marking;
        c.beginPath();
        c.moveTo(...at(i / n));
        c.lineTo(...at((i + 1) / n));
        c.stroke();
      });
    }
  }

  /** What ego and adversaries drive, from the trigger to their attempt's end. */
  drawTrails(c, { s, ox, oy }, attempts, now) {
    for (const [n, a] of attempts.entries()) {
      for (const v of [a.egoVehicle, a.adversaryVehicle, ...a.supports]) {
        if (!v) continue;
        a.trails = a.trails || new Map();
        if (!a.trails.has(v)) a.trails.set(v, trail(v, this.scene.triggerFrame, a.to));
        c.setTransform(s * this.ratio, 0, 0, -s * this.ratio, ox * this.ratio, oy * this.ratio);
        const colour = v === a.egoVehicle ? "ego" : a.supports.includes(v) ? "support" : "adversary";
        c.strokeStyle = this.colours[colour];
        c.lineWidth = (n ? 1.3 : 2) / s;
        c.setLineDash(n ? (a.key === "raw" ? [1.5 / s, 4 / s] : [7 / s, 4 / s]) : []);
        c.globalAlpha = n ? 0.55 : 0.75;
        c.stroke(a.trails.get(v));
      }
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
  }

  /** Where the ego's driver planned to go then: a thin line with a dot at its end. */
  drawPlan(c, { s, ox, oy }, frame) {
    const plan = planAt(this.scene.plans, frame);
    if (!plan) return;
    c.strokeStyle = c.fillStyle = this.colours["ego-text"];
    c.lineWidth = 2.5;
    c.setLineDash([2, 3]);
    c.beginPath();
    for (let i = 0; i < plan.count; i++) c.lineTo(ox + plan.x[i] * s, oy - plan.y[i] * s);
    c.stroke();
    c.setLineDash([]);
    c.beginPath();
    c.arc(ox + plan.x[plan.count - 1] * s, oy - plan.y[plan.count - 1] * s, 3.5, 0, 2 * Math.PI);
    c.fill();
  }

  drawOthers(c, { s, ox, oy, panel }, attempt, frame) {
    const p = this.spot, margin = 12 * s;
    c.beginPath();
    for (const v of attempt.others) {
      if (!pose(v, frame, p)) continue;
      const x = ox + p.x * s, y = oy - p.y * s;
      if (x < panel.left - margin || x > panel.left + panel.width + margin || y < panel.top - margin || y > panel.top + panel.height + margin) continue;
      const fx = Math.cos(p.heading) * s, fy = -Math.sin(p.heading) * s, l = v.length / 2, w = v.width / 2;
      outline(c, v, x, y, fx, fy);
      if (v.role === "obstacle" || onFoot(v)) continue;
      corner(c, x, y, fx, fy, l * 0.15, w * 0.7, true);
      corner(c, x, y, fx, fy, l * 0.75, 0);
      corner(c, x, y, fx, fy, l * 0.15, -w * 0.7);
      c.closePath();
    }
    c.fillStyle = this.colours.other;
    c.fill("evenodd");
  }

  /** Ego and adversaries: filled with an arrow and a name, or as outlines of another attempt. */
  drawPair(c, { s, ox, oy }, a, frame, ghost) {
    const k = this.colours, p = this.spot, names = [];
    const supports = a.supports.map((v) => [v, k.support, "support"]);
    for (const [v, colour, word] of [...supports, [a.adversaryVehicle, k.adversary, "adversary"], [a.egoVehicle, k.ego, "ego"]]) {
      if (!v || !pose(v, frame, p)) continue;
      const x = ox + p.x * s, y = oy - p.y * s, fx = Math.cos(p.heading) * s, fy = -Math.sin(p.heading) * s;
      const l = v.length / 2, w = v.width / 2;
      c.beginPath();
      outline(c, v, x, y, fx, fy);
      c.lineWidth = ghost ? 1.6 : Math.min(1.4, 0.2 * s);
      c.setLineDash(ghost ? (a.key === "raw" ? [2, 3] : [6, 3]) : []);
      c.strokeStyle = ghost ? colour : k.ink;
      if (ghost) { c.stroke(); c.setLineDash([]); continue; }
      c.fillStyle = colour;
      c.fill();
      c.stroke();
      c.beginPath();
      if (word === "ego") {  // an arrow; the adversary has two bars: told apart without colour
        corner(c, x, y, fx, fy, l * 0.2, w * 0.7, true);
        corner(c, x, y, fx, fy, l * 0.85, 0);
        corner(c, x, y, fx, fy, l * 0.2, -w * 0.7);
      } else if (!onFoot(v)) {
        for (const [b, f] of [[0.35, 0.6], [-0.2, 0.05]]) {
          corner(c, x, y, fx, fy, l * b, w * 0.75, true);
          corner(c, x, y, fx, fy, l * f, 0);
          corner(c, x, y, fx, fy, l * b, -w * 0.75);
          corner(c, x, y, fx, fy, l * (b - 0.2), -w * 0.75);
          corner(c, x, y, fx, fy, l * (f - 0.2), 0);
          corner(c, x, y, fx, fy, l * (b - 0.2), w * 0.75);
          c.closePath();
        }
      }
      c.fillStyle = k.paper;
      c.fill();
      if (v.length * s < SMALL) ring(c, word, x, y, colour);
      names.push({ word, colour: k[`${word}-text`], x, y, reach: Math.max(Math.abs(fy) * l + Math.abs(fx) * w, v.length * s < SMALL ? SMALL * 0.6 : 0) });
    }
    this.namePair(c, names);
  }

  /** The names of ego and adversary over the upper and under the lower of the two. */
  namePair(c, names) {
    c.font = FONT;
    c.textAlign = "center";
    names.sort((a, b) => a.y - b.y).forEach(({ word, colour, x, y, reach }, n) => {
      this.label(c, word, x, n === names.length - 1 ? y + reach + 15 : y - reach - 7, colour);
    });
  }

  label(c, text, x, y, colour) {
    c.lineWidth = 4;
    c.lineJoin = "round";
    c.strokeStyle = this.colours.paper;
    c.strokeText(text, x, y);
    c.fillStyle = colour;
    c.fillText(text, x, y);
  }

  /** The scale, under the map. */
  writeScale() {
    const s = this.view.scale, metres = [500, 200, 100, 50, 20, 10, 5, 2].find((m) => m * s <= this.width / 4) || 1;
    const words = `${metres} m`, bar = byId("scale");
    if (bar.textContent !== words) bar.textContent = words;
    bar.style.width = `${metres * s}px`;
  }
}

/** Around what is too small to be seen: a circle for the ego, a square on its tip for the adversary. */
function ring(c, word, x, y, colour) {
  c.beginPath();
  if (word === "ego") c.arc(x, y, SMALL / 2, 0, 7);
  else for (const [dx, dy] of [[0, -1], [1, 0], [0, 1], [-1, 0]]) c.lineTo(x + dx * SMALL * 0.6, y + dy * SMALL * 0.6);
  c.closePath();
  c.lineWidth = 2;
  c.strokeStyle = colour;
  c.stroke();
}

const PERSON = 1.2;  // m: what is no longer and no wider is a pedestrian

function onFoot(v) {
  return Math.max(v.length, v.width) <= PERSON;
}

/** A box, or a circle of its size for a pedestrian. */
function outline(c, v, x, y, fx, fy) {
  const l = v.length / 2, w = v.width / 2;
  if (onFoot(v)) {
    const r = Math.max(l, w) * Math.hypot(fx, fy);
    c.moveTo(x + r, y);
    c.arc(x, y, r, 0, 2 * Math.PI);
  } else {
    corner(c, x, y, fx, fy, l, w, true);
    corner(c, x, y, fx, fy, l, -w);
    corner(c, x, y, fx, fy, -l, -w);
    corner(c, x, y, fx, fy, -l, w);
  }
  c.closePath();
}

function corner(c, x, y, fx, fy, along, left, first) {
  const px = x + fx * along + fy * left, py = y + fy * along - fx * left;
  if (first) c.moveTo(px, py); else c.lineTo(px, py);
}

/** A vehicle's way over some frames, in metres. */
function trail(vehicle, from, to) {
  const path = new Path2D(), at = { x: 0, y: 0, heading: 0 };
  let on = false;
  for (let f = from; f <= to; f++) {
    if (!pose(vehicle, f, at)) { on = false; continue; }
    if (on) path.lineTo(at.x, at.y); else path.moveTo(at.x, at.y);
    on = true;
  }
  return path;
}

/** The paint as paths in metres: what is drawn alike together. */
function paintPaths({ markings, stops }) {
  const painted = { solid: new Path2D(), dashed: new Path2D(), stop: new Path2D(), giveWay: new Path2D() };
  const add = (path, line) => { for (let i = 0; i < line.count; i++) i ? path.lineTo(line.x[i], line.y[i]) : path.moveTo(line.x[i], line.y[i]); };
  for (const line of markings) add(line.kind ? painted.dashed : painted.solid, line);
  for (const line of stops) if (!line.light) add(line.kind === 1 ? painted.giveWay : painted.stop, line);
  return painted;
}

/** Lanes as paths in metres, those of one width and kind together; the areas of junctions as one. */
function roadPaths(lanes) {
  const groups = new Map(), areas = new Path2D();
  for (const lane of lanes) {
    const key = `${lane.kind} ${lane.width}`;
    if (lane.kind !== 3 && !groups.has(key)) groups.set(key, { path: new Path2D(), width: lane.width, kind: lane.kind });
    const path = lane.kind === 3 ? areas : groups.get(key).path;
    for (let i = 0; i < lane.count; i++) i ? path.lineTo(lane.x[i], lane.y[i]) : path.moveTo(lane.x[i], lane.y[i]);
    if (lane.kind === 3) path.closePath();
  }
  return { areas, strips: [...groups.values()].sort((a, b) => b.kind - a.kind) };
}
