"""Draw the picture of a sweep: where drivers pass and fail over one or two parameters of an attack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sumo_adv.datatypes import Floats
from sumo_adv.report.figures import CURVE_SIZE_IN, CURVE_TEXT_PT, Picture

PASSES, FAILS, UNKNOWN = 0.0, 1.0, 2.0
"""The results of a point. It is unknown if the adversary could not drive these values, or if there was no encounter."""
PASS_COLOUR, FAIL_COLOUR, UNKNOWN_COLOUR = "#c9e3c4", "#eea58f", "#dddddd"
LINES = (("black", "-"), ("#0072b2", "--"), ("#6a3d9a", ":"), ("#b15928", "-."))


def draw_sweep(title: str, labels: Sequence[str], values: Sequence[Floats], drivers: Mapping[str, Floats]) -> Picture:
    """Draw a sweep: the first driver as coloured cells with its border, the other drivers as borders.

    With one axis, each driver is a row of cells.

    Args:
        title: The title of the picture.
        labels: The labels of the one or two axes.
        values: The values along each axis, ``(n,)``.
        drivers: The results at the points by driver, ``(n,)``, or ``(n, n)`` with the first axis first.

    Returns:
        The picture.
    """
    width, height = CURVE_SIZE_IN
    figure = Picture(
        figsize=(width, height * (1.15 if len(values) > 1 else 0.55)), facecolor="white", layout="constrained"
    )
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = ListedColormap([PASS_COLOUR, FAIL_COLOUR, UNKNOWN_COLOUR])
    tested = f"{next(iter(drivers))} " if len(values) > 1 else ""
    keys: list[Patch | Line2D] = [
        Patch(facecolor=colour, edgecolor="black", lw=0.4, label=f"{tested}{word}")
        for colour, word in ((PASS_COLOUR, "passes"), (FAIL_COLOUR, "fails"), (UNKNOWN_COLOUR, "untested"))
    ]
    if len(values) == 1:
        table = np.array(list(drivers.values()))
        axes.pcolormesh(values[0], np.arange(len(drivers)), table, cmap=colours, vmin=0, vmax=2, shading="nearest")
        axes.set_yticks(np.arange(len(drivers)), list(drivers))
        axes.invert_yaxis()
    else:
        first = next(iter(drivers.values()))
        axes.pcolormesh(*values, first.T, cmap=colours, vmin=0, vmax=2, shading="nearest")
        for (driver, results), (colour, style) in zip(drivers.items(), LINES, strict=False):
            known = np.ma.masked_equal(results.T, UNKNOWN)
            if known.count() and known.min() < known.max():
                axes.contour(*values, known, levels=[0.5], colors=colour, linestyles=style, linewidths=1.3)
            keys.append(Line2D([], [], color=colour, ls=style, lw=1.3, label=f"border of {driver}"))
        axes.set_ylabel(labels[1], fontsize=CURVE_TEXT_PT)
    axes.set_xlabel(labels[0], fontsize=CURVE_TEXT_PT)
    axes.set_title(title, fontsize=CURVE_TEXT_PT, loc="left", parse_math=False)
    axes.tick_params(labelsize=CURVE_TEXT_PT)
    figure.legend(handles=keys, loc="outside lower center", ncols=2, fontsize=CURVE_TEXT_PT - 1, frameon=False)
    return figure
