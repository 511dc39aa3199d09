"""A figure as papers have it: the encounter without and with the attack, two maps of one scale with marks of time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sumo_adv.report.figures.parts import (
    ADVERSARY,
    EGO,
    GROUND,
    OTHER,
    SUPPORT,
    Style,
    View,
    draw_box,
    draw_lanes,
    draw_marks,
    draw_scale_bar,
    shortened,
)
from sumo_adv.report.figures.story import Scene, Story

WIDTH = 7.16  # inches: two columns of an IEEE page
WIDE = 2.2  # width over height of a map from which on the two stand one over the other
TITLE, KEY, GAP, SIDE = 0.24, 0.30, 0.10, 0.02  # inches
DPI = 300
CHARACTERS = 19  # of a title, an inch
SMALL = Style(text=6.5, lane=0.8, box=0.6, hollow=0.8, mark=3.4, mark_line=0.9, away=7.0, bar=2.0, apart=2.5)


class Picture(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        from io import BytesIO

        buffer = BytesIO()
        self.savefig(buffer, format="png", dpi=150)
        return buffer.getvalue()


def draw_paper(story: Story) -> Picture:
    """The figure: (a) unattacked, (b) attacked; only (b) where the unattacked run is not known."""
    scenes = [s for s in (story.raw, story.attacked) if s is not None]
    view = story.view(widest=4.0)
    stacked = view[2] / view[3] > WIDE
    columns, rows = (1, len(scenes)) if stacked else (len(scenes), 1)
    width = (WIDTH - 2 * SIDE - (columns - 1) * GAP) / columns
    height = width * view[3] / view[2]
    total = rows * (height + TITLE) + KEY
    figure = Picture(figsize=(WIDTH, total), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    for k, scene in enumerate(scenes):
        column, row = (0, k) if stacked else (k, 0)
        left, bottom = SIDE + column * (width + GAP), KEY + (rows - 1 - row) * (height + TITLE)
        axes = figure.add_axes((left / WIDTH, bottom / total, width / WIDTH, height / total), facecolor=GROUND)
        _draw_map(axes, story, scene, view, height)
        letter = "" if len(scenes) == 1 else f"({'ab'[k]}) "
        words = shortened(f"{letter}{_words(story, scene)}", int(width * CHARACTERS))
        axes.set_title(words, fontsize=6.5, loc="left", pad=3, parse_math=False)
    _draw_key(figure, story, total)
    return figure


def _draw_map(axes: Any, story: Story, scene: Scene, view: View, height: float) -> None:
    left, bottom, width, tall = view
    draw_lanes(axes, story.lanes, SMALL)
    for track in scene.others:
        draw_box(axes, track, story.decisive, OTHER, 7, style=SMALL)
    for track, colour in scene.coloured():
        part = track.between(story.trigger, story.end)
        axes.plot(part.x, part.y, color=colour, lw=1.2, zorder=6, solid_capstyle="round")
        draw_box(axes, track, story.trigger, colour, 5, filled=False, style=SMALL)
        draw_box(axes, track, story.decisive, colour, 8, style=SMALL)
    draw_marks(axes, [track.between(story.trigger, story.end) for track in scene.pair()], story.trigger, SMALL)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(left, left + width)
    axes.set_ylim(bottom, bottom + tall)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
    draw_scale_bar(axes, view, height, SMALL)


def _words(story: Story, scene: Scene) -> str:
    """What a map shows, in a line."""
    if scene is story.raw:
        return "Unattacked"
    least = story.outcome["min_ttc"]
    came_to = f"min TTC {least:.2f} s" if least is not None else "no conflict"
    names = " + ".join(track.id for track in (scene.adversary, *scene.supports))
    return f"{story.intent} by {names}: {'collision' if story.collided else came_to}"


def _draw_key(figure: Figure, story: Story, total: float) -> None:
    moment = "contact" if story.collided else "closest approach"
    after = f"{story.decisive - story.trigger:.1f} s"
    entries: list[Any] = [
        Patch(facecolor=EGO, edgecolor="black", lw=0.6, label="ego"),
        Patch(facecolor=ADVERSARY, edgecolor="black", lw=0.6, label="adversary"),
        *([Patch(facecolor=SUPPORT, edgecolor="black", lw=0.6, label="support")] if story.attacked.supports else []),
        Patch(facecolor=OTHER, edgecolor="black", lw=0.6, label=f"others, all at the {moment} ({after})"),
        Patch(facecolor="none", edgecolor="black", lw=0.8, label="at the trigger"),
        Line2D([], [], color="black", marker="o", mfc="white", ms=3.4, mew=0.9, lw=1.2, label="s since the trigger"),
    ]
    figure.legend(
        handles=entries, loc="lower center", ncols=len(entries), fontsize=6.5, frameon=False, borderpad=0.0,
        bbox_to_anchor=(0.5, 0.06 / total), handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip


def save(figure: Figure, target: Path, kind: str) -> None:
    """Write a figure as png, svg or pdf, whole, with the same bytes for the same figure. Raises OSError."""
    from sumo_adv.files import write_whole

    metadata: dict[str, Any] = {
        "png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None, "Producer": None},
    }[kind]  # fmt: skip
    with matplotlib.rc_context({"svg.hashsalt": "sumo_adv", "pdf.fonttype": 42}):
        write_whole(target, lambda part: figure.savefig(part, format=kind, metadata=metadata, dpi=DPI))
