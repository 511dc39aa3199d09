"""Write a comparison as Markdown, and as a folder: one page, and the replays of each case that changed.

OUT/compare.html    the figures, and the cases that changed with links
OUT/compare.md      the same as text
OUT/compare.json    the same as data
OUT/pages/          the replays; a name has the number of the changed case, and the side
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from sumo_adv.benchmark.table import grid, number, signed
from sumo_adv.comparison.compare import MIN_PAIRS, Compared, ComparedFigure, Comparison
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.files import json_text, sentences, write_text
from sumo_adv.metrics.statistics import Estimate
from sumo_adv.regression.runner import CaseResult
from sumo_adv.report.document import write_document
from sumo_adv.report.page import page_of
from sumo_adv.report.staging import staged

COMPARISON_NOTE = (
    "Rates: Wilson's 95 % interval. Means and differences: bootstrap, paired, 95 %; p: McNemar's exact test of rates, "
    "the sign-flip test of means (exact up to 13 encounters); "
    f"without an interval if there are fewer than {MIN_PAIRS} encounters."
)
MAX_CHANGES_SHOWN = 30  # in Markdown
ReplayLink = Callable[[Compared], str | None]
"""A function that returns where the replay of an episode is, or None if there is none."""
COMPARISON_PAGE = "compare.html"
PAGE_HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem }}
table {{ border-collapse: collapse; margin: 1rem 0 }}
th, td {{ text-align: left; padding: .3rem .8rem; border-bottom: 1px solid #8886 }}
td:first-child {{ min-width: 9rem; overflow-wrap: anywhere }}
h1 {{ overflow-wrap: anywhere }}
.scroll {{ overflow-x: auto }}
</style>
</head>
<body>
"""


def to_markdown(done: Comparison, link: ReplayLink) -> str:
    """Format the figures of both sides, and the cases that changed with links to their runs.

    Args:
        done: The comparison.
        link: Returns the link to an episode's run.

    Returns:
        The Markdown.
    """
    first, second = done.names
    lines = [f"# {first} and {second}", "", *notes(done), ""]
    head, *figures = rows(done)
    lines += grid(head, figures)
    worse = sum(change.worse for change in done.changes)
    shown = []
    for c in done.changes[:MAX_CHANGES_SHOWN]:
        places = zip(done.names, map(link, (c.first, c.second)), strict=True)
        links = ["-" if place is None else f"[{name}]({place})" for name, place in places]
        shown.append([c.key, words(c.first), words(c.second), *links])
    lines += [f"## Changed: {len(done.changes)} of {len(done.pairs)} ({worse} worse)", ""]
    if shown:
        lines += grid(["case", first, second, "run", "run"], shown, words=True)
    if len(done.changes) > MAX_CHANGES_SHOWN:
        lines += [f"{len(done.changes) - MAX_CHANGES_SHOWN} more are in the output of --json.", ""]
    return "\n".join([*lines, COMPARISON_NOTE])


def rows(done: Comparison) -> list[list[str]]:
    """Return the table of figures, with its header."""
    first, second = done.names
    return [["", first, second, f"{second} - {first}"], *(_row(figure) for figure in done.figures)]


def notes(done: Comparison) -> list[str]:
    """Return sentences on the encounters: how many are common, on one side only, failed, or without an attack."""
    failed, missed = done.counts(lambda e: e.failed), done.counts(lambda e: not e.attacked and not e.failed)
    sentences = [f"{len(done.pairs)} encounters in common."]
    for label, (a, b) in (("only on one side", done.alone), ("failed", failed), ("without an attack", missed)):
        if a or b:
            sentences.append(f"{label[0].upper()}{label[1:]}: {a} of {done.names[0]}, {b} of {done.names[1]}.")
    errors = done.counts(lambda e: e.result == CaseResult.ERROR)
    if any(errors):
        sentences.append("A case with an error counts as a failed case, and in the rates of levels as not hit.")
    if sum(failed) > sum(errors):
        sentences.append(
            "In the rates, a failed episode counts with the level that was found before it failed; if none was found, "
            "as not hit."
        )
    if any(missed):
        sentences.append("In the rates, an encounter without an attack counts as not hit.")
    if any(failed) or any(missed):
        sentences.append("Means leave out encounters that failed, or in which only one side was attacked.")
    return sentences


def words(e: Compared) -> str:
    """Describe an episode in words."""
    if e.failed and (e.result or e.level == Level.NONE):
        return e.result or "failed"
    if not e.attacked:
        return e.result or "no encounter"
    hit = f", delta-v {e.delta_v:.1f} m/s" if e.delta_v else ""
    result = "failed, found before" if e.failed else e.result
    return f"{f'{result}: ' if result else ''}{e.level}{hit}"


def _row(figure: ComparedFigure) -> list[str]:
    unit = f" [{figure.unit}]" if figure.unit not in ("", "rate") else ""
    change = signed(figure.difference) if figure.difference is not None else f"{figure.change:+.2f}"
    return [f"{figure.name}{unit}", *(_value(each, figure.unit) for each in (figure.first, figure.second)), change]


def _value(estimate: Estimate, unit: str) -> str:
    """Format a value, with its interval if there are enough encounters; Wilson's interval holds for any number."""
    return number(estimate) if unit == "rate" or estimate.n >= MIN_PAIRS else f"{estimate.value:.2f}"


def write_comparison(out: Path, done: Comparison, *, force: bool) -> Path:
    """Write the folder.

    Args:
        out: The folder.
        done: The comparison.
        force: Whether an existing folder may be replaced.

    Returns:
        The page.

    Raises:
        UsageError: The folder exists, or it cannot be written.
    """
    with staged(out, force=force) as folder, sentences(out):
        links: dict[Path | None, str] = {}
        for k, change in enumerate(done.changes, 1):
            for side, episode in enumerate((change.first, change.second), 1):
                name = f"pages/{k}-{side}.html"
                if episode.run is not None and _replay(episode.run, folder.stage / name):
                    links[episode.run] = name

        def link(episode: Compared) -> str | None:
            return links.get(episode.run)

        write_text(folder.stage / "compare.md", to_markdown(done, link) + "\n")
        write_text(folder.stage / "compare.json", json_text(done.document(), 2))
        write_document(folder.stage / COMPARISON_PAGE, html(done, link))
        folder.keep(force=force)
    return out / COMPARISON_PAGE


def _replay(run: Path, target: Path) -> bool:
    """Write the replay of a run; return False if the run cannot be shown."""
    try:
        write_document(target, page_of(run, back=f"../{COMPARISON_PAGE}").html)
    except UsageError:
        return False
    return True


def html(done: Comparison, link: ReplayLink) -> str:
    """Make the page.

    Args:
        done: The comparison.
        link: Returns the link to an episode's replay.

    Returns:
        The HTML.
    """
    first, second = done.names
    head, *figures = rows(done)
    worse = sum(change.worse for change in done.changes)
    changes = [[escape(c.key), *(_shown(e, link(e)) for e in (c.first, c.second))] for c in done.changes]
    return "\n".join([
        PAGE_HEAD.format(title=escape(f"{first} and {second}")), f"<h1>{escape(f'{first} and {second}')}</h1>",
        f"<p>{escape(' '.join(notes(done)))}</p>",
        *_table([escape(cell) for cell in head], [[escape(cell) for cell in row] for row in figures]),
        f"<h2>Changed: {len(done.changes)} of {len(done.pairs)} ({worse} worse)</h2>",
        *_table(["case", escape(first), escape(second)], changes),
        f"<p>{escape(COMPARISON_NOTE)}</p>", "</body>", "</html>", "",
    ])  # fmt: skip


def _shown(episode: Compared, place: str | None) -> str:
    text = escape(words(episode))
    return text if place is None else f'<a href="{escape(place)}">{text}</a>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = ['<div class="scroll"><table>', f"<tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>"]
    return [*lines, *(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows), "</table></div>"]
