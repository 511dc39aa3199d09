"""Compile a script to a planner: its numbers become the table of parameters, its actions the table ``SCRIPT``.

The text below steps through ``SCRIPT``. It is shipped, so scripts answer without the sandbox (``sessions.py:TRUSTED``).
What it remembers from call to call are notes: the number of the last action that began, when it began, and since when
the vehicle has stood.
"""

from __future__ import annotations

from sumo_adv.datatypes import LibraryEntry, Planner
from sumo_adv.planners.text import make_planner
from sumo_adv.script import Action, Script, Verb, numbers_of

SCRIPT_MODE = "script"
SCRIPT_ORIGIN = "script"
UNITS = {"speed": "m/s", "rate": "m/s2", "seconds": "s", "offset": "m"}
CONDITION_UNITS = {"time": "s", "distance_to_ego": "m", "ahead_of_ego": "m", "time_to_meet": "s"}

_STEPS_TEXT = '''\
import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    index = find_way(road)
    way = road["ways"][index]
    done, since, stands = -1, 0.0, bv["time"]
    if bv["last"] is not None and "note_action" in bv["last"]:
        done, since, stands = int(bv["last"]["note_action"]), bv["last"]["note_since"], bv["last"]["note_stands"]
    if bv["speed"] > 0.3:
        stands = bv["time"]
    stood = bv["time"] - max(since, stands)
    while done + 1 < len(SCRIPT) and begins(SCRIPT[done + 1], done, since, stood, bv, ego, road, index, parameters):
        done, since, stood = done + 1, bv["time"], 0.0
    aside, drift = sideways(done, road, parameters)
    time = 1.5
    if abs(aside - bv["offset"]) > 0.3 and bv["lateral_time"] < 0.1 or begun_sideways(done, since, bv):
        time = drift
    distance, speed = advanced(done, bv["speed"], time, road, parameters)
    end = beside(way, bv["travelled"] + distance, aside, speed, time)
    if bv["travelled"] + distance > 2.0 * (len(way["centreline"]) - 1) and abs(bv["relative_heading"]) < 0.5:
        end = beside_ego(ego, bv["ahead"] + distance, bv["left"] + aside - bv["offset"], speed, time)
    end["note_action"] = float(done)
    end["note_since"] = since
    end["note_stands"] = stands
    return end


def begins(row, done, since, stood, bv, ego, road, index, parameters):
    """Whether the condition of the next action holds."""
    kind = row[3]
    if kind == "after":
        return done < 0 or ended(done, since, stood, bv, road, parameters)
    value = number(row[4], parameters)
    if kind == "time":
        return bv["time"] > value - 0.01
    if kind == "nearer":
        return apart(bv, ego) < value
    if kind == "farther":
        return apart(bv, ego) > value
    if kind == "ahead":
        return bv["ahead"] - (bv["length"] + ego["length"]) / 2 > value
    if kind == "behind":
        return bv["ahead"] - (bv["length"] + ego["length"]) / 2 < value
    if kind == "sooner":
        return meets_in(bv, ego, road, index) < value
    return meets_in(bv, ego, road, index) > value


def ended(done, since, stood, bv, road, parameters):
    """Whether the last action that began has ended."""
    row = SCRIPT[done]
    if row[0] == "speed":
        return abs(bv["speed"] - min(number(row[1], parameters), road["fastest"])) < 0.5
    if row[0] == "brake":
        return bv["speed"] < number(row[1], parameters) + 0.3
    if row[0] == "stop":
        return stood > number(row[1], parameters) - 0.01
    if row[0] == "wait":
        return bv["time"] > since + number(row[1], parameters) - 0.01
    if row[0] == "turn":
        return abs(wrap(bv["heading"] - road["start"]["heading"])) > 0.785
    aside, drift = sideways(done, road, parameters)
    return abs(bv["offset"] - aside) < 0.3 and bv["lateral_time"] < 0.3


def begun_sideways(done, since, bv):
    """Whether a move sideways begins now."""
    return done >= 0 and since == bv["time"] and SCRIPT[done][0] in ("lane", "offset")


def sideways(done, road, parameters):
    """The offset from its way that it wants to have, and how long moving there takes."""
    lanes = 0
    stray = 0.0
    drift = 3.0
    for row in SCRIPT[: done + 1]:
        if row[0] == "lane":
            lanes += int(row[1])
            stray = 0.0
            drift = number(row[2], parameters)
        elif row[0] == "offset":
            stray = number(row[1], parameters)
            drift = number(row[2], parameters)
    return middle_of(lanes, road) + stray, drift


def middle_of(lanes, road):
    """The offset of the middle of the lane so many to the left, or of the last one where there are fewer."""
    side = 1.0 if lanes > 0 else -1.0
    beside_it = sorted([side * each["offset"] for each in road["sides"] if side * each["offset"] > 0.0])
    count = min(abs(lanes), len(beside_it))
    return side * beside_it[count - 1] if count else 0.0


def advanced(done, speed, time, road, parameters):
    """The distance within a time, and the speed then: evenly to the wanted speed, then at that."""
    wanted, rate = road["start"]["speed"], 2.0
    for row in SCRIPT[: done + 1]:
        if row[0] in ("speed", "brake"):
            wanted, rate = min(number(row[1], parameters), road["fastest"]), number(row[2], parameters)
            if row[0] == "brake":
                wanted = min(wanted, speed)
        elif row[0] == "stop":
            wanted, rate = 0.0, number(row[2], parameters)
    span = min(time, abs(wanted - speed) / max(rate, 0.1))
    then = speed + rate * span if wanted > speed else max(speed - rate * span, 0.0)
    return (speed + then) / 2 * span + then * (time - span), then


def number(value, parameters):
    """A number of the script: itself, or the parameter of that name."""
    return parameters[value] if isinstance(value, str) else value


def apart(bv, ego):
    """The distance of the two boxes, as if both were turned the ego's way."""
    ahead = max(abs(bv["ahead"]) - (bv["length"] + ego["length"]) / 2, 0.0)
    left = max(abs(bv["left"]) - (bv["width"] + ego["width"]) / 2, 0.0)
    return math.sqrt(ahead * ahead + left * left)


def meets_in(bv, ego, road, index):
    """Seconds until the ego is where their ways meet; without such a place, the gap by the speed at which it closes."""
    if road["ways"][index]["conflict"] is not None:
        return ego["arrivals"][index] if ego["arrivals"][index] >= 0.0 else 1000.0
    closing = ego["speed"] - bv["speed_along"]
    if bv["ahead"] < 0.0:
        closing = -closing
    gap = max(abs(bv["ahead"]) - (bv["length"] + ego["length"]) / 2, 0.0)
    return min(gap / closing, 1000.0) if closing > 0.01 else 1000.0


def find_way(road):
    """The way of the script's turn, otherwise straight on; where there is none, the first."""
    movement = "straight"
    for row in SCRIPT:
        if row[0] == "turn":
            movement = "left" if row[1] > 0 else "right"
    for i, way in enumerate(road["ways"]):
        if way["movement"] == movement:
            return i
    return 0


def beside(way, station, left, speed, time):
    """A point beside the way's centreline (one point every 2 m)."""
    line = way["centreline"]
    u = clip(station / 2.0, 0.0, len(line) - 1.001)
    i = int(u)
    w = u - i
    a = line[i]
    b = line[i + 1]
    heading = math.atan2(b[1] - a[1], b[0] - a[0])
    x, y = offset((a[0] + (b[0] - a[0]) * w, a[1] + (b[1] - a[1]) * w, heading), 0.0, left)
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}


def beside_ego(ego, ahead, left, speed, time):
    """A point beside the ego's predicted path, straight on past its end."""
    path = ego["path"]
    for i in range(len(path) - 1):
        a = path[i]
        b = path[i + 1]
        step = math.sqrt((b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        if step > 0.05 and ahead <= step:
            w = ahead / step
            heading = a[3] + wrap(b[3] - a[3]) * w
            x, y = offset((a[1] + (b[1] - a[1]) * w, a[2] + (b[2] - a[2]) * w, heading), 0.0, left)
            return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
        ahead -= step
    end = path[len(path) - 1]
    x, y = offset(end[1:4], ahead, left)
    return {"x": x, "y": y, "heading": end[3], "speed": speed, "time": time}
'''


def script_entry(script: Script) -> LibraryEntry:
    """Return the intent of a script with its only planner.

    Args:
        script: The script.
    """
    return LibraryEntry(script.label, script.description, script.applies, (script_planner(script),), "generated")


def script_planner(script: Script) -> Planner:
    """Compile a script to a planner.

    Args:
        script: The script.
    """
    table, rows = [], []
    for k, action in enumerate(script.actions):
        named: dict[str, str] = {}
        for key, number in numbers_of(action).items():
            named[key] = repr(number.default)
            if number.low < number.high:
                name = f"{action.verb}_{k + 1}_{'when' if key == 'value' else key}"
                values = f"{number.default!r}, {number.low!r}, {number.high!r}, {_unit(action, key)!r}"
                table.append(f'    "{name}": ({values.replace(chr(39), chr(34))}, "{key} of action {k + 1}"),\n')
                named[key] = f'"{name}"'
        rows.append(f"    ({', '.join(_row(action, named))}),\n")
    text = (
        f'# {script.label}, mode "{SCRIPT_MODE}"\nPARAMETERS = {{\n{"".join(table)}}}\n\n'
        f"SCRIPT = [\n{''.join(rows)}]\n\n{_STEPS_TEXT}"
    )
    return make_planner(script.label, SCRIPT_MODE, text, SCRIPT_ORIGIN)


def _row(action: Action, named: dict[str, str]) -> tuple[str, ...]:
    """Return the row of an action: verb, two numbers, the kind of its condition, and the value of that."""
    when = '"after"', "0.0"
    if action.when is not None and action.when.kind != "after":
        below = action.when.rule == "below"
        kind = {
            "time": "time", "distance_to_ego": "nearer" if below else "farther",
            "ahead_of_ego": "behind" if below else "ahead",
            "time_to_meet": "sooner" if below else "later",
        }[action.when.kind]  # fmt: skip
        when = f'"{kind}"', named["value"]
    side = "1.0" if action.side == "left" else "-1.0"
    match action.verb:
        case Verb.STOP_FOR:
            return '"stop"', named["seconds"], named["rate"], *when
        case Verb.LANE_CHANGE:
            return '"lane"', side, named["seconds"], *when
        case Verb.TURN:
            return '"turn"', side, "0.0", *when
        case Verb.LATERAL_OFFSET:
            return '"offset"', named["offset"], named["seconds"], *when
        case Verb.WAIT:
            return '"wait"', named["seconds"], "0.0", *when
        case Verb.SPEED | Verb.BRAKE:
            return f'"{action.verb}"', named["speed"], named["rate"], *when


def _unit(action: Action, key: str) -> str:
    """Return the unit of a number of an action."""
    return CONDITION_UNITS[action.when.kind] if key == "value" and action.when is not None else UNITS[key]
