const ROW = 33, OVER = 12;  // px of a row with its line; rows kept beyond the visible ones
const DRAWN = CLASSES.filter((c) => c.key !== "failed");
const SECONDS = (v) => (v === null ? NEVER : v.toFixed(2));
const YES = (v) => (v === null ? "–" : v ? "yes" : "no");
const HEADS = [
  { name: "network", words: "network", wide: "wide" }, { name: "ego", words: "ego", wide: "middle" }, { name: "seed", words: "seed", wide: "narrow" },
  { name: "intent", words: "intent", wide: "wide" }, { name: "raw_min_ttc", words: "unattacked", wide: "narrow", show: SECONDS },
  { name: "min_ttc", words: "min TTC", wide: "narrow", show: SECONDS }, { name: "class", words: "result", wide: "wide" },
  { name: "severity", words: "severity", wide: "narrow" }, { name: "delta_v", words: "delta-v [m/s]", wide: "narrow", show: (v) => (v === null ? "–" : v.toFixed(1)) },
  { name: "humanlike", words: "human", wide: "narrow", show: YES }, { name: "robust", words: "robust", wide: "narrow", show: YES },
  { name: "fault", words: "fault", wide: "narrow" }, { name: "red_light", words: "red light", wide: "narrow" }, { name: "right_of_way", words: "right of way", wide: "narrow" },
  { name: "overlap", words: "overlap", wide: "narrow", show: (v) => (v === null ? "–" : `${Math.round(100 * v)} %`) },
  { name: "warning", words: "warning [s]", wide: "narrow", show: (v) => (v === null ? "–" : v.toFixed(1)) },
  { name: "preventable_by", words: "preventable by", wide: "wide" }, { name: "cause", words: "cause", wide: "middle", show: (v) => (v ? v.replaceAll("_", " ") : "–") },
  { name: "cause_sentence", words: "why", wide: "wide" }, { name: "relation", words: "adversary", wide: "narrow" }, { name: "road", words: "road", wide: "narrow" },
  { name: "attempts", words: "attempts", wide: "narrow" }, { name: "seconds", words: "took [s]", wide: "narrow", show: (v) => (v === null ? "–" : v.toFixed(1)) },
  ...data.varied.map((name) => ({ name, words: name.slice(4), wide: "middle" })), { name: "id", words: "id", wide: "middle" },
];

const tried = (i) => !columns.failure[i] && columns.collided[i] !== null;
const address = (i) => (data.page[i] ? `pages/${encodeURIComponent(columns.id[i])}.html` : null);

function textOf(head, i) {
  if (head.name === "class") {
    const kind = CLASSES.find((c) => c.key === classes[i]);
    return `${kind.sign} ${kind.words}${columns.failure[i] ? `: ${columns.failure[i]}` : ""}`;
  }
  if (!tried(i) && head.show === SECONDS) return "–";  // a failed run, or one without an attempt, measured nothing
  const value = columns[head.name][i];
  return head.show ? head.show(value) : value === null || value === "" ? "–" : String(value);
}

/** A row: its first cell is the link to its replay. */
function rowOf(i, place) {
  const to = address(i);
  const cells = HEADS.map((head, k) => {
    const text = quoted(textOf(head, i));
    return el(k ? "td" : "th", { scope: k ? null : "row", title: plain(textOf(head, i)) }, k === 0 && to ? el("a", { href: to }, text) : text);
  });
  const made = el("tr", { "aria-rowindex": place + 2, title: to ? null : "no replay page yet: rerun the report command" }, cells);
  if (to) made.addEventListener("click", (e) => { if (!e.target.closest("a")) location.assign(to); });
  return made;
}

/** Only the rows near the visible part stand in the document; those that stay visible are kept as they are. */
class List {
  constructor() {
    this.box = byId("list");
    this.body = byId("rows");
    this.standing = new Map();
    this.rows = [];
    this.box.addEventListener("scroll", () => this.draw(), { passive: true });
  }

  show(rows) {
    this.rows = rows;
    this.standing.clear();
    this.body.replaceChildren();
    byId("table").setAttribute("aria-rowcount", rows.length + 1);
    this.box.scrollTop = 0;
    this.draw();
  }

  draw() {
    const first = Math.max(0, Math.floor(this.box.scrollTop / ROW) - OVER);
    const last = Math.min(this.rows.length, Math.ceil((this.box.scrollTop + this.box.clientHeight) / ROW) + OVER);
    for (const [place, made] of this.standing) if (place < first || place >= last) { made.remove(); this.standing.delete(place); }
    let before = null;
    for (let place = last - 1; place >= first; place--) {
      let made = this.standing.get(place);
      if (!made) {
        made = rowOf(this.rows[place], place);
        this.standing.set(place, made);
        this.body.insertBefore(made, before);
      }
      before = made;
    }
    gap("above", first);
    gap("below", this.rows.length - last);
  }
}

function gap(id, rows) {
  const body = byId(id);
  if (!body.firstChild) body.append(el("tr", null, el("td", { colspan: HEADS.length })));
  body.firstChild.firstChild.style.height = `${rows * ROW}px`;
  body.hidden = rows === 0;
}

const CHOICES = ["network", "intent", "ego", "outcome", "valid", "severity", "humanlike", "robust", "fault", "red_light", "right_of_way", "touch"];
const filter = { search: "", most: null, ...Object.fromEntries(CHOICES.map((name) => [name, ""])) };
const order = { name: null, sign: 1 };

function fill(id, options) {
  byId(id).replaceChildren(el("option", { value: "" }, "all"), ...options.map(([value, words]) => el("option", { value }, words)));
}

function share(many, of) { return of ? `${many} (${((100 * many) / of).toFixed(1)} %)` : "0"; }

function counts(rows) {
  const came = counted(rows, (i) => classes[i]), of = (k) => came.get(k) || 0, n = rows.length;
  const valid = of("serious") + of("strict") + of("valid");
  const critical = rows.filter((i) => columns.critical[i]).length;
  return `${n} of ${total} episodes shown. Of these ${share(critical, n)} critical, ${share(valid + of("collision"), n)} collided, ${share(valid, n)} valid, ${share(of("serious"), n)} serious, ${share(of("failed"), n)} failed.`;
}

function start() {
  const list = new List(), open = (i) => { if (address(i)) location.assign(address(i)); };
  const places = new Places(byId("spots"), open);
  const refresh = () => {
    const rows = selected(filter, order);
    list.show(rows);
    byId("count").textContent = counts(rows);
    drawBars(rows, choose);
    places.draw(rows);
  };
  function choose(name, value) {
    filter[name] = filter[name] === value ? "" : value;
    byId(name).value = filter[name];
    refresh();
  }
  byId("title").replaceChildren(quoted(data.name), `: ${total} episodes`);
  document.title = `${plain(data.name)} — episodes`;
  byId("lead").textContent = `${data.page.filter(Boolean).length} have a replay page. Failed episodes stay in every denominator.`;
  for (const name of ["network", "intent", "ego", "fault", "red_light", "right_of_way"]) fill(name, kinds[name].filter(Boolean).map((v) => [v, v]));
  fill("outcome", CLASSES.map((c) => [c.key, c.words]));
  fill("severity", SEVERITIES.map((name) => [name, name]));
  for (const name of CHOICES) byId(name).addEventListener("change", (e) => { filter[name] = e.target.value; refresh(); });
  byId("search").addEventListener("input", (e) => { filter.search = e.target.value.trim().toLowerCase(); refresh(); });
  byId("most").addEventListener("input", (e) => { filter.most = e.target.value === "" ? null : Number(e.target.value); refresh(); });
  byId("reset").addEventListener("click", () => {
    Object.assign(filter, { search: "", most: null, ...Object.fromEntries(CHOICES.map((name) => [name, ""])) });
    for (const name of ["search", "most", ...CHOICES]) byId(name).value = "";
    refresh();
  });
  heads(refresh);
  startMap(places);
  egosTable();
  startCoverage();
  refresh();
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => places.draw(places.rows));
  new ResizeObserver(() => { list.draw(); places.draw(places.rows); }).observe(byId("list"));
}

function heads(refresh) {
  byId("heads").replaceChildren(...HEADS.map((head) => {
    const button = el("button", { type: "button" }, head.words), made = el("th", { scope: "col", class: head.wide, "aria-sort": "none" }, button);
    button.addEventListener("click", () => {
      order.sign = order.name === head.name ? -order.sign : 1;
      order.name = head.name;
      for (const other of byId("heads").children) other.setAttribute("aria-sort", "none");
      made.setAttribute("aria-sort", order.sign > 0 ? "ascending" : "descending");
      HEADS.forEach((h, k) => { byId("heads").children[k].firstChild.textContent = h.words + (h === head ? (order.sign > 0 ? " ▲" : " ▼") : ""); });
      refresh();
    });
    return made;
  }));
}

function startMap(places) {
  if (!data.maps.length) { byId("places").hidden = true; return; }
  const many = counted(data.map.keys(), (i) => data.map[i]);
  byId("maps").replaceChildren(...data.maps.map((m, k) => el("option", { value: k }, `${m.name.replace(/^[0-9a-f]{12}-/, "").replace(/\.net\.xml(\.gz)?$/, "")} (${many.get(k)})`)));
  byId("maps").addEventListener("change", (e) => places.choose(Number(e.target.value)));
  byId("key").replaceChildren(...DRAWN.map((c) => el("span", null, el("i", { class: `sign-${c.key}` }, c.sign), ` ${c.words}`)));
  places.choose(0);
}

start();
