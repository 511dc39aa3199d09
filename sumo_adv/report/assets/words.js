const GATE_WORDS = {
  longitudinal: "braking and acceleration", lateral: "lateral acceleration", friction_circle: "friction circle",
  curvature: "curvature", jerk: "jerk", continuity: "no jumps", off_road: "on the road", third_party: "no third party hit",
};

const panel = (title, ...children) => el("section", { class: "panel", "aria-label": title }, el("h2", null, title), ...children);

function table(heads, rows) {
  const cells = (row) => row.cells.map((c, i) => el(i ? "td" : "th", i ? null : { scope: "row" }, c));
  return el("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Table" }, el("table", null,
    heads.length ? el("thead", null, el("tr", null, heads.map((h) => el("th", { scope: "col" }, h)))) : null,
    el("tbody", null, rows.map((row) => el("tr", row.counts ? { class: "counts" } : null, cells(row))))));
}

const list = (pairs) => el("dl", null, pairs.filter((p) => p[1] !== null && p[1] !== undefined)
  .map(([name, value]) => [el("dt", null, name), el("dd", null, value)]));

/** A link to a time in the replay. */
const at = (time, words) => (time === null || time === undefined ? null : el("a", { href: `#t=${time}` }, words || `${time.toFixed(2)}\u202fs`));

const knots = (a) => (Array.isArray(a) ? a.map(([t, v]) => `${v} m/s² at ${t} s`).join(", ") : `${a} m/s²`);

const ATTACKER_WORDS = { touched: "touched the ego", forced: "forced the contact", played: "attacked as well" };

/** What each of several attackers did; empty for one. */
const several = (outcome) => ((outcome.attackers || []).length > 1 ? outcome.attackers : []);

function headline(outcome) {
  const counts = (outcome.attempts || [])[outcome.best ?? -1], names = (outcome.adversaries || []).map((a) => a.id);
  const label = (counts && counts.composition) || (outcome.intent ? outcome.intent.label : null);
  byId("title").replaceChildren(...(names.length
    ? [quoted(outcome.network), " — ", quoted(label), " by ", quoted(names.join(" + "))] : [quoted(outcome.network)]).map((n) => (typeof n === "string" ? document.createTextNode(n) : n)));
  document.title = `${plain(outcome.network)} — replay`;
  byId("lead").replaceChildren(el("span", null, "Ego: ", quoted(outcome.ego.id ?? "–"), ", driven by ",
    quoted(outcome.ego.controller), `, seed ${outcome.seed}. `, quoted(outcome.reason)));
  const v = outcome.outcome, badges = [];
  if (v && v.cause) byId("lead").append(el("span", { class: "why" }, " Why: ", quoted(v.cause.sentence)));
  if (v) {
    badges.push([`level: ${answer(v.level)}`, ["valid", "strict", "serious"].includes(v.level) ? "level good" : "level"]);
    const hard = v.impact_speed == null ? `delta-v ${number(v.delta_v, 1, "m/s")}` : `hit at ${number(v.impact_speed, 1, "m/s")}`;
    if (v.severity) badges.push([`severity: ${answer(v.severity)}, ${hard}`, "level"]);
    if (v.preventable_by) badges.push([v.preventable_by.length ? `preventable by ${v.preventable_by.join(", ")}` : "no reference driver avoids it", "level"]);
    badges.push([v.collided ? "collision" : "no contact", v.collided ? "bad" : ""]);
    badges.push([`min TTC ${number(v.min_ttc, 2, "s")}`, ""]);
    for (const a of several(outcome)) badges.push([`${plain(a.id)} ${ATTACKER_WORDS[a.role]}`, a.role === "played" ? "" : "bad"]);
    badges.push([v.feasible ? "✓ feasible" : "✗ not feasible", v.feasible ? "good" : "bad"]);
    if (v.inconclusive) badges.push([`inconclusive: ${answer(v.inconclusive)}`, "bad"]);
    if (v.ego_stationary) badges.push(["the ego stood", "bad"]);
    if (v.rear_end) badges.push(["rear-end", "bad"]);
  } else badges.push([data.failed ? "failed" : answer(outcome.ending), "bad"]);
  byId("badges").replaceChildren(...badges.map(([words, kind]) => el("li", { class: kind || null }, words)));
}

function verdictPanel(outcome) {
  const v = outcome.outcome, raw = outcome.raw;
  if (!v) return panel("Verdict", el("p", null, "There was no attempt: ", quoted(outcome.reason)));
  const row = (name, before, after) => ({ cells: [name, before, after] });
  const numbers = table(["", "unattacked", "attacked"], [
    row("min TTC", raw ? number(raw.min_ttc, 2, "s") : "not run", number(v.min_ttc, 2, "s")),
    row("collided", raw ? answer(raw.collided) : "not run", answer(v.collided)),
    row("min TTC to anyone", "", number(v.min_ttc_any, 2, "s")), row("min distance", "", number(v.min_distance, 2, "m")),
    row("min PET", "", number(v.min_pet, 2, "s")), row("max DRAC", "", number(v.max_drac, 2, "m/s²")),
  ]);
  const failed = new Set(v.failed_gates), gates = data.gates.map((g) => ({ cells: [
    el("span", { class: failed.has(g) ? "bad" : "good" }, failed.has(g) ? "✗ fails" : "✓ holds"), GATE_WORDS[g] || answer(g)] }));
  const impact = v.impact, times = [["trigger", outcome.trigger_time], ["contact", v.contact_time], ["minimum TTC at", v.min_ttc_time]];
  return panel("Verdict", numbers, el("h3", null, "Gates of feasibility"), table([], gates), list([
    ["valid", answer(v.valid)], ["strict", answer(v.strict)], ["level", answer(v.level)],
    ["human", answer(v.humanlike)],
    ...several(outcome).map((a) => [plain(a.id), `${ATTACKER_WORDS[a.role]}, min TTC ${number(a.min_ttc, 2, "s")}`]),
    ["rear-end", answer(v.rear_end)], ["at fault", v.fault ? `${answer(v.fault)} (${Math.abs(impact.angle) > 0.75 * Math.PI ? "it left its side of the road" : "by nuPlan's rule"})` : null],
    ["class", v.collision_class ? answer(v.collision_class) : null],
    ["impact", impact ? `${number(impact.speed, 2, "m/s")} (ego ${number(impact.ego_speed, 2, "m/s")}, adversary ${number(impact.adversary_speed, 2, "m/s")}), ${answer(v.contact_side)} of the ego` : null],
    ["delta-v", impact ? `ego ${number(v.delta_v, 2, "m/s")}, adversary ${number(v.adversary_delta_v, 2, "m/s")}` : null],
    ...times.map(([name, time]) => [name, data.scene ? at(time) : null]), ...causeRows(v.cause),
  ]), (outcome.notes || []).map((note) => el("p", { class: "soft" }, quoted(note))));
}

/** What the cause is made of: kinds, times as links, brakings. */
function causeRows(c) {
  if (!c) return [];
  const row = (name, value, words) => [name, value === null || value === undefined ? null : words(value)];
  const time = (t) => (data.scene ? at(t) : `${t.toFixed(2)}\u202fs`), rate = (a) => number(a, 1, "m/s²");
  return [["cause", answer(c.kind)], row(`alarm of ${c.reference}`, c.alarm, time), row(`${c.reference} acts`, c.careful, time),
    row(c.action ? `the ego ${answer(c.action)} from` : "the ego reacted", c.began, time), row("mean braking", c.braking, rate), row("hardest braking", c.hardest, rate),
    row("stopped braking", c.let_go, time), row("lateral shift", c.shift, (d) => number(d, 1, "m")), row("sufficient braking", c.enough, rate)];
}

const ROLE_WORDS = { collider: "attacks", attack: "attacks as well", play: "plays a part" };

/** What was asked for: who plays which part by which script or intent, and which parts of the request hold. */
function askedPanel(outcome) {
  const asked = outcome.asked, read = asked.reading;
  const mark = (holds) => el("span", { class: holds ? "good" : "bad" }, holds ? "✓ holds" : "✗ does not hold");
  const actors = outcome.adversaries.map((a) => ({ cells: [quoted(a.id), ROLE_WORDS[a.role] || answer(a.role), quoted(a.intent), quoted(a.does ?? "")] }));
  const parts = asked.parts.map((p) => ({ cells: [quoted(p.name), mark(p.holds), quoted(p.says)] }));
  const readings = ((read && read.parts) || []).map((p) => ({ cells: [quoted(p.part), mark(p.holds), quoted(p.shown)] }));
  return panel("What was asked for", asked.words ? el("blockquote", null, quoted(asked.words)) : null,
    actors.length ? [el("h3", null, "Who does what"), table(["", "part", "by", "what it does"], actors)] : null,
    parts.length ? [el("h3", null, "Parts of the request, by rules"), table(["", "", "what the motion shows"], parts)] : null,
    readings.length ? [el("h3", null, "Parts of the request, as a model reads the motion"), table(["", "", "what the motion shows"], readings)] : null,
    asked.motion ? el("details", null, el("summary", null, "The motion in words"), el("pre", { tabindex: "0" }, plain(asked.motion))) : null);
}

function attemptsPanel(outcome) {
  const rows = outcome.attempts.map((a) => ({ counts: a.index === outcome.best, cells: [
    `${a.index + 1}${a.index === outcome.best ? " (counts)" : ""}`, el("span", null, quoted(a.composition || a.intent), " by ", quoted(a.adversaries.join(", "))),
    quoted(a.planner.mode), quoted(a.by), `${a.trigger_time.toFixed(1)}\u202fs`, number(a.min_ttc, 2, "s"), number(a.min_distance, 2, "m"),
    a.collided ? (a.valid ? "valid collision" : "collision") : answer(a.ending),
    el("span", null, quoted(a.failed_gates.map(answer).join(", ") || (a.feasible ? "" : "not feasible")), a.message ? [" ", quoted(a.message)] : null),
  ] }));
  const made = panel(`Attempts (${rows.length})`, table(["", "intent", "planner", "by", "trigger", "min TTC", "distance", "result", "remarks"], rows), parametersOf(outcome));
  made.classList.add("wide", "attempts");
  return made;
}

/** What changed between the first attempt and the one that counts, where both had the same parameters. */
function parametersOf(outcome) {
  const first = outcome.attempts[0], best = outcome.attempts[outcome.best ?? -1];
  if (!best || best === first) return null;
  const names = [...new Set([...Object.keys(first.parameters), ...Object.keys(best.parameters)])];
  const shown = (p, n) => (n in p ? String(p[n]) : "–");
  return el("details", null, el("summary", null, "Parameters: the first attempt and the one that counts"), table(["", "first", "counts"],
    [...names.map((n) => ({ cells: [quoted(n), shown(first.parameters, n), shown(best.parameters, n)] })),
      { cells: ["acceleration", knots(first.acceleration), knots(best.acceleration)] }]));
}

function analyzerPanel(outcome) {
  const agents = outcome.agents || {}, ranking = (outcome.encounter || {}).ranking || [];
  const intents = (outcome.intents || []).map((i) => [
    el("h3", null, quoted(i.label), " by ", quoted(i.bv), ` — risk ${answer(i.risk)}`), el("p", null, quoted(i.description)),
    i.reason ? el("p", { class: "soft" }, "Because: ", quoted(i.reason)) : null,
    el("p", { class: "soft" }, `Acceleration ${knots(i.acceleration)}; from ${answer(i.source)}.`)]);
  const [shown, rest] = [intents.slice(0, 3), intents.slice(3)];
  return panel("What the analyzer said", el("p", null, "Analyzer: ", quoted(agents.analyzer ?? "–"), ". ", quoted(agents.note ?? "")),
    ranking.length ? el("p", null, "Encounter: ", ranking.map((r, k) => [k ? ", " : "", quoted(r.id), ` (${answer(r.relation)}, risk ${r.risk})`])) : null,
    Object.keys(agents.analysis || {}).length ? el("details", null, el("summary", null, "Results of its samples"),
      el("pre", { tabindex: "0" }, plain(JSON.stringify(agents.analysis, null, 1)))) : null,
    shown, rest.length ? el("details", null, el("summary", null, `${rest.length} more`), rest) : null);
}

function plannersPanel() {
  if (!data.planners.length) return null;
  const versions = [...data.planners].sort((a, b) => b.counts - a.counts);
  return panel("Planners", versions.map((p) => {
    const used = p.attempts.map((n) => n + 1).join(", ");
    const head = el("summary", null, quoted(p.label), ", ", quoted(p.mode), ` — ${p.counts ? "counts; " : ""}attempts ${used}; `, quoted(p.origin));
    const source = el("details", null, el("summary", null, "Source"), el("pre", { tabindex: "0" }, plain(p.source)));
    const diff = p.diff ? el("details", { open: p.counts }, el("summary", null, p.diff.length ? "What the modifier changed" : "The modifier changed nothing"), el("pre", { tabindex: "0" },
      p.diff.map((text) => el("span", { class: { "+": "added", "-": "removed", "@": "hunk" }[text[0]] || null }, text)))) : null;
    return el("details", { open: p.counts }, head, el("p", { class: "soft" }, `Version ${p.hash.slice(0, 12)}`,
      p.parent ? [", made from ", p.parent.slice(0, 12)] : null), diff, source);
  }));
}

function restPanel(outcome) {
  const figures = Object.entries(outcome.realism || {}).filter(([, v]) => typeof v === "number" || v === null);
  const versions = data.about.versions ? Object.entries(data.about.versions).map(([k, v]) => `${k} ${v}`).join(", ") : null;
  return panel("All the figures", figures.length ? el("details", null, el("summary", null, "Realism of the adversary's motion"),
    table(["", ""], figures.map(([k, v]) => ({ cells: [answer(k), v === null ? "too few data" : String(v)] })))) : null,
  el("details", null, el("summary", null, "outcome.json"), el("pre", { tabindex: "0" }, plain(JSON.stringify(outcome, null, 1)))),
  el("details", null, el("summary", null, "Settings"), el("pre", { tabindex: "0" }, plain(JSON.stringify(data.about.settings, null, 1) ?? "unknown"))),
  versions ? el("p", { class: "soft" }, quoted(versions)) : null);
}

/** Everything in words. */
function writeWords() {
  const outcome = data.outcome;
  headline(outcome);
  if (data.back) {
    byId("back").hidden = false;
    byId("back").append(el("a", { href: data.back }, "All episodes"));
  }
  byId("beside").replaceChildren(verdictPanel(outcome));
  byId("panels").replaceChildren(...[outcome.asked ? askedPanel(outcome) : null, outcome.attempts.length ? attemptsPanel(outcome) : null,
    (outcome.intents || []).length ? analyzerPanel(outcome) : null, plannersPanel(), restPanel(outcome)].filter(Boolean));
}
