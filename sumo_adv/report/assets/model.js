const ABSENT = -1e6;  // in hundredths: not there, or never
const CURVES = ["ttc", "gap", "ego_speed", "ego_acceleration", "adversary_speed", "adversary_acceleration"];

/** The scene unpacked: attempts with vehicles on the grid of frames, curves, lanes. Metres from the origin, rad. */
async function unpack(scene) {
  const columns = new Columns(await inflated(scene.blob));
  const attempts = scene.attempts.map((a) => ({
    ...a, vehicles: a.vehicles.map(([id, role, length, width, segments]) => ({
      id, role, length, width, segments: segments.map(([first, count]) => ({ first, count })),
    })),
  }));
  for (const [name, unit] of [["x", 0.01], ["y", 0.01], ["heading", 0.001]]) {
    for (const a of attempts) for (const v of a.vehicles) for (const s of v.segments) s[name] = columns.next(s.count, 2, unit);
  }
  for (const a of attempts) {
    if (!a.curves) continue;
    a.curve = { first: a.curves[0], count: a.curves[1] };
    for (const name of CURVES) a.curve[name] = columns.next(a.curves[1], 1, 0.01);
  }
  const lanes = scene.lanes.map(([count, width, kind]) => ({ count, width, kind, x: null, y: null }));
  const markings = scene.markings.map(([count, kind]) => ({ count, kind }));
  const stops = scene.stops.map(([kind, light, links]) => ({ count: 2, kind, light: light < 0 ? null : scene.lights[light], links }));
  for (const lines of [lanes, markings, stops]) {
    for (const axis of ["x", "y"]) for (const line of lines) line[axis] = columns.next(line.count, 1, 0.01);
  }
  const plans = scene.plans.map(([frame, count]) => ({ frame, count }));
  for (const axis of ["x", "y"]) for (const plan of plans) plan[axis] = columns.next(plan.count, 1, 0.01);
  addNotes(scene, attempts[0], plans);
  for (const a of attempts.slice(1)) prepend(a, attempts[0]);
  const [best] = attempts, helpers = new Set();
  for (const v of best.vehicles) if (v.role === "adversary" && v.id !== best.adversary) helpers.add(v.id);
  for (const a of attempts) {
    const helps = (v) => (a.key === "raw" ? helpers.has(v.id) : v.role === "adversary" && v !== a.adversaryVehicle);
    a.egoVehicle = a.vehicles.find((v) => v.id === a.ego) || null;
    a.adversaryVehicle = a.vehicles.find((v) => v.id === a.adversary) || null;
    a.supports = a.vehicles.filter(helps);
    a.others = a.vehicles.filter((v) => v !== a.egoVehicle && v !== a.adversaryVehicle && !a.supports.includes(v));
  }
  return { ...scene, attempts, lanes, markings, stops, plans };
}

/** What the driver noted, as curves of the attempt that counts: each value holds until its next answer. */
function addNotes(scene, best, plans) {
  if (!best.curve) return;
  for (const [name, values] of scene.notes) {
    const curve = new Float64Array(best.curve.count).fill(ABSENT * 0.01);
    plans.forEach(({ frame }, i) => {
      const next = i + 1 < plans.length ? plans[i + 1].frame : frame + 1;
      for (let f = frame; f < next; f++) {
        const at = f - best.curve.first;
        if (values[i] !== null && at >= 0 && at < curve.length) curve[at] = values[i];
      }
    });
    best.curve[`note ${name}`] = curve;
  }
}

/** The plan that the driver had at a frame; null where it showed none. */
function planAt(plans, frame) {
  let found = null;
  for (const plan of plans) if (plan.count && plan.frame <= frame + 1e-6) found = plan;
  return found;
}

/** Give an attempt what it shares with the one that counts: all frames up to its own first. */
function prepend(attempt, base) {
  const own = new Map(attempt.vehicles.map((v) => [v.id, v]));
  const only = attempt.key === "first" ? new Set([attempt.ego, attempt.adversary]) : null;
  for (const v of base.vehicles) {
    if (only && !only.has(v.id)) continue;
    const before = v.segments.filter((s) => s.first <= attempt.from).map((s) => head(s, attempt.from - s.first + 1));
    if (!before.length) continue;
    const mine = own.get(v.id);
    if (!mine) { attempt.vehicles.push({ ...v, segments: before }); continue; }
    const last = before[before.length - 1], next = mine.segments[0];
    if (last.first + last.count === next.first) before.push(joined(before.pop(), mine.segments.shift()));
    mine.segments = [...before, ...mine.segments];
  }
}

const head = (s, most) => {
  const count = Math.min(s.count, most);
  return { first: s.first, count, x: s.x.slice(0, count), y: s.y.slice(0, count), heading: s.heading.slice(0, count) };
};

function joined(a, b) {
  const turn = Math.round((a.heading[a.count - 1] - b.heading[0]) / (2 * Math.PI)) * 2 * Math.PI;
  const both = (name, shift) => {
    const out = new Float64Array(a.count + b.count);
    out.set(a[name]);
    for (let i = 0; i < b.count; i++) out[a.count + i] = b[name][i] + shift;
    return out;
  };
  return { first: a.first, count: a.count + b.count, x: both("x", 0), y: both("y", 0), heading: both("heading", turn) };
}

/** Where a vehicle is at a frame (any real number) into `out`; false if it is not there. */
function pose(vehicle, frame, out) {
  for (const s of vehicle.segments) {
    const at = frame - s.first;
    if (at < 0 || at > s.count - 1) continue;
    const i = Math.floor(at), j = Math.min(i + 1, s.count - 1), part = at - i;
    out.x = s.x[i] + (s.x[j] - s.x[i]) * part;
    out.y = s.y[i] + (s.y[j] - s.y[i]) * part;
    out.heading = s.heading[i] + (s.heading[j] - s.heading[i]) * part;
    return true;
  }
  return false;
}

/** What a light shows at a frame, a letter for each of its connections; empty where it was not recorded. */
function stateAt([frames, states], frame) {
  let shown = "";
  for (let i = 0; i < frames.length && frames[i] <= frame + 1e-6; i++) shown = states[i];
  return shown;
}

/** A curve's value at a frame; null where there is none. */
function valueAt(attempt, name, frame) {
  const c = attempt.curve, i = c ? Math.round(frame) - c.first : -1;
  return c && c[name] && i >= 0 && i < c.count && c[name][i] > ABSENT * 0.01 + 1 ? c[name][i] : null;
}
