"""A comparison as Markdown."""

from __future__ import annotations

from collections.abc import Callable

from sumo_adv.benchmark.table import grid, number, signed
from sumo_adv.comparison.compare import LEAST, Comparison, Figure
from sumo_adv.comparison.side import Compared
from sumo_adv.metrics.statistics import Estimate

HOW = (
    "Rates: Wilson's 95 % interval. Means and differences: bootstrap, paired, 95 %; "
    f"without an interval where there are fewer than {LEAST} encounters."
)
MOST = 30  # changes shown
Link = Callable[[Compared], str | None]
"""Where the replay of an episode is, None if there is none."""


def to_markdown(done: Comparison, link: Link) -> str:
    """Figures of both sides, and the cases that changed with links to their runs."""
    first, second = done.names
    lines = [f"# {first} and {second}", "", *notes(done), ""]
    head, *figures = rows(done)
    lines += grid(head, figures)
    worse = sum(change.worse for change in done.changes)
    shown = [
        [c.key, words(c.first), words(c.second), _link(link(c.first), first), _link(link(c.second), second)]
        for c in done.changes[:MOST]
    ]
    lines += [f"## Changed: {len(done.changes)} of {len(done.pairs)} ({worse} worse)", ""]
    if shown:
        lines += grid(["case", first, second, "run", "run"], shown, words=True)
    if len(done.changes) > MOST:
        lines += [f"{len(done.changes) - MOST} more are in the output of --json.", ""]
    return "\n".join([*lines, HOW])


def rows(done: Comparison) -> list[list[str]]:
    """The figures as a table, its head first."""
    first, second = done.names
    return [["", first, second, f"{second} - {first}"], *(_row(figure) for figure in done.figures)]


def notes(done: Comparison) -> list[str]:
    """What the figures rest on."""
    failed, missed = done.counts(lambda e: e.failed), done.counts(lambda e: not e.attacked and not e.failed)
    sentences = [f"{len(done.pairs)} encounters in common."]
    for label, (a, b) in (("only on one side", done.alone), ("failed", failed), ("without an attack", missed)):
        if a or b:
            sentences.append(f"{label[0].upper()}{label[1:]}: {a} of {done.names[0]}, {b} of {done.names[1]}.")
    return sentences


def words(e: Compared) -> str:
    """What an episode came to."""
    if e.failed:
        return "failed"
    if not e.attacked:
        return e.result or "no encounter"
    hit = f", delta-v {e.delta_v:.1f} m/s" if e.delta_v else ""
    return f"{e.result + ': ' if e.result else ''}{e.level}{hit}"


def _row(figure: Figure) -> list[str]:
    unit = f" [{figure.unit}]" if figure.unit not in ("", "rate") else ""
    change = signed(figure.difference) if figure.difference is not None else f"{figure.change:+.2f}"
    return [f"{figure.name}{unit}", *(_value(each, figure.unit) for each in (figure.first, figure.second)), change]


def _value(estimate: Estimate, unit: str) -> str:
    """With an interval if it rests on enough encounters. Wilson's interval of a rate holds for any number."""
    return number(estimate) if unit == "rate" or estimate.n >= LEAST else f"{estimate.value:.2f}"


def _link(place: str | None, name: str) -> str:
    return "-" if place is None else f"[{name}]({place})"
