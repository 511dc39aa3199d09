"""Fidelity reports as a table: a row a record, and what they come to together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

COLUMNS = (
    "record", "km", "kept %", "<0.1 m %", "<0.5 m %", "p99 m", "links", "signals", "inside %", "centre %", "broken",
    "junct. %", "traffic", "s",
)  # fmt: skip
LEGEND = """\
km of lanes, the share kept in SUMO, shares of samples so near to a SUMO lane, 99th percentile; connections and signal
lanes kept; logged moving vehicles inside a SUMO lane, within 1.75 m of a centre line of the record; tracks whose lanes
break in SUMO / in the record / driven; lane length inside junctions; random traffic: vehicles, collisions, teleports;
seconds to the network."""

Report = Mapping[str, Any]


def row(report: Report) -> tuple[str, ...]:
    """One record's cells; ``LEGEND`` explains them."""
    d, c, s, v, r = (report[k] for k in ("deviation", "connectivity", "signals", "vehicles", "routes"))
    t = report["traffic"]
    return (
        report["scenario_id"], f"{report['lane_length'] / 1000:.2f}", _percent(report["represented"]),
        _percent(d["within_0.1"]), _percent(d["within_0.5"]), f"{d['p99']:.3f}", f"{c['kept']}/{c['wanted']}",
        f"{s['mapped']}/{s['lanes']}", _percent(v["inside"]), _percent(v["near_centre"]),
        f"{len(r['broken'])}/{len(r['own_broken'])}/{r['driven']}", _percent(report["in_junctions"]),
        "-" if t is None else f"{t['vehicles']}/{t['collisions']}/{t['teleports']}",
        f"{report['seconds']['network']:.2f}",
    )  # fmt: skip


def totals(reports: Sequence[Report]) -> dict[str, float]:
    """All records together: shares weighted by their wholes, counts summed, the median time.

    disturbed: share of the networks tried that had a collision or a teleport in random traffic.
    """
    km = np.array([r["lane_length"] for r in reports]) / 1000.0
    samples = [r["deviation"]["samples"] for r in reports]
    states = [r["vehicles"]["states"] for r in reports]
    tried = [r["traffic"] for r in reports if r["traffic"] is not None]
    connections = sum(r["connectivity"]["wanted"] for r in reports)
    return {
        "records": len(reports), "km": float(km.sum()),
        "represented": _mean([r["represented"] for r in reports], km),
        **{
            f"{own}within_{d}": _mean([r["deviation"][f"{own}within_{d}"] for r in reports], samples)
            for own in ("", "own_")
            for d in ("0.1", "0.5")
        },
        "median_p99": float(np.median([r["deviation"]["p99"] for r in reports])),
        "connectivity": sum(r["connectivity"]["kept"] for r in reports) / connections if connections else 1.0,
        "signal_lanes": sum(r["signals"]["lanes"] for r in reports),
        "signals_mapped": sum(r["signals"]["mapped"] for r in reports),
        "inside": _mean([r["vehicles"]["inside"] for r in reports], states),
        "near_centre": _mean([r["vehicles"]["near_centre"] for r in reports], states),
        "driven": sum(r["routes"]["driven"] for r in reports),
        "broken": sum(len(r["routes"]["broken"]) for r in reports),
        "own_broken": sum(len(r["routes"]["own_broken"]) for r in reports),
        "in_junctions": _mean([r["in_junctions"] for r in reports], km),
        "median_seconds": float(np.median([r["seconds"]["network"] for r in reports])),
        "median_cpu_seconds": float(np.median([r["seconds"]["network_cpu"] for r in reports])),
        "traffic_tried": len(tried), "collisions": sum(t["collisions"] for t in tried),
        "teleports": sum(t["teleports"] for t in tried),
        "disturbed": sum(t["collisions"] + t["teleports"] > 0 for t in tried) / len(tried) if tried else 0.0,
    }  # fmt: skip


def shortfalls(report: Report) -> list[str]:
    """What a record's network does not show as the record has it, a phrase each; empty if there is nothing."""
    d, c, s, v, r = (report[k] for k in ("deviation", "connectivity", "signals", "vehicles", "routes"))
    lost, beyond = c["wanted"] - c["kept"], round((1.0 - d["within_0.5"]) * d["samples"])
    more = [track for track in r["broken"] if track not in r["own_broken"]]
    phrases = {
        f"{100 * (1.0 - report['represented']):.2f} % of lane length": report["represented"] < 0.9999,
        f"{beyond} samples beyond 0.5 m (at most {d['max']:.1f} m)": beyond > 0,
        f"{lost} connections": lost > 0,
        f"{s['lanes'] - s['mapped']} signal lanes without a link": s["mapped"] < s["lanes"],
        f"{100 * (v['near_centre'] - v['inside']):.1f} points fewer vehicles inside lanes than near a centre line":
            v["inside"] < v["near_centre"] - 0.01,
        f"tracks {more} break, in the record they do not": bool(more),
        report["sampling"]["note"]: report["sampling"]["resampled"],
    }  # fmt: skip
    events = report["traffic"]["events"] if report["traffic"] is not None else []
    return [phrase for phrase, holds in phrases.items() if holds] + list(events)


def _mean(values: Sequence[float], weights: Any) -> float:
    weights = np.asarray(weights, float)
    return float(np.average(values, weights=weights)) if weights.sum() > 0 else 1.0


def _percent(share: float) -> str:
    return f"{100 * share:.2f}"
