const REACHED = ["critical", "collision", "valid", "strict", "serious"], SEVERITIES = ["negligible", "minor", "moderate", "severe"];

const percent = (rate) => `${(100 * rate).toFixed(0)} %`;

/** A rate with a bar, its interval as a line over it, and both in words. */
function rateCell([value, low, high]) {
  const bar = el("i"), range = el("b");
  bar.style.width = `${100 * value}%`;
  range.style.left = `${100 * low}%`;
  range.style.width = `${100 * (high - low)}%`;
  return el("td", null, el("span", { class: "rate", "aria-hidden": "true" }, bar, range), `${percent(value)} `,
    el("span", { class: "soft" }, `${(100 * low).toFixed(0)}–${(100 * high).toFixed(0)}`));
}

/** A table of the egos: what share of their episodes reached each level, and how severe the valid collisions were. */
function egosTable() {
  const heads = ["ego", "episodes", ...REACHED, "failed", "valid collisions by severity", "delta-v, median"];
  const rows = data.egos.map((e) => el("tr", null, el("th", { scope: "row" }, quoted(e.ego || "none")), el("td", null, e.episodes),
    e.reached.map(rateCell), rateCell(e.failed),
    el("td", null, SEVERITIES.map((name, k) => (e.severity[k] ? `${e.severity[k]} ${name}` : null)).filter(Boolean).join(", ") || "none"),
    el("td", null, e.delta_v === null ? "–" : `${e.delta_v.toFixed(1)} m/s`)));
  byId("egos").replaceChildren(el("thead", null, el("tr", null, heads.map((h) => el("th", { scope: "col" }, h)))), el("tbody", null, rows));
}
