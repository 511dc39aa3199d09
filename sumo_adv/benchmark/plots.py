"""Draw the benchmark's pictures: distributions, confusion, minimum TTC, times, and growth of the bank.

The colours are Okabe and Ito's. Rows also differ by line style. A file's bytes depend only on its cells and on
matplotlib's version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.benchmark.analysis import ANALYZER_ANSWERS, NO_ANSWER, AnalyzerAnalysis
from sumo_adv.benchmark.cells import capped_ttc, counted_outcome, names, samples
from sumo_adv.benchmark.league import MOVING_MEAN_ENCOUNTERS, Step
from sumo_adv.benchmark.nouns import MIN_TTC_CAP_S, RAW, Cell
from sumo_adv.datatypes import Floats
from sumo_adv.files import sentences, write_whole
from sumo_adv.metrics.realism import PAPER_BINS

RAW_COLOUR, OUR_COLOUR, UNATTACKED = "#0072B2", "#D55E00", "#8C8C8C"
LINE_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINE_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 3)))
FEATURE_LABELS = {"speed": "speed [m/s]", "acceleration": "acceleration [m/s²]"}
PLOT_DPI = 150


def draw_all(cells: Sequence[Cell], folder: Path, rows: Sequence[str] | None = None) -> list[Path]:
    """Draw every picture of a table's cells, for each ego.

    ``ttc-EGO.png`` and ``seconds-EGO.png`` compare the rows. ``distributions-EGO-ROW.png`` shows one row with attacks.

    Args:
        cells: The cells.
        folder: The folder.
        rows: The rows, in order; None takes all.

    Returns:
        The files.

    Raises:
        UsageError: The folder cannot be written.
    """
    paths: list[Path] = []
    for ego in names(cells, "ego"):
        own_cells = [c for c in cells if c["ego"] == ego]
        by_row = {row: [c for c in own_cells if c["row"] == row] for row in rows or names(own_cells, "row")}
        by_row = {row: part for row, part in by_row.items() if part}
        paths.append(draw_ttc(folder / file_name("ttc", ego), by_row, f"Min TTC against {ego}"))
        timed = {row: part for row, part in by_row.items() if any(_seconds(c) is not None for c in part)}
        if timed:
            paths.append(draw_seconds(folder / file_name("seconds", ego), timed, f"Time per encounter against {ego}"))
        for row, part in by_row.items():
            if samples(part, "speed")[0]:
                title = f"Raw and generated motion: {row} against {ego}"
                paths.append(draw_distributions(folder / file_name("distributions", ego, row), part, title))
    return paths


def file_name(*words: str) -> str:
    """Return the name of a PNG, made of words that may contain any character."""
    return "".join(sign if sign.isalnum() or sign in "-_.=+" else "-" for sign in "-".join(words)) + ".png"


def draw_distributions(target: Path, cells: Sequence[Cell], title: str) -> Path:
    """Draw speeds and accelerations of unattacked (blue) and attacking vehicles (orange), like the paper's Fig. 5.

    Args:
        target: The file.
        cells: The cells.
        title: The title.

    Returns:
        The file.
    """
    figure, axes = _figure(11.0, 4.2, 1, 2)
    for panel, feature in zip(axes[0], FEATURE_LABELS, strict=True):
        bins = PAPER_BINS[feature]
        generated, raw = (np.concatenate(side) for side in samples(cells, feature))
        edges = np.linspace(bins.low, bins.high, bins.count + 1)
        for values, colour, label in ((raw, RAW_COLOUR, "raw"), (generated, OUR_COLOUR, "generated")):
            share = bins.counts(values) / max(len(values), 1)
            panel.stairs(share, edges, color=colour, alpha=0.35, fill=True)
            panel.stairs(share, edges, color=colour, lw=1.8, label=f"{label} ({len(values)} steps)")
        panel.set_xlim(*_range(np.concatenate([generated, raw]), bins.low, bins.high))
        panel.set_ylim(top=1.25 * panel.get_ylim()[1])
        panel.set_xlabel(FEATURE_LABELS[feature])
        panel.set_ylabel("share of steps")
        panel.legend(fontsize=9, ncols=2, loc="upper center", frameon=False)
    return _save(figure, target, title)


def _range(values: Floats, low: float, high: float) -> tuple[float, float]:
    """Return the part of the bins that has values, with a margin."""
    least, most = np.clip([values.min(), values.max()], low, high)
    margin = 0.05 * (high - low)
    return max(float(least) - margin, low), min(float(most) + margin, high)


def draw_ttc(target: Path, by_row: Mapping[str, Sequence[Cell]], title: str) -> Path:
    """Draw the share of encounters with a minimum TTC of at most x seconds, for each row.

    Args:
        target: The file.
        by_row: The cells of each row.
        title: The title.

    Returns:
        The file.
    """
    figure, axes = _figure(9.0, 5.5, 1, 1)
    panel = axes[0][0]
    for k, (row, cells) in enumerate(by_row.items()):
        values = np.sort([capped_ttc(counted_outcome(c)) for c in cells])
        x, y = np.append(values, MIN_TTC_CAP_S), np.append(np.arange(1, len(values) + 1) / len(values), 1.0)
        x, y = np.concatenate([[0.0], x]), np.concatenate([[0.0], y])
        look = _look(k) | ({"color": UNATTACKED, "ls": "-"} if row == RAW else {})
        look["lw"] = 5.0 - 3.5 * k / max(len(by_row) - 1, 1)  # so that coinciding lines are all visible
        panel.step(x, y, where="post", label=f"{row} (n {len(cells)})", **look)
    panel.axvline(1.0, color="#8C8C8C", lw=1, ls=":", zorder=0)
    panel.annotate("1 s: critical", (1.0, 0.0), xytext=(4, 6), textcoords="offset points", fontsize=9, color="#555555")
    panel.set_xlim(-0.15, MIN_TTC_CAP_S)
    panel.set_ylim(0, 1.02)
    panel.set_xlabel("min TTC [s]; a collision is 0, never and failures are 10")
    panel.set_ylabel("share of encounters")
    _legend_beside(panel)
    return _save(figure, target, title)


def draw_seconds(target: Path, by_row: Mapping[str, Sequence[Cell]], title: str) -> Path:
    """Draw the times of encounters on a logarithmic axis: for each row the points, the median and the quartiles.

    Args:
        target: The file.
        by_row: The cells of each row; each row has at least one time.
        title: The title.

    Returns:
        The file.
    """
    figure, axes = _figure(9.0, 1.6 + 0.45 * len(by_row), 1, 1)
    panel = axes[0][0]
    for k, (_, cells) in enumerate(by_row.items()):
        values = np.array([s for c in cells if (s := _seconds(c)) is not None])
        y = np.full(values.size, k) + 0.5 * (np.linspace(0, 1, values.size) - 0.5)
        panel.plot(values, y, ls="", marker="o", ms=3, alpha=0.5, color=RAW_COLOUR, mew=0)
        low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
        panel.plot([low, high], [k, k], color=OUR_COLOUR, lw=3.5, solid_capstyle="butt")
        panel.plot([middle], [k], marker="|", ms=15, mew=2.5, color="black")
        panel.annotate(
            f"{middle:.1f} s", (1.0, k), xycoords=("axes fraction", "data"), xytext=(6, 0),
            textcoords="offset points", va="center", fontsize=9,
        )  # fmt: skip
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    panel.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    panel.set_yticks(range(len(by_row)), list(by_row), parse_math=False)
    panel.set_ylim(len(by_row) - 0.5, -0.5)
    panel.set_xlabel("seconds per encounter, including the model; bar: quartiles, tick and figure: median")
    return _save(figure, target, title)


def _seconds(cell: Cell) -> float | None:
    total = (cell.get("timing") or {}).get("total")
    return None if total is None else float(total)


def draw_confusions(analysis: AnalyzerAnalysis, folder: Path) -> list[Path]:
    """Draw the confusion of every analyzer, ego and criterion.

    Args:
        analysis: The analysis.
        folder: The folder.

    Returns:
        The files.
    """
    paths = []
    for part in analysis.parts:
        accuracy = {s.who: s.accuracy for s in part.scores}
        for who, matrix in part.confusion.items():
            name = file_name("confusion", part.ego, part.criterion, who)
            title = f"{who} against {part.ego}, by {part.criterion}: accuracy {accuracy[who].text()}"
            paths.append(draw_confusion(folder / name, matrix, title))
    return paths


def draw_confusion(target: Path, matrix: Mapping[tuple[str, str], float], title: str) -> Path:
    """Draw a confusion matrix, with labels down and answers across.

    The colour is the share of a label's encounters, the number in a cell their count.

    Args:
        target: The file.
        matrix: The number of encounters of each label and answer.
        title: The title.

    Returns:
        The file.
    """
    figure, axes = _figure(11.0, 8.6, 1, 1)
    panel = axes[0][0]
    columns = [a for a in ANALYZER_ANSWERS if a != NO_ANSWER or any(a in pair for pair in matrix)]
    labels = [a for a in columns if a != NO_ANSWER]
    counts = np.array([[matrix.get((label, a), 0.0) for a in columns] for label in labels])
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1e-9)
    panel.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(counts > 0):
        colour = "white" if share[i, j] > 0.6 else "black"
        text = f"{counts[i, j]:.0f}" if counts[i, j] == round(counts[i, j]) else f"{counts[i, j]:.1f}"
        panel.text(j, i, text, ha="center", va="center", fontsize=12, color=colour)
    panel.set_xticks(range(len(columns)), [_folded(a) for a in columns], rotation=35, ha="right", fontsize=10)
    panel.set_yticks(range(len(labels)), [_folded(a) for a in labels], fontsize=10)
    panel.set_xlabel("answer")
    panel.set_ylabel("label")
    return _save(figure, target, title)


def _folded(label: str) -> str:
    """Break a long label into two lines."""
    words = label.split(" ")
    middle = (len(words) + 1) // 2
    return label if len(label) < 18 else "\n".join((" ".join(words[:middle]), " ".join(words[middle:])))


def draw_growth(target: Path, steps: Sequence[Step], title: str) -> Path:
    """Draw the memory hits so far and the times of the last encounters over the sequence, with a line for each row.

    Args:
        target: The file.
        steps: The steps.
        title: The title.

    Returns:
        The file.
    """
    figure, axes = _figure(11.0, 6.8, 2, 1)
    lines = list(dict.fromkeys((s.row, s.ego, s.seed) for s in steps))
    for k, line in enumerate(lines):
        own_steps = [s for s in steps if (s.row, s.ego, s.seed) == line]
        place = [s.place for s in own_steps]
        label = f"{line[0]}, {line[1]}" + (f", seed {line[2]}" if len({s.seed for s in steps}) > 1 else "")
        rates, means, each = (
            np.array([getattr(s, name) for s in own_steps], float)  # None becomes nan
            for name in ("hit_rate", "seconds_window", "seconds")
        )
        axes[0][0].plot(place, rates, label=label, **_look(k))
        axes[1][0].plot(place, means, label=label, **_look(k))
        axes[1][0].plot(place, each, ls="", marker="o", ms=3, alpha=0.35, mew=0, color=_look(k)["color"])
    axes[0][0].set_ylim(-0.02, 1.02)
    axes[0][0].set_ylabel("memory hits so far")
    axes[1][0].set_ylabel(f"seconds per encounter\n(line: mean of the last {MOVING_MEAN_ENCOUNTERS})")
    axes[1][0].set_ylim(bottom=0)
    axes[1][0].set_xlabel("encounter")
    _legend_beside(axes[0][0])
    return _save(figure, target, title)


def _look(k: int) -> dict[str, Any]:
    """Return the colour and style of line ``k``."""
    return {
        "color": LINE_COLOURS[k % len(LINE_COLOURS)],
        "ls": LINE_STYLES[(k // len(LINE_COLOURS)) % len(LINE_STYLES)],
        "lw": 1.9,
    }


def _legend_beside(panel: Any) -> None:
    panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=9, frameon=False)


def _figure(width: float, height: float, rows: int, columns: int) -> tuple[Any, Any]:
    """Create a figure (size in inches) with panels ``[row][column]``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=PLOT_DPI, facecolor="white", layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(figure: Any, target: Path, title: str) -> Path:
    """Write a figure with its title. Raise UsageError if it cannot be written."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, parse_math=False)
    with sentences(target.parent):
        target.parent.mkdir(parents=True, exist_ok=True)
        write_whole(target, lambda part: figure.savefig(part, format="png", metadata={"Software": None}))
    return target
