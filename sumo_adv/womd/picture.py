"""One picture of a conversion: the record's lanes below, SUMO's lanes over them, deviations in colour.

Colours are Okabe and Ito's, which colour-blind readers can tell apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.womd.fidelity import Fidelity, kept_lanes
from sumo_adv.womd.record import Record
from sumo_adv.womd.sumonet import SumoNet

BANDS = ((0.1, 0.5, "#F0E442"), (0.5, 1.0, "#E69F00"), (1.0, np.inf, "#D55E00"))  # m from, m to, colour
DATASET, OUTSIDE, INSIDE, EGO = "#BBD7EA", "#333333", "#009E73", "#0072B2"
WIDTH, LEAST, MOST = 14.0, 6.0, 18.0  # inches; 100 dots an inch


def draw_fidelity(target: Path, record: Record, net: SumoNet, fidelity: Fidelity) -> None:
    """Write a PNG, 1400 px wide, to ``target``. Raises OSError if the file cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = _extent(record)
    height = float(np.clip(WIDTH * (high[1] - low[1]) / (high[0] - low[0]), LEAST, MOST))
    figure = Figure(figsize=(WIDTH, height + 1.0), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.05, 0.05, 0.93, 0.86))
    lines = [points[:, :2] for points in kept_lanes(record).values()]
    _lines(axes, lines, DATASET, 5.0, f"lanes of the record ({len(lines)})")
    for internal, colour, name in ((False, OUTSIDE, "SUMO lanes"), (True, INSIDE, "SUMO lanes inside junctions")):
        _lines(axes, [a.shape for a in net.lanes.values() if a.internal == internal], colour, 0.8, name)
    for start, end, colour in BANDS:
        d = fidelity.deviations
        chosen = d.xy[(d.distance > start) & (d.distance <= end)]
        name = f"{start:g} to {end:g} m off" if np.isfinite(end) else f"over {start:g} m off"
        axes.plot(*chosen.T, "o", ms=4, color=colour, zorder=5, label=f"{name} ({len(chosen)} samples)")
    ego = record.tracks[record.sdc]
    axes.plot(ego.x[ego.valid], ego.y[ego.valid], color=EGO, lw=1.8, ls=(0, (3, 2)), zorder=4, label="ego's log")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.legend(loc="best", fontsize=9)
    figure.text(0.05, 0.96, _title(fidelity), fontsize=12, va="top", parse_math=False)
    unfinished = target.with_name(f"{target.name}.part")
    figure.savefig(unfinished, format="png", metadata={"Software": None})
    unfinished.replace(target)


def _lines(axes: Any, lines: list[Any], colour: str, width: float, name: str) -> None:
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(lines, colors=colour, linewidths=width, label=name))


def _extent(record: Record) -> tuple[Any, Any]:
    """Lower left and upper right corner of the map with a margin, m."""
    points = np.concatenate([p[:, :2] for p in kept_lanes(record).values()] or [np.zeros((1, 2))])
    return points.min(axis=0) - 10.0, points.max(axis=0) + 10.0


def _title(fidelity: Fidelity) -> str:
    r = fidelity.report
    return (
        f"{r['scenario_id']}: {r['lane_length'] / 1000:.2f} km of lanes, {100 * r['represented']:.1f} % represented; "
        f"within 0.1 m {100 * r['deviation']['within_0.1']:.2f} %, 0.5 m {100 * r['deviation']['within_0.5']:.2f} %; "
        f"connections {r['connectivity']['kept']} of {r['connectivity']['wanted']}"
    )
