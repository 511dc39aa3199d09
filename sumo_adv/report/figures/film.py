"""A film of the attack: GIF by pillow, MP4 by ffmpeg, in real time."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.report.figures.parts import (
    GROUND,
    OTHER,
    Style,
    draw_box,
    draw_lanes,
    draw_scale_bar,
    shortened,
)
from sumo_adv.report.figures.story import Story

WIDTH, DPI = 8.0, 100  # inches, dots an inch: 800 pixels
HEAD = 0.35  # inches above the map
RATE = 10  # frames a second, which is SUMO's step too
MOST = 70  # characters of the title
HOLD = 10  # frames for which the end stands
LOOK = Style(text=9, lane=1.2, box=0.8, hollow=0.9, bar=2.5)


def write_film(story: Story, target: Path, kind: str) -> None:
    """Write the film; faint outlines show where ego and adversaries would be without the attack.

    Raises:
        UsageError: an MP4 without ffmpeg.
        OSError: the file cannot be written.
    """
    if kind == "mp4" and shutil.which("ffmpeg") is None:
        raise UsageError("An MP4 needs ffmpeg: install it (Debian: apt-get install ffmpeg), or make a .gif.")
    write_whole(target, lambda part: _film(story, part, kind))


def _film(story: Story, target: Path, kind: str) -> None:
    view = story.view(widest=3.0)
    height = _even(HEAD + WIDTH * view[3] / view[2])
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    share = 1.0 - HEAD / height
    axes = figure.add_axes((0.0, 0.0, 1.0, share), facecolor=GROUND)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlim(view[0], view[0] + view[2])
    axes.set_ylim(view[1], view[1] + view[3])
    axes.set_xticks([])
    axes.set_yticks([])
    draw_lanes(axes, story.lanes, LOOK)
    draw_scale_bar(axes, view, height - HEAD, LOOK)
    title = figure.text(0.01, 1.0 - 0.5 * HEAD / height, "", va="center", fontsize=11, parse_math=False)
    times = story.start + np.arange(round((story.end - story.start) * RATE) + 1) / RATE
    still = len(axes.patches)
    writer: Any = PillowWriter(fps=RATE) if kind == "gif" else _mp4_writer()
    with writer.saving(figure, str(target), DPI):
        for time in [*times.tolist(), *[float(times[-1])] * HOLD]:
            _draw_moment(axes, story, time)
            title.set_text(_words(story, time))
            writer.grab_frame()
            for patch in list(axes.patches)[still:]:
                patch.remove()


def _mp4_writer() -> Any:
    return FFMpegWriter(fps=RATE, codec="libx264", extra_args=["-pix_fmt", "yuv420p", "-bitexact", "-f", "mp4"])


def _even(height: float) -> float:
    """A height of an even number of pixels, which the codec needs."""
    return round(height * DPI / 2) * 2 / DPI


def _draw_moment(axes: Any, story: Story, time: float) -> None:
    for track in story.attacked.others:
        draw_box(axes, track, time, OTHER, 5, style=LOOK)
    if story.raw is not None and time > story.trigger:
        for track, colour in story.raw.coloured():
            draw_box(axes, track, time, colour, 6, filled=False, style=LOOK)
    for track, colour in story.attacked.coloured():
        draw_box(axes, track, time, colour, 8, style=LOOK)


def _words(story: Story, time: float) -> str:
    since = time - story.trigger
    caption = f"{since:+.1f} s   {shortened(f'{story.name}: {story.intent}', MOST)}"
    if story.collided and time >= story.decisive - 1e-6:
        return f"{caption}   contact"
    return caption
