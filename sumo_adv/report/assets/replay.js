const LEAD = 3, OPENS = 1.5, SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const reduced = window.matchMedia("(prefers-reduced-motion: reduce)");

/** Holds the time and what is shown; draws when something has changed. */
class Player {
  constructor(scene) {
    this.scene = scene;
    this.shown = new Set(scene.attempts.map((a) => a.key));
    this.moments = data.moments;
    const trigger = data.outcome.trigger_time ?? (data.outcome.encounter || {}).time;
    this.trigger = trigger === null || trigger === undefined ? 0 : this.frameOf(trigger);
    scene.triggerFrame = Math.max(0, this.trigger);
    this.whole = false;
    this.playing = false;
    this.speed = 1;
    this.map = new MapView(byId("road"), byId("map"), scene);
    this.charts = new Charts(byId("curves"), byId("cursor"), scene, this.moments, (data.about.settings || {}).critical_ttc ?? null);
    this.cells = [];
    this.setWindow();
    this.frame = Math.max(this.from, Math.min(this.trigger, this.to));
  }

  frameOf(time) { return (time - this.scene.start) / this.scene.step; }

  timeOf(frame) { return this.scene.start + frame * this.scene.step; }

  attempts() { return this.scene.attempts.filter((a) => this.shown.has(a.key)); }

  setWindow() {
    this.to = this.scene.frames - 1;
    this.from = this.whole ? 0 : Math.max(0, Math.min(this.to, Math.round(this.trigger - LEAD / this.scene.step)));
    const scrub = byId("scrub");
    scrub.min = this.from;
    scrub.max = this.to;
    this.frame = Math.min(Math.max(this.frame ?? this.from, this.from), this.to);
    this.stale = true;
  }

  fit() {
    const all = this.scene.attempts, own = all.filter((a) => a.key !== "raw" || all.length === 1);
    this.map.fit(own, Math.max(this.from, Math.floor(this.trigger)), this.to, this.attempts());
    this.redraw();
  }

  /** Begin shortly before the contact, or the closest approach, with the two vehicles as large as the map allows. */
  open() {
    const point = ["contact", "closest", "min_ttc"].map((key) => this.moments.find((m) => m.key === key)).find(Boolean);
    if (!point) {
      this.fit();
      if (this.map.view.scale < 1) { this.map.view.scale = 3; this.setFollow(true); }
      return;
    }
    const at = this.frameOf(point.time);
    this.frame = Math.min(Math.max(Math.round(at - OPENS / this.scene.step), this.from), this.to);
    this.map.fit(this.scene.attempts.slice(0, 1), this.frame, Math.ceil(at), this.attempts());
    this.redraw();
  }

  seek(frame) {
    const wanted = Math.round(frame * 1000) / 1000;
    if (wanted < this.from && !this.whole) this.setWhole(true);
    this.frame = Math.min(Math.max(wanted, this.from), this.to);
    this.redraw();
  }

  jump(time) { this.pause(); this.seek(this.frameOf(time)); }

  step(frames) { this.pause(); this.seek(Math.round(this.frame) + frames); }

  setWhole(on) {
    this.whole = on;
    byId("whole").setAttribute("aria-pressed", on);
    this.setWindow();
    this.redraw();
  }

  setFollow(on) {
    this.map.follow = on;
    this.map.offset = { x: 0, y: 0 };
    byId("follow").setAttribute("aria-pressed", on);
    this.redraw();
  }

  setSpeed(speed) {
    this.speed = speed;
    byId("speed").value = String(speed);
  }

  toggle(key, on) {
    if (!on && this.shown.size === 1) return;
    if (on) this.shown.add(key); else this.shown.delete(key);
    this.stale = true;
    this.redraw();
  }

  play() {
    if (this.playing) return;
    if (this.frame >= this.to) this.frame = this.from;
    this.playing = true;
    this.last = null;
    this.sayState();
    requestAnimationFrame((now) => this.tick(now));
  }

  pause() {
    this.playing = false;
    this.sayState();
  }

  sayState() {
    byId("play").textContent = this.playing ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  }

  /** One picture while playing: real time passes, at the chosen speed. */
  tick(now) {
    if (!this.playing) return;
    if (this.last !== null) this.frame += (Math.min(now - this.last, 250) / 1000 / this.scene.step) * this.speed;
    this.last = now;
    if (this.frame >= this.to) { this.frame = this.to; this.pause(); }
    this.draw();
    if (this.playing) requestAnimationFrame((next) => this.tick(next));
  }

  /** Draw soon, once. */
  redraw() {
    if (this.playing || this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  draw() {
    const shown = this.attempts(), frame = reduced.matches && this.playing ? Math.round(this.frame) : this.frame;
    if (this.stale) { this.charts.draw(shown, this.from, this.to); this.buildNow(shown); this.stale = false; }
    this.map.draw(shown, frame);
    this.charts.drawCursor(frame);
    this.tell(Math.round(frame), frame);
  }

  /** The clock and the values at the cursor; texts are only touched when they change. */
  tell(step, frame) {
    const time = this.timeOf(frame), since = time - this.timeOf(this.trigger);
    const words = `${time.toFixed(2)} s (trigger ${since < 0 ? "−" : "+"} ${Math.abs(since).toFixed(2)} s)`;
    if (this.said !== words) {
      this.said = words;
      byId("clock").textContent = words;
      byId("scrub").value = String(Math.round(frame));
      byId("scrub").setAttribute("aria-valuetext", words);
    }
    if (step === this.toldStep) return;
    this.toldStep = step;
    for (const { cell, attempt, name, digits } of this.cells) {
      const own = step < (attempt.key === "best" ? 0 : attempt.from) ? this.scene.attempts[0] : attempt;
      const value = valueAt(own, name, Math.min(step, attempt.to)), text = value === null ? "–" : signed(value, digits);
      if (cell.textContent !== text) cell.textContent = text;
    }
  }

  buildNow(attempts) {
    const heads = [["ttc", "TTC [s]", 2], ["gap", "distance [m]", 2], ["ego_speed", "ego [m/s]", 1], ["adversary_speed", "adversary [m/s]", 1],
      ["ego_acceleration", "ego [m/s²]", 1], ["adversary_acceleration", "adversary [m/s²]", 1],
      ...this.scene.notes.map(([name]) => [`note ${name}`, name, 2])];
    this.cells = [];
    const rows = attempts.map((a) => el("tr", null, el("th", { scope: "row" }, a.name), heads.map(([name, , digits]) => {
      const cell = el("td", null, "");
      this.cells.push({ cell, attempt: a, name, digits });
      return cell;
    })));
    byId("now").replaceChildren(el("thead", null, el("tr", null, el("th", { scope: "col" }, "at the cursor"), heads.map((h) => el("th", { scope: "col" }, h[1])))), el("tbody", null, rows));
    this.toldStep = null;
  }

  resize() {
    this.map.resize();
    this.charts.resize();
    this.stale = true;
    if (this.playing) return;
    this.draw();
  }
}

/** Buttons, fields and links. */
function connect(player) {
  const on = (id, kind, act) => byId(id).addEventListener(kind, act);
  on("play", "click", () => (player.playing ? player.pause() : player.play()));
  on("earlier", "click", () => player.step(-1));
  on("later", "click", () => player.step(1));
  on("scrub", "input", (e) => { player.pause(); player.seek(Number(e.target.value)); });
  on("speed", "change", (e) => player.setSpeed(Number(e.target.value)));
  on("layout", "change", (e) => setBeside(player, e.target.value === "beside"));
  on("follow", "click", () => player.setFollow(!player.map.follow));
  on("in", "click", () => { player.map.zoom(1.3); player.redraw(); });
  on("out", "click", () => { player.map.zoom(1 / 1.3); player.redraw(); });
  on("fit", "click", () => { player.setFollow(false); player.fit(); });
  on("whole", "click", () => player.setWhole(!player.whole));
  for (const a of player.scene.attempts) {
    const box = el("input", { type: "checkbox", checked: true, id: `show-${a.key}` });
    box.addEventListener("change", () => { player.toggle(a.key, box.checked); box.checked = player.shown.has(a.key); });
    byId("attempts").append(el("label", null, box, el("span", { class: `swatch ${a.key}` }), a.name));
  }
  for (const m of player.moments) byId("moments").append(el("a", { href: `#${m.key}` }, m.name), el("span", { class: "soft" }, `${m.time.toFixed(2)} s`));
  document.addEventListener("click", (e) => {
    const link = e.target.closest && e.target.closest('a[href^="#"]');
    if (!link || link.classList.contains("skip") || !goTo(player, link.getAttribute("href"))) return;
    e.preventDefault();
    try { history.replaceState(null, "", link.getAttribute("href")); } catch { /* inside a frame without an address */ }
    byId("map").scrollIntoView({ block: "nearest" });
  });
  window.addEventListener("hashchange", () => goTo(player, location.hash));
  new ResizeObserver(() => player.resize()).observe(byId("map"));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => player.resize());
}

/** Follow an address: #t=12.3 or a moment's key. */
function goTo(player, address) {
  const time = /^#t=(-?[0-9.]+)$/.exec(address), moment = player.moments.find((m) => `#${m.key}` === address);
  if (!time && !moment) return false;
  player.jump(moment ? moment.time : Number(time[1]));
  return true;
}

function setBeside(player, on) {
  player.map.beside = on;
  player.map.drawn = "";
  byId("layout").value = on ? "beside" : "over";
  player.fit();
}

/** Drag, wheel and pinch on the map; click and drag in the curves. */
function connectPointers(player) {
  const map = byId("map"), curves = byId("curves"), down = new Map();
  map.addEventListener("pointerdown", (e) => { map.setPointerCapture(e.pointerId); down.set(e.pointerId, [e.offsetX, e.offsetY]); });
  map.addEventListener("pointermove", (e) => {
    const before = down.get(e.pointerId);
    if (!before) return;
    const now = [e.offsetX, e.offsetY];
    const other = [...down.entries()].find(([id]) => id !== e.pointerId);
    if (other) {
      const apart = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]);
      player.map.zoom(apart(now) / Math.max(apart(before), 1), (now[0] + other[1][0]) / 2, (now[1] + other[1][1]) / 2);
    }
    player.map.pan((now[0] - before[0]) / down.size, (now[1] - before[1]) / down.size);
    down.set(e.pointerId, now);
    player.redraw();
  });
  for (const kind of ["pointerup", "pointercancel"]) map.addEventListener(kind, (e) => down.delete(e.pointerId));
  map.addEventListener("wheel", (e) => { e.preventDefault(); player.map.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY); player.redraw(); }, { passive: false });
  const jump = (e) => { player.pause(); player.seek(player.charts.frameAt(e.offsetX)); };
  curves.addEventListener("pointerdown", (e) => { curves.setPointerCapture(e.pointerId); jump(e); });
  curves.addEventListener("pointermove", (e) => { if (e.buttons) jump(e); });
}

/** Keys; fields and buttons keep their own. */
function connectKeys(player) {
  const moment = (...keys) => { const m = keys.map((k) => player.moments.find((x) => x.key === k)).find(Boolean); if (m) player.jump(m.time); };
  const second = Math.round(1 / player.scene.step), redraw = () => player.redraw();
  const faster = (by) => player.setSpeed(SPEEDS[Math.min(Math.max(SPEEDS.indexOf(player.speed) + by, 0), SPEEDS.length - 1)]);
  const show = (n) => { const box = document.querySelectorAll("#attempts input")[n]; if (box) box.click(); };
  const acts = {
    ArrowLeft: (e) => player.step(e.shiftKey ? -second : -1), ArrowRight: (e) => player.step(e.shiftKey ? second : 1),
    Home: () => { player.pause(); player.seek(player.from); }, End: () => { player.pause(); player.seek(player.to); },
    t: () => moment("trigger"), h: () => moment("alarm"), c: () => moment("contact", "closest", "min_ttc"),
    f: () => player.setFollow(!player.map.follow), v: () => setBeside(player, !player.map.beside), r: () => player.setWhole(!player.whole),
    0: () => { player.setFollow(false); player.fit(); }, "+": () => { player.map.zoom(1.3); redraw(); }, "=": () => { player.map.zoom(1.3); redraw(); },
    "-": () => { player.map.zoom(1 / 1.3); redraw(); }, "<": () => faster(-1), ",": () => faster(-1), ">": () => faster(1), ".": () => faster(1),
    w: () => { player.map.pan(0, 40); redraw(); }, s: () => { player.map.pan(0, -40); redraw(); },
    a: () => { player.map.pan(40, 0); redraw(); }, d: () => { player.map.pan(-40, 0); redraw(); },
    1: () => show(0), 2: () => show(1), 3: () => show(2), " ": () => (player.playing ? player.pause() : player.play()),
  };
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const kind = e.target.tagName, range = e.target === byId("scrub");
    if (kind === "SELECT" || (kind === "INPUT" && !range && e.key === " ")) return;
    if (e.key === " " && (kind === "BUTTON" || kind === "SUMMARY" || kind === "A")) return;
    if (!range && ["ArrowLeft", "ArrowRight", "Home", "End"].includes(e.key) && e.target.closest && e.target.closest(".scroll, pre")) return;
    const act = acts[e.key.length === 1 ? e.key.toLowerCase() : e.key];
    if (!act) return;
    e.preventDefault();
    act(e);
  });
}

async function start() {
  writeWords();
  if (!data.scene) { document.querySelector("main").classList.add("words"); return null; }
  if (typeof DecompressionStream === "undefined") {
    byId("lead").append(el("strong", null, " This browser is too old to unpack the replay; use one of 2023 or later."));
    return null;
  }
  const scene = await unpack(data.scene);
  if (scene.notes.length) document.querySelector(".curves").style.height = `${420 + 105 * scene.notes.length}px`;
  byId("stage").hidden = false;
  const player = new Player(scene);
  connect(player);
  connectPointers(player);
  connectKeys(player);
  player.open();
  goTo(player, location.hash);
  player.draw();
  return player;
}

/** For tests and measurements: the player once it stands. */
window.replay = start();
