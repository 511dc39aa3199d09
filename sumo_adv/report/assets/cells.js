/** Coverage: a matrix of (intent, relation) against (road, speed), and all cells as a list, empty ones first. */
class Cells {
  constructor(coverage) {
    this.cells = coverage.band.map((band, k) => ({
      k, band, intent: valueOf(coverage.intent, k), relation: valueOf(coverage.relation, k), road: valueOf(coverage.road, k),
    }));
    this.coverage = coverage;
    this.roads = ["motorway", "rural", "urban", "junction"].filter((road) => coverage.road.kinds.includes(road));
    this.bands = [...coverage.bands.keys()].filter((band) => coverage.band.includes(band));
  }

  speed(band) {
    const [low, high] = this.coverage.bands[band];
    return high === null ? `from ${low} m/s` : `${low}–${high} m/s`;
  }

  draw(ego) {
    this.counts = this.coverage.egos[ego];
    const met = this.counts.filter(([n]) => n).length, failed = this.counts.filter((c) => c[1]).length;
    byId("covered").textContent = `${met} of ${this.cells.length} cells have an encounter, ${this.cells.length - met} are empty; in ${failed} the ego failed at least once. `
      + `${this.coverage.unplaced} episodes are in no cell: they made no attempt.`;
    this.drawMatrix();
    this.drawList();
  }

  drawMatrix() {
    const byPlace = new Map(this.cells.map((c) => [`${c.intent}\n${c.relation}\n${c.road}\n${c.band}`, c]));
    const pairs = [...new Set(this.cells.map((c) => `${c.intent}\n${c.relation}`))].sort();
    const head = el("thead", null,
      el("tr", null, el("th", { scope: "col", rowspan: 2 }, "intent"), el("th", { scope: "col", rowspan: 2 }, "adversary"),
        this.roads.map((road) => el("th", { scope: "colgroup", colspan: this.bands.length, class: "first" }, road))),
      el("tr", null, this.roads.map(() => this.bands.map((band, k) => el("th", { scope: "col", class: k ? null : "first" }, this.speed(band).replace(" m/s", ""))))));
    const rows = pairs.map((pair) => {
      const [intent, relation] = pair.split("\n");
      return el("tr", null, el("th", { scope: "row" }, quoted(intent)), el("td", null, relation), this.roads.map((road) => this.bands.map((band, k) =>
        this.square(byPlace.get(`${pair}\n${road}\n${band}`), k === 0))));
    });
    byId("matrix").replaceChildren(head, el("tbody", null, rows));
  }

  square(cell, first) {
    const side = first ? " first" : "";
    if (!cell) return el("td", { class: `gone${side}`, title: "not in this campaign's domain" });
    const [n, failures] = this.counts[cell.k];
    if (!n) return el("td", { class: `empty${side}`, title: "no encounter" }, "0");
    const made = el("td", { class: `met${side}`, title: this.words(cell) }, `${failures}/${n}`);
    made.style.setProperty("--share", `${Math.round((100 * failures) / n)}%`);
    return made;
  }

  words(cell) {
    const [n, failures, low, high] = this.counts[cell.k];
    return n ? `${failures} failures in ${n}: ${percent(failures / n)}, ${(100 * low).toFixed(0)} to ${(100 * high).toFixed(0)} % (95 %)` : "no encounter";
  }

  drawList() {
    const order = this.cells.slice().sort((a, b) => this.counts[a.k][0] - this.counts[b.k][0] || this.counts[b.k][1] - this.counts[a.k][1] || a.k - b.k);
    const heads = ["intent", "adversary", "road", "ego's speed", "encounters", "failures", "rate, 95 % interval"];
    const rows = order.map((c) => {
      const [n, failures, low, high] = this.counts[c.k];
      return el("tr", { class: n ? null : "none" }, el("th", { scope: "row" }, quoted(c.intent)), el("td", null, c.relation), el("td", null, c.road), el("td", null, this.speed(c.band)),
        el("td", null, n), el("td", null, n ? failures : "–"), n ? rateCell([failures / n, low, high]) : el("td", null, "–"));
    });
    byId("cells").replaceChildren(el("thead", null, el("tr", null, heads.map((h) => el("th", { scope: "col" }, h)))), el("tbody", null, rows));
  }
}

const valueOf = (coded, k) => coded.kinds[coded.of[k]];

function startCoverage() {
  const coverage = data.coverage;
  if (!coverage) { byId("coverage").hidden = true; return; }
  const cells = new Cells(coverage), egos = Object.keys(coverage.egos);
  byId("of").replaceChildren(...egos.map((ego) => el("option", { value: ego }, ego === "all" ? "all" : plain(ego))));
  byId("of").parentElement.hidden = egos.length < 2;
  byId("of").addEventListener("change", (e) => cells.draw(e.target.value));
  cells.draw("all");
}
