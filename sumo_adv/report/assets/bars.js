const BINS = [[0, 0, "0 (contact)"], [0, 0.5, "to 0.5 s"], [0.5, 1, "to 1 s"], [1, 2, "to 2 s"], [2, 4, "to 4 s"], [4, 10, "to 10 s"], [10, Infinity, "above 10 s"]];

/** Counts of the rows by the key that a function gives. */
function counted(rows, keyOf) {
  const counts = new Map();
  for (const i of rows) counts.set(keyOf(i), (counts.get(keyOf(i)) || 0) + 1);
  return counts;
}

const binOf = (value) => (value === null ? NEVER : BINS.find(([low, high]) => (high === 0 ? value <= 0 : value > low && value <= high))[2]);

/** One histogram: rows of name, bar (and a second one), number; `act` is called with a name's key. */
function histogram(title, entries, act) {
  const most = Math.max(1, ...entries.map((e) => Math.max(e.many, e.before || 0)));
  return el("div", { class: entries.some((e) => e.before !== undefined) ? "chart pair" : "chart" }, el("h3", null, title), entries.map((e) => {
    const bar = el("i"), track = el("span", { class: "track", "aria-hidden": "true" }, bar);
    bar.style.width = `${(100 * e.many) / most}%`;
    if (e.before !== undefined) {
      const raw = el("i", { class: "raw" });
      raw.style.width = `${(100 * e.before) / most}%`;
      track.append(raw);
    }
    const button = el("button", { type: "button", disabled: !act, title: plain(e.name) }, el("span", { class: "name" }, quoted(e.name)), track,
      el("span", { class: "many" }, e.before === undefined ? String(e.many) : `${e.many} / ${e.before}`));
    if (act) button.addEventListener("click", () => act(e.key));
    return button;
  }));
}

/** All histograms of the rows shown. */
function drawBars(rows, choose) {
  const after = counted(rows, (i) => (tried(i) ? binOf(columns.min_ttc[i]) : null));
  const before = counted(rows, (i) => (tried(i) ? binOf(columns.raw_min_ttc[i]) : null));
  const bins = [...BINS.map((b) => b[2]), NEVER].map((name) => ({ name, many: after.get(name) || 0, before: before.get(name) || 0 }));
  const came = counted(rows, (i) => classes[i]), intents = counted(rows, (i) => columns.intent[i]), egos = counted(rows, (i) => columns.ego[i]);
  const severities = counted(rows, (i) => columns.severity[i]);
  const sorted = (counts) => [...counts].sort((a, b) => b[1] - a[1]).slice(0, 12).map(([key, many]) => ({ key, name: key || "none", many }));
  byId("bars").replaceChildren(
    histogram("Result", CLASSES.map((c) => ({ key: c.key, name: `${c.sign} ${c.words}`, many: came.get(c.key) || 0 })), (key) => choose("outcome", key)),
    histogram("min TTC, attacked / unattacked", bins, null), histogram("Intent", sorted(intents), (key) => choose("intent", key)),
    histogram("Severity", SEVERITIES.map((name) => ({ key: name, name, many: severities.get(name) || 0 })), (key) => choose("severity", key)),
    histogram("Ego", sorted(egos), (key) => choose("ego", key)));
}
