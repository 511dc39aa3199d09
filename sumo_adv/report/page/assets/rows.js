const NEVER = "never";
const CODED = ["network", "ego", "intent", "ending"];

/** The columns as functions of a row's number. */
const columns = data.columns, total = data.page.length;
const cell = (name, i) => (CODED.includes(name) ? columns[name].kinds[columns[name].of[i]] : columns[name][i]);

/** What an episode came to, the worst first: a key, its words, its sign on the map. */
const CLASSES = [
  { key: "valid", words: "valid collision", sign: "●" }, { key: "collision", words: "collision, not valid", sign: "■" },
  { key: "critical", words: "critical, no contact", sign: "▲" }, { key: "calm", words: "not critical", sign: "○" },
  { key: "failed", words: "failed", sign: "✕" },
];

function classOf(i) {
  if (columns.failure[i]) return "failed";
  if (columns.collided[i]) return columns.valid[i] ? "valid" : "collision";
  return columns.critical[i] ? "critical" : "calm";
}

const classes = Array.from({ length: total }, (_, i) => classOf(i));
const haystack = Array.from({ length: total }, (_, i) =>
  [columns.id[i], cell("network", i), cell("ego", i), cell("intent", i), cell("ending", i), columns.failure[i]].join("\n").toLowerCase());

/** The numbers of the rows that pass a filter, in the order of a column. */
function selected(filter, order) {
  const rows = [];
  for (let i = 0; i < total; i++) {
    if (filter.search && !haystack[i].includes(filter.search)) continue;
    if (filter.network && cell("network", i) !== filter.network) continue;
    if (filter.intent && cell("intent", i) !== filter.intent) continue;
    if (filter.ego && cell("ego", i) !== filter.ego) continue;
    if (filter.outcome && classes[i] !== filter.outcome) continue;
    if (filter.valid && { true: "yes", false: "no" }[columns.valid[i]] !== filter.valid && !(filter.valid === "none" && columns.valid[i] === null)) continue;
    if (filter.most !== null && !(columns.min_ttc[i] !== null && columns.min_ttc[i] <= filter.most)) continue;
    rows.push(i);
  }
  if (order.name === null) return rows;
  const rank = order.name === "class" ? (i) => CLASSES.findIndex((c) => c.key === classes[i]) : (i) => cell(order.name, i);
  const keys = new Map(rows.map((i) => [i, rank(i)]));
  return rows.sort((a, b) => compare(keys.get(a), keys.get(b)) * order.sign || a - b);
}

/** Numbers by size, words by the alphabet; what is never comes behind every number. */
function compare(a, b) {
  const none = (v) => v === null || v === undefined || v === "";
  if (none(a) || none(b)) return Number(none(a)) - Number(none(b));
  return typeof a === "string" ? (a < b ? -1 : a > b ? 1 : 0) : Number(a) - Number(b);
}
