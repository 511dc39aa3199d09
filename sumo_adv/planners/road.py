"""The dictionary ``road`` of a planner's call: the road around a BV, in the frame of the ego's pose at the trigger.

In left-hand traffic it is mirrored, as the frame is."""

from __future__ import annotations

from typing import Any

from sumo_adv.situation import NO_ARRIVAL, Situation, mirrored


def road_of(situation: Situation, name: str) -> dict[str, Any]:
    """The ``road`` of the BV ``name``; the keys are described in ``prompts/planner.md``."""
    target = situation.targets[name]
    frame, hand = situation.frame, situation.frame.hand
    x, y, h = frame.to_local(target.state.x, target.state.y, target.state.heading)
    ways = []
    for way in target.ways:
        entry: dict[str, Any] = {
            "movement": mirrored(way.movement, hand),
            "junction": min(way.junction, NO_ARRIVAL),
            "conflict": None,
        }
        entry["centreline"] = _points(situation, way.path)
        if way.conflict is not None:
            c = way.conflict
            cx, cy, ch = frame.to_local(c.x, c.y, c.heading)
            entry["conflict"] = {
                "kind": c.kind, "x": cx, "y": cy, "heading": ch, "bv_distance": c.bv_s, "ego_distance": c.ego_s,
                "angle": hand * c.angle,
            }  # fmt: skip
        ways.append(entry)
    return {
        "relation": target.relation, "left": hand * float(target.ways[0].ego_d[0] + target.offset),
        "lane_width": situation.road.lane_width, "ways": ways,
        "sides": [{"offset": hand * o, "kind": k} for o, k in target.sides],
        "start": {"x": x, "y": y, "heading": h, "speed": target.state.speed},
        "ego_centreline": _points(situation, situation.baseline.path), "fastest": target.fastest,
        "signals": {"bv": _signals(situation, name), "ego": _signals(situation, situation.ego.id)},
    }  # fmt: skip


def _signals(situation: Situation, vehicle: str) -> list[dict[str, Any]]:
    return [{"id": i, "distance": d, "state": s} for i, d, s in situation.traffic.signals.get(vehicle, ())]


def _points(situation: Situation, path: Any) -> list[list[float]]:
    """The first 200 m of a path as [x, y] every 2 m, in the ego's frame."""
    step = slice(0, 400, 4)
    x, y, _ = situation.frame.points_to_local(path.x[step], path.y[step], path.heading[step])
    return [[round(a, 2), round(b, 2)] for a, b in zip(x.tolist(), y.tolist(), strict=True)]
