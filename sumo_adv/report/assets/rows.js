const NEVER = "never";

/** The columns by name, values in the order of the rows; those of few values come as places among `kinds`. */
const columns = {}, kinds = {}, total = data.page.length;
for (const [name, values] of Object.entries(data.columns)) {
  if (!Array.isArray(values)) kinds[name] = values.kinds;
  columns[name] = Array.isArray(values) ? values : values.of.map((k) => values.kinds[k]);
}

/** What an episode came to, the worst first: a key, its words, its sign on the map. */
const CLASSES = [
  { key: "serious", words: "serious collision", sign: "◆" }, { key: "strict", words: "strict collision", sign: "●" },
  { key: "valid", words: "valid collision", sign: "◉" }, { key: "collision", words: "collision, not valid", sign: "■" },
  { key: "critical", words: "critical, no contact", sign: "▲" }, { key: "calm", words: "not critical", sign: "○" },
  { key: "failed", words: "failed", sign: "✕" },
];

function classOf(i) {
  if (columns.failure[i]) return "failed";
  if (columns.collided[i]) return ["serious", "strict"].includes(columns.level[i]) ? columns.level[i] : columns.valid[i] ? "valid" : "collision";
  return columns.critical[i] ? "critical" : "calm";
}

const classes = Array.from({ length: total }, (_, i) => classOf(i));
const haystack = Array.from({ length: total }, (_, i) =>
  ["id", "network", "ego", "intent", "ending", "failure", "relation", "road", "preventable_by", "cause", "cause_sentence", "fault"].map((name) => columns[name][i]).join("\n").toLowerCase());

/** Whether a collision that counts has a delta-v of the ego below 1 mph, and nobody on foot or on two wheels is hit. */
const nearTouch = (i) => ["serious", "strict", "valid"].includes(classes[i]) && columns.delta_v[i] !== null && columns.delta_v[i] < 0.447 && columns.impact_speed[i] === null;

/** The default order: by what it came to, near-touches behind all collisions that count; robust and humanlike ones first among equals. */
const ranks = Array.from({ length: total }, (_, i) => {
  const level = CLASSES.findIndex((c) => c.key === classes[i]), good = Number(columns.robust[i] === true) + Number(columns.humanlike[i] === true);
  return (nearTouch(i) ? 2.5 + level / 10 : level) * 10 + 2 - good;
});

/** The numbers of the rows that pass a filter, in the order of a column. */
function selected(filter, order) {
  const rows = [];
  for (let i = 0; i < total; i++) {
    if (filter.search && !haystack[i].includes(filter.search)) continue;
    if (filter.network && columns.network[i] !== filter.network) continue;
    if (filter.intent && columns.intent[i] !== filter.intent) continue;
    if (filter.ego && columns.ego[i] !== filter.ego) continue;
    if (filter.outcome && classes[i] !== filter.outcome) continue;
    if (filter.valid && { true: "yes", false: "no" }[columns.valid[i]] !== filter.valid && !(filter.valid === "none" && columns.valid[i] === null)) continue;
    if (filter.severity && columns.severity[i] !== filter.severity) continue;
    if (["humanlike", "robust"].some((name) => filter[name] && columns[name][i] !== (filter[name] === "yes"))) continue;
    if (["fault", "red_light", "right_of_way"].some((name) => filter[name] && columns[name][i] !== filter[name])) continue;
    if (filter.touch && nearTouch(i) !== (filter.touch === "yes")) continue;
    if (filter.most !== null && !(columns.min_ttc[i] !== null && columns.min_ttc[i] <= filter.most)) continue;
    rows.push(i);
  }
  if (order.name === null) return rows.sort((a, b) => compare(ranks[a], ranks[b]) || a - b);
  const keys = order.name === "class" ? classes.map((key) => CLASSES.findIndex((c) => c.key === key)) : columns[order.name];
  return rows.sort((a, b) => compare(keys[a], keys[b]) * order.sign || a - b);
}

/** Numbers by size, words by the alphabet; what is never comes behind every number. */
function compare(a, b) {
  const noA = a === null || a === "", noB = b === null || b === "";
  if (noA || noB) return Number(noA) - Number(noB);
  return typeof a === "string" ? (a < b ? -1 : a > b ? 1 : 0) : Number(a) - Number(b);
}
