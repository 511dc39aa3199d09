"""A figure of a hunt: how many distinct failures had been found after which time, by level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import MaxNLocator

from sumo_adv.report.figures.paper import Picture
from sumo_adv.report.figures.parts import ADVERSARY, EGO, SUPPORT

SIZE = (3.5, 2.4)  # inches: a column of an IEEE page
TEXT = 7.5  # points
COLOURS = {"valid": EGO, "strict": SUPPORT, "serious": ADVERSARY}


def draw_over_time(after: Sequence[tuple[float, Mapping[str, int]]]) -> Picture:
    """Steps that rise at the end of each round. after: minutes, and the failures by level, that or worse."""
    figure = Picture(figsize=SIZE, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    minutes = [0.0, *(time for time, _ in after)]
    for level, colour in COLOURS.items():
        counts = [0, *(found[level] for _, found in after)]
        label = level if level == "serious" else f"{level} or worse"
        axes.step(minutes, counts, where="post", color=colour, lw=1.4, marker="o", ms=2.5, label=label)
    axes.set_xlim(0.0, max(minutes[-1], 1e-3))
    axes.set_ylim(0.0, max(1.0, 1.1 * max(found["valid"] for _, found in after)))
    axes.set_xlabel("time of the hunt [min]", fontsize=TEXT)
    axes.set_ylabel("distinct failures", fontsize=TEXT)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.tick_params(labelsize=TEXT)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=TEXT, loc="upper left")
    return figure
