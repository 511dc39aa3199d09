"""Draw pictures of a run for papers, films of a run, and the figure of a hunt.

A picture shows the encounter without and with the attack, on two maps of one scale with time marks. A film plays in
real time. It is written as GIF by pillow or as MP4 by ffmpeg.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sumo_adv.datatypes import LaneStrip, Track
from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.metrics.species import Discovery
from sumo_adv.report.encounter_figure import (
    ACTION_MARGIN_M,
    ADVERSARY_COLOUR,
    EGO_COLOUR,
    GROUND_COLOUR,
    MIN_EXTENT_M,
    OTHER_COLOUR,
    SHOWN_BEFORE_TRIGGER_S,
    SUPPORT_COLOUR,
    MapView,
    Style,
    closest_time,
    draw_box,
    draw_lanes,
    draw_marks,
    draw_scale_bar,
    pose_at,
    seen_from_above,
    shortened,
)
from sumo_adv.report.read import read_run, reading
from sumo_adv.simulation.network import read_network

SHOWN_AFTER_MOMENT_S = 1.5  # the shown paths end this long after the decisive moment
PAGE_WIDTH_IN = 7.16  # two columns of an IEEE page
STACKED_ASPECT = 2.2  # above this ratio of width to height, the two maps are stacked
TITLE_HEIGHT_IN, KEY_HEIGHT_IN, GAP_IN, SIDE_IN = 0.24, 0.30, 0.10, 0.02
PRINT_DPI = 300
TITLE_CHARACTERS_PER_INCH = 19  # that fit into a title
PAPER_STYLE = Style(text=6.5, lane=0.8, box=0.6, hollow=0.8, mark=3.4, mark_line=0.9, away=7.0, bar=2.0, apart=2.5)
FILM_WIDTH_IN, FILM_DPI = 8.0, 100  # 800 pixels wide
FILM_HEAD_IN = 0.35  # above the map
FILM_FRAMES_PER_S = 10  # one frame for each default step of 0.1 s
MAX_FILM_TITLE_CHARACTERS = 70  # more do not fit
FILM_END_FRAMES = 10  # the last moment is held for this many frames
FILM_STYLE = Style(text=9, lane=1.2, box=0.8, hollow=0.9, bar=2.5)
CURVE_SIZE_IN = (3.5, 2.4)  # one column of an IEEE page
CURVE_TEXT_PT = 7.5
MAX_ESTIMATE_TIMES = 4  # estimates are cut at this multiple of the failures found
LEVEL_COLOURS = {"valid": EGO_COLOUR, "strict": SUPPORT_COLOUR, "serious": ADVERSARY_COLOUR}


@dataclass(frozen=True, slots=True)
class FigureScene:
    """The vehicles over the shown time, with or without the attack.

    Attributes:
        ego: The ego.
        adversary: The collider, or the same vehicle in the unattacked run.
        others: The background vehicles.
        supports: The supports, or the same vehicles in the unattacked run.
    """

    ego: Track
    adversary: Track
    others: Sequence[Track]
    supports: Sequence[Track] = ()

    def pair(self) -> tuple[Track, Track]:
        """Return the ego and the collider."""
        return self.ego, self.adversary

    def coloured(self) -> tuple[tuple[Track, str], ...]:
        """Return ego, collider and supports, each with its colour."""
        return (self.ego, EGO_COLOUR), (self.adversary, ADVERSARY_COLOUR), *((t, SUPPORT_COLOUR) for t in self.supports)


@dataclass(frozen=True, slots=True)
class Story:
    """A run's encounter, as it is drawn.

    Attributes:
        name: The name of the run's input.
        intent: The collider's intent, or the label of the composition if there are supports.
        lanes: The lanes around the encounter.
        attacked: The attempt that counts.
        raw: The unattacked run; None if it has no states of the ego and the collider.
        trigger: When the attack begins [s].
        decisive: The contact or, without one, the closest approach [s].
        end: The end of the shown time [s].
        outcome: The verdict as ``outcome.json`` has it.
    """

    name: str
    intent: str
    lanes: Sequence[LaneStrip]
    attacked: FigureScene
    raw: FigureScene | None
    trigger: float
    decisive: float
    end: float
    outcome: Mapping[str, Any]

    @property
    def collided(self) -> bool:
        """Whether the attempt ended in a collision."""
        return bool(self.outcome["collided"])

    def view(self, widest: float) -> MapView:
        """Compute the area around the paths of ego and adversaries.

        The area is at least as wide as high.

        Args:
            widest: The maximum ratio of width to height [-].

        Returns:
            The area.
        """
        scenes = [self.attacked] if self.raw is None else [self.attacked, self.raw]
        shown = [t.between(self.start, self.end) for scene in scenes for t, _ in scene.coloured()]
        tracks = [part for part in shown if part.time.size]
        x, y = (np.concatenate([getattr(t, axis) for t in tracks]) for axis in ("x", "y"))
        width = max(float(np.ptp(x)) + 2 * ACTION_MARGIN_M, MIN_EXTENT_M)
        height = max(float(np.ptp(y)) + 2 * ACTION_MARGIN_M, MIN_EXTENT_M * 0.4)
        width, height = max(width, height), max(height, width / widest)
        return float(x.max() + x.min() - width) / 2, float(y.max() + y.min() - height) / 2, width, height

    @property
    def start(self) -> float:
        """The beginning of the shown time [s]."""
        return self.trigger - SHOWN_BEFORE_TRIGGER_S


def read_story(folder: Path) -> Story:
    """Read the encounter of a run.

    Args:
        folder: The run's folder.

    Returns:
        The story of the attempt that counts.

    Raises:
        UsageError: The folder holds no run, the run made no attempt, or a file is damaged.
    """
    run = read_run(folder)
    if run.outcome.get("best") is None or not run.best:
        raise UsageError(f"The run in {folder} made no attempt, so there is nothing to draw.")
    with reading(folder):
        ego, adversaries = run.outcome["ego"]["id"], [a["id"] for a in run.outcome["adversaries"]]
        trigger, verdict = float(run.outcome["trigger_time"]), run.outcome["outcome"]
        attacked = _scene(run.best, ego, adversaries)
        if attacked is None:
            raise UsageError(f"Ego or adversary is not in the states of the run in {run.folder}; rerun it.")
        contact = verdict["contact_time"]
        decisive = closest_time(*attacked.pair(), trigger) if contact is None else float(contact)
        end = min(decisive + SHOWN_AFTER_MOMENT_S, float(max(t.time[-1] for t in attacked.pair())))
        network = run.folder / "inputs" / Path(run.manifest["network"]).name
        lanes: Sequence[LaneStrip] = ()
        if network.is_file():
            x, y, _ = pose_at(attacked.ego, decisive) or (float(attacked.ego.x[-1]), float(attacked.ego.y[-1]), 0.0)
            lanes = read_network(network).strips(x, y, 400.0)
        best = run.outcome["attempts"][run.outcome["best"]]
        intent = best.get("composition") or best["intent"]
        return Story(
            str(run.manifest["name"]), str(intent), lanes, attacked, _scene(run.raw, ego, adversaries), trigger,
            decisive, end, verdict,
        )  # fmt: skip


def _scene(tracks: Sequence[Track], ego: str, adversaries: Sequence[str]) -> FigureScene | None:
    """Sort the tracks into a scene; return None if the ego or the collider is missing."""
    by_id = {t.id: t for t in tracks}
    collider, *supports = adversaries
    if ego not in by_id or collider not in by_id:
        return None
    others = [t for t in tracks if t.id not in (ego, *adversaries)]
    return FigureScene(by_id[ego], by_id[collider], others, [by_id[name] for name in supports if name in by_id])


class Picture(Figure):
    """A figure that notebooks show without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png", dpi=150)
        return buffer.getvalue()


def draw_paper(story: Story) -> Picture:
    """Draw the figure: (a) unattacked and (b) attacked, or only the attacked scene if the unattacked run is unknown.

    Args:
        story: The encounter.

    Returns:
        The figure, two columns of an IEEE page wide.
    """
    scenes = [s for s in (story.raw, story.attacked) if s is not None]
    view = story.view(widest=4.0)
    stacked = view[2] / view[3] > STACKED_ASPECT
    columns, rows = (1, len(scenes)) if stacked else (len(scenes), 1)
    width = (PAGE_WIDTH_IN - 2 * SIDE_IN - (columns - 1) * GAP_IN) / columns
    height = width * view[3] / view[2]
    total = rows * (height + TITLE_HEIGHT_IN) + KEY_HEIGHT_IN
    figure = Picture(figsize=(PAGE_WIDTH_IN, total), dpi=PRINT_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    for k, scene in enumerate(scenes):
        column, row = (0, k) if stacked else (k, 0)
        left, bottom = (
            SIDE_IN + column * (width + GAP_IN),
            KEY_HEIGHT_IN + (rows - 1 - row) * (height + TITLE_HEIGHT_IN),
        )
        axes = figure.add_axes(
            (left / PAGE_WIDTH_IN, bottom / total, width / PAGE_WIDTH_IN, height / total), facecolor=GROUND_COLOUR
        )
        _draw_map(axes, story, scene, view, height)
        letter = "" if len(scenes) == 1 else f"({'ab'[k]}) "
        words = shortened(f"{letter}{_words(story, scene)}", int(width * TITLE_CHARACTERS_PER_INCH))
        axes.set_title(words, fontsize=6.5, loc="left", pad=3, parse_math=False)
    _draw_key(figure, story, total)
    return figure


def _draw_map(axes: Any, story: Story, scene: FigureScene, view: MapView, height: float) -> None:
    left, bottom, width, tall = view
    draw_lanes(axes, story.lanes, PAPER_STYLE)
    for track in seen_from_above(story.lanes, scene.others, story.decisive):
        draw_box(axes, track, story.decisive, OTHER_COLOUR, 7, style=PAPER_STYLE)
    for track, colour in scene.coloured():
        part = track.between(story.trigger, story.end)
        axes.plot(part.x, part.y, color=colour, lw=1.2, zorder=6, solid_capstyle="round")
        draw_box(axes, track, story.trigger, colour, 5, filled=False, style=PAPER_STYLE)
        draw_box(axes, track, story.decisive, colour, 8, style=PAPER_STYLE)
    draw_marks(axes, [track.between(story.trigger, story.end) for track in scene.pair()], story.trigger, PAPER_STYLE)
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(left, left + width), ylim=(bottom, bottom + tall), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
    draw_scale_bar(axes, view, height, PAPER_STYLE)


def _words(story: Story, scene: FigureScene) -> str:
    """Return the title of a scene's map."""
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
        Patch(facecolor=EGO_COLOUR, edgecolor="black", lw=0.6, label="ego"),
        Patch(facecolor=ADVERSARY_COLOUR, edgecolor="black", lw=0.6, label="adversary"),
        *(
            [Patch(facecolor=SUPPORT_COLOUR, edgecolor="black", lw=0.6, label="support")]
            if story.attacked.supports
            else []
        ),
        Patch(facecolor=OTHER_COLOUR, edgecolor="black", lw=0.6, label=f"others, all at the {moment} ({after})"),
        Patch(facecolor="none", edgecolor="black", lw=0.8, label="at the trigger"),
        Line2D([], [], color="black", marker="o", mfc="white", ms=3.4, mew=0.9, lw=1.2, label="s since the trigger"),
    ]
    figure.legend(
        handles=entries, loc="lower center", ncols=len(entries), fontsize=6.5, frameon=False, borderpad=0.0,
        bbox_to_anchor=(0.5, 0.06 / total), handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip


def save(figure: Figure, target: Path, kind: str) -> None:
    """Write a figure, whole or not at all. The same figure gives the same bytes.

    Args:
        figure: The figure.
        target: The file.
        kind: ``png``, ``svg`` or ``pdf``.

    Raises:
        OSError: The file cannot be written.
    """
    metadata: dict[str, Any] = {
        "png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None, "Producer": None},
    }[kind]  # fmt: skip
    with matplotlib.rc_context({"svg.hashsalt": "sumo_adv", "pdf.fonttype": 42}):
        write_whole(target, lambda part: figure.savefig(part, format=kind, metadata=metadata, dpi=PRINT_DPI))


def write_film(story: Story, target: Path, kind: str) -> None:
    """Write a film. Faint outlines show where ego and adversaries would be without the attack.

    Args:
        story: The encounter.
        target: The file.
        kind: ``gif`` or ``mp4``.

    Raises:
        UsageError: An MP4 is wanted and there is no ffmpeg.
        OSError: The file cannot be written.
    """
    if kind == "mp4" and shutil.which("ffmpeg") is None:
        raise UsageError("An MP4 needs ffmpeg: install it (Debian: apt-get install ffmpeg), or make a .gif.")
    write_whole(target, lambda part: _film(story, part, kind))


def _film(story: Story, target: Path, kind: str) -> None:
    view = story.view(widest=3.0)
    pixels = (FILM_HEAD_IN + FILM_WIDTH_IN * view[3] / view[2]) * FILM_DPI
    height = round(pixels / 2) * 2 / FILM_DPI  # even, for the codec
    figure = Figure(figsize=(FILM_WIDTH_IN, height), dpi=FILM_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    share = 1.0 - FILM_HEAD_IN / height
    axes = figure.add_axes((0.0, 0.0, 1.0, share), facecolor=GROUND_COLOUR)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlim=(view[0], view[0] + view[2]), ylim=(view[1], view[1] + view[3]), xticks=[], yticks=[])
    draw_lanes(axes, story.lanes, FILM_STYLE)
    draw_scale_bar(axes, view, height - FILM_HEAD_IN, FILM_STYLE)
    title = figure.text(0.01, 1.0 - 0.5 * FILM_HEAD_IN / height, "", va="center", fontsize=11, parse_math=False)
    times = story.start + np.arange(round((story.end - story.start) * FILM_FRAMES_PER_S) + 1) / FILM_FRAMES_PER_S
    still = len(axes.patches)
    writer: Any = PillowWriter(fps=FILM_FRAMES_PER_S)
    if kind == "mp4":
        options = ["-pix_fmt", "yuv420p", "-bitexact", "-f", "mp4"]
        writer = FFMpegWriter(fps=FILM_FRAMES_PER_S, codec="libx264", extra_args=options)
    with writer.saving(figure, str(target), FILM_DPI):
        for time in [*times.tolist(), *[float(times[-1])] * FILM_END_FRAMES]:
            _draw_moment(axes, story, time)
            title.set_text(_caption(story, time))
            writer.grab_frame()
            for patch in list(axes.patches)[still:]:
                patch.remove()


def _draw_moment(axes: Any, story: Story, time: float) -> None:
    for track in seen_from_above(story.lanes, story.attacked.others, time):
        draw_box(axes, track, time, OTHER_COLOUR, 5, style=FILM_STYLE)
    if story.raw is not None and time > story.trigger:
        for track, colour in story.raw.coloured():
            draw_box(axes, track, time, colour, 6, filled=False, style=FILM_STYLE)
    for track, colour in story.attacked.coloured():
        draw_box(axes, track, time, colour, 8, style=FILM_STYLE)


def _caption(story: Story, time: float) -> str:
    since = time - story.trigger
    contact = "   contact" if story.collided and time >= story.decisive - 1e-6 else ""
    return f"{since:+.1f} s   {shortened(f'{story.name}: {story.intent}', MAX_FILM_TITLE_CHARACTERS)}{contact}"


def draw_over_time(
    minutes: Sequence[float], found: Sequence[Mapping[str, int]], left: Sequence[Discovery | None]
) -> Picture:
    """Draw the failures of a hunt over time and, below them, the chance of a new kind of failure.

    Steps rise at the end of each round. Hunts of earlier versions have no estimates, so only their failures are drawn.

    Args:
        minutes: The time after each round ``(n,)`` [min].
        found: The number of distinct failures after each round, by level; a failure counts at its level and all lower
            ones.
        left: The estimates after each round: the minimum number of kinds with its interval, and the chance of a new
            kind; None if there is no estimate.

    Returns:
        The figure.
    """
    known = [(time, each) for time, each in zip(minutes, left, strict=True) if each is not None]
    width, height = CURVE_SIZE_IN
    figure = Picture(figsize=(width, height * (1.5 if known else 1.0)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    ratios = (2, 1) if known else (1,)
    axes, *below = figure.subplots(len(ratios), squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    times = [0.0, *minutes]
    most = float(max(each["valid"] for each in found))
    if known:
        ends, highest = [time for time, _ in known], MAX_ESTIMATE_TIMES * max(most, 1)
        least, low, high = (
            [min(getattr(each, name), highest) for _, each in known] for name in ("least", "low", "high")
        )
        axes.fill_between(ends, low, high, step="post", color=OTHER_COLOUR, alpha=0.25, lw=0)
        axes.step(ends, least, where="post", color=OTHER_COLOUR, lw=1.2, ls="--", label="there are at least")
        most = max([most, *least])
        below[0].step(ends, [100 * each.chance for _, each in known], where="post", color="black", lw=1.2)
        below[0].set_ylabel("new kind in\nthe next [%]", fontsize=CURVE_TEXT_PT)
        below[0].set_ylim(0.0, 105.0)
        below[0].tick_params(labelsize=CURVE_TEXT_PT)
        below[0].grid(alpha=0.3)
    for level, colour in LEVEL_COLOURS.items():
        counts = [0, *(each[level] for each in found)]
        label = level if level == "serious" else f"{level} or worse"
        axes.step(times, counts, where="post", color=colour, lw=1.4, marker="o", ms=2.5, label=label)
    axes.set_xlim(0.0, max(times[-1], 1e-3))
    axes.set_ylim(0.0, max(1.0, 1.1 * most))
    (below or [axes])[-1].set_xlabel("time of the hunt [min]", fontsize=CURVE_TEXT_PT)
    axes.set_ylabel("distinct failures", fontsize=CURVE_TEXT_PT)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.tick_params(labelsize=CURVE_TEXT_PT)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=CURVE_TEXT_PT, loc="upper left")
    return figure
