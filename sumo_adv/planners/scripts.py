"""Compile a script to a planner: its numbers become the table of parameters, its actions the table ``SCRIPT``.

The texts below step through ``SCRIPT``: one of vehicles, and one of pedestrians and cyclists, with the same conditions.
They are shipped, so scripts answer without the sandbox (``sessions.py:TRUSTED``). What they remember from call to call
are notes: the number of the last action that began, when it began, and since when the vehicle has stood; a pedestrian
or cyclist also remembers its way.
"""

from __future__ import annotations

from sumo_adv.datatypes import LibraryEntry, Planner
from sumo_adv.planners.text import make_planner
from sumo_adv.script import Action, Script, Verb, numbers_of

SCRIPT_MODE = "script"
SCRIPT_ORIGIN = "script"
UNITS = {"speed": "m/s", "rate": "m/s2", "seconds": "s", "offset": "m"}
CONDITION_UNITS = {"time": "s", "distance_to_ego": "m", "ahead_of_ego": "m", "time_to_meet": "s"}

_STEPS_TEXT = """\
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


"""
_CONDITIONS_TEXT = '''\
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


'''
_DRIVING_TEXT = '''\
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


'''
_NUMBERS_TEXT = '''\
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


'''
_LANES_TEXT = '''\
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
_STEPS_TEXT += _CONDITIONS_TEXT + _DRIVING_TEXT + _NUMBERS_TEXT + _LANES_TEXT
_WALK_TEXT = (
    """\
import math

GENTLE = 2.0  # m/s2, of a stop


def endpoint(bv, ego, road, parameters, acc, horizon):
    done, since, stands, chosen = -1, 0.0, bv["time"], -1
    if bv["last"] is not None and "note_action" in bv["last"]:
        done, since, stands = int(bv["last"]["note_action"]), bv["last"]["note_since"], bv["last"]["note_stands"]
        chosen = int(bv["last"]["note_way"])
    if bv["speed"] > 0.3:
        stands = bv["time"]
    stood = bv["time"] - max(since, stands)
    meets = first_across(road)
    while done + 1 < len(SCRIPT) and begins(SCRIPT[done + 1], done, since, stood, bv, ego, road, meets, parameters):
        done, since, stood = done + 1, bv["time"], 0.0
        if SCRIPT[done][0] == "walk" and chosen < 0:
            chosen = way_across(bv, road)
        if SCRIPT[done][0] == "back":
            chosen = place_to_turn(bv, road, chosen)
    way = way_of(chosen, road)
    here, speed = bv["travelled"], bv["speed"]
    pace = pace_of(done, road, parameters)
    goal = goal_of(done, way, here, road, parameters)
    rate = 2.0 if bv["length"] < 1.2 else 1.2
    soon = max(speed, min(pace, speed + 0.5 * rate))  # when it is asked again
    if done >= 0 and SCRIPT[done][0] == "wait" or pace < 0.05:
        end = spot(way, here + speed * speed / (2 * GENTLE), 0.0, clip(speed / GENTLE, 0.8, 20.0), road)
    elif turns(chosen) and here < way["turn"][1]:
        begins_at, ends_at = way["turn"]
        slow = 0.4 if bv["length"] < 1.2 else 2.0
        place = max(here + 1.2 * slow, ends_at + 0.3)
        time = (place - max(here, begins_at)) / slow + max(begins_at - here, 0.0) / max(pace, slow)
        end = spot(way, place, slow, clip(time, 0.8, 20.0), road)
    elif goal is not None and goal - here < 0.25 * (speed + soon) + soon * soon / (2 * GENTLE):
        left = max(goal - here, 0.0)
        time = clip(left / max(speed / 2, 0.6 * min(pace, left), 0.02), 0.8, 20.0)
        end = spot(way, max(goal, here), 0.0, time, road)
    else:
        distance, then = advanced(speed, pace, 1.5, rate)
        end = spot(way, here + distance, then, 1.5, road)
    end["note_action"] = float(done)
    end["note_since"] = since
    end["note_stands"] = stands
    end["note_way"] = float(chosen)
    return end


"""
    + _CONDITIONS_TEXT
    + """\
def ended(done, since, stood, bv, road, parameters):
    \"\"\"Whether the last action that began has ended.\"\"\"
    row = SCRIPT[done]
    if row[0] == "wait":
        return stood > number(row[1], parameters) - 0.01
    if row[0] == "speed":
        return abs(bv["speed"] - min(number(row[1], parameters), road["fastest"])) < 0.3
    if since == bv["time"]:
        return False
    chosen = int(bv["last"]["note_way"])
    way = way_of(chosen, road)
    if row[0] == "back":
        return turns(chosen) and bv["travelled"] > way["turn"][1] - 0.1
    place = place_of(done, way, bv["travelled"], road, parameters)
    return place - bv["travelled"] < (0.25 if stops(done) else 0.25 * bv["speed"] + 0.1)


def stops(done):
    \"\"\"Whether it stands still where the last action leads: not if it goes on at once.\"\"\"
    if done + 1 == len(SCRIPT):
        return True
    return SCRIPT[done + 1][3] != "after" or SCRIPT[done + 1][0] == "wait" or SCRIPT[done + 1][0] == "back"


def pace_of(done, road, parameters):
    \"\"\"The speed at which it goes.\"\"\"
    pace = road["start"]["speed"]
    for row in SCRIPT[: done + 1]:
        if row[0] == "walk":
            pace = number(row[2], parameters)
        elif row[0] == "speed":
            pace = number(row[1], parameters)
    return min(pace, road["fastest"])


def goal_of(done, way, here, road, parameters):
    \"\"\"How far along its way it stands still; None if it goes on.\"\"\"
    last = -1
    for i in range(done + 1):
        if SCRIPT[i][0] == "walk" and (stops(i) or i < done and SCRIPT[i + 1][0] == "wait"):
            last = i
        elif SCRIPT[i][0] == "walk" or SCRIPT[i][0] == "back" or SCRIPT[i][0] == "speed" and SCRIPT[i][3] == "after":
            last = -1
    return None if last < 0 else place_of(last, way, here, road, parameters)


def place_of(index, way, here, road, parameters):
    \"\"\"How far along its way an action leads. Where it is to turn round next, it is just before such a place.\"\"\"
    place = station_at(way, number(SCRIPT[index][1], parameters), here, road)
    if index + 1 < len(SCRIPT) and way["movement"] != "back":
        for row in SCRIPT[index + 1 :]:
            if row[0] == "walk":
                return place
            if row[0] == "back":
                near = [each["turn"][0] - 0.1 for each in ways_back(road) if abs(each["turn"][0] - place) < 1.0]
                best = place
                for each in near:
                    if best == place or abs(each - place) < abs(best - place):
                        best = each
                return max(best, here)
    return place


def advanced(speed, pace, time, rate):
    \"\"\"The distance within a time, and the speed then: evenly to the wanted speed, then at that.\"\"\"
    span = min(time, abs(pace - speed) / rate)
    then = speed + rate * span if pace > speed else speed - rate * span
    return (speed + then) / 2 * span + then * (time - span), then


"""
    + _NUMBERS_TEXT
    + """\
def ways_back(road):
    \"\"\"All ways that turn back.\"\"\"
    back = [way for way in road["ways"] if way["movement"] == "back"]
    return back + road["turns"] if "turns" in road else back


def way_of(chosen, road):
    \"\"\"The way of a number: from 100 on one that turns back, below 0 the first one.\"\"\"
    return ways_back(road)[chosen - 100] if chosen >= 100 else road["ways"][max(chosen, 0)]


def turns(chosen):
    \"\"\"Whether it has chosen to turn round.\"\"\"
    return chosen >= 100


def first_across(road):
    \"\"\"The first way that crosses the ego's way.\"\"\"
    for i in range(len(road["ways"])):
        conflict = road["ways"][i]["conflict"]
        if conflict is not None and conflict["kind"] == "crossing":
            return i
    return len(road["ways"]) - 1


def way_across(bv, road):
    \"\"\"The first way across that has not turned yet.\"\"\"
    last = first_across(road)
    for i in range(last, len(road["ways"])):
        way = road["ways"][i]
        if way["movement"] == "back":
            return last
        if way["conflict"] is not None:
            last = i
            there = spot(way, bv["travelled"] + 0.5, 0.0, 1.0, road)
            x, y = offset((bv["x"], bv["y"], bv["heading"]), 0.5, 0.0)
            near = math.sqrt((there["x"] - x) ** 2 + (there["y"] - y) ** 2) < 0.3
            if near or i == first_across(road) and bv["speed"] < 0.3 and bv["travelled"] < 0.3:
                return i
    return last


def place_to_turn(bv, road, chosen):
    \"\"\"The way that turns back next; without one, the way that it is on.\"\"\"
    soonest = bv["travelled"] + bv["speed"] * bv["speed"] / (2 * GENTLE) - 0.02
    back = ways_back(road)
    best = chosen
    for i in range(len(back)):
        if back[i]["turn"][0] >= soonest and (best < 100 or back[i]["turn"][0] < back[best - 100]["turn"][0]):
            best = 100 + i
    return best


def aside(x, y, road):
    \"\"\"The offset from the ego's way, to the left, measured where the first way across meets it.\"\"\"
    conflict = road["ways"][first_across(road)]["conflict"]
    line = road["ego_centreline"]
    i = int(clip(conflict["ego_distance"] / 2.0 if conflict is not None else 0.0, 0.0, len(line) - 2.0))
    a = line[i]
    b = line[i + 1]
    dx, dy = b[0] - a[0], b[1] - a[1]
    return (dx * (y - a[1]) - dy * (x - a[0])) / max(math.sqrt(dx * dx + dy * dy), 0.01)


def station_at(way, left, first, road):
    \"\"\"How far along a way, from a place on, the offset from the ego's way is; that place if it is nowhere.\"\"\"
    here = spot(way, first, 0.0, 1.0, road)
    before = aside(here["x"], here["y"], road) - left
    station = first
    for k in range(30):
        there = spot(way, station + 2.0, 0.0, 1.0, road)
        after = aside(there["x"], there["y"], road) - left
        if before * after <= 0.0 and before != after:
            return station + 2.0 * before / (before - after)
        before = after
        station += 2.0
    return first


def spot(way, station, speed, time, road):
    \"\"\"A place on the way, of which one point every 2 m is known. Before and after a half turn it is straight.\"\"\"
    line = way["centreline"]
    last = len(line) - 1
    u = station / 2.0
    i = int(clip(u, 0.0, last - 1.0))
    j = i + 1
    if way["movement"] == "back":
        if station >= way["turn"][1]:
            i = min(int(way["turn"][1] / 2.0) + 1, last - 1)
            j = last
        else:
            straight = road["ways"][first_across(road)]
            line = straight["centreline"]
            i = int(clip(u, 0.0, len(line) - 2.0))
            j = i + 1
    a = line[i]
    b = line[j]
    w = (u - i) / (j - i)
    heading = math.atan2(b[1] - a[1], b[0] - a[0])
    x, y = a[0] + (b[0] - a[0]) * w, a[1] + (b[1] - a[1]) * w
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
"""
)


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
    walks = script.user != "vehicle"
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
        if action.verb is Verb.WALK_TO and action.speed is None:
            named["speed"] = repr(script.pace(action))
        rows.append(f"    ({', '.join(_row(action, named))}),\n")
    text = (
        f'# {script.label}, mode "{SCRIPT_MODE}"\nPARAMETERS = {{\n{"".join(table)}}}\n\n'
        f"SCRIPT = [\n{''.join(rows)}]\n\n{_WALK_TEXT if walks else _STEPS_TEXT}"
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
        case Verb.WALK_TO:
            return '"walk"', named["offset"], named["speed"], *when
        case Verb.TURN_BACK:
            return '"back"', "0.0", "0.0", *when
        case Verb.SPEED | Verb.BRAKE:
            return f'"{action.verb}"', named["speed"], named["rate"], *when


def _unit(action: Action, key: str) -> str:
    """Return the unit of a number of an action."""
    return CONDITION_UNITS[action.when.kind] if key == "value" and action.when is not None else UNITS[key]
