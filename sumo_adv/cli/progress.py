"""Show people the progress of a command, and the result of a run.

Pipes get plain lines. With ``--json``, nothing is shown.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import typer

from sumo_adv.campaigns.results import EpisodeJob, Row, is_failed
from sumo_adv.cli.terminal import clean, counted
from sumo_adv.datatypes import ENDING_SENTENCES, Attempt, Ending, Level
from sumo_adv.drivers.timing import read_driver_time
from sumo_adv.episode.order import rank
from sumo_adv.simulation.warnings_log import WarningKind, said_of
from sumo_adv.words.fit import held

if TYPE_CHECKING:
    from sumo_adv.benchmark import jobs as bench

PROGRESS_PERIOD_S = 20.0  # least time between lines of progress without a terminal


def span(seconds: float) -> str:
    """Return a duration in words.

    Args:
        seconds: The duration [s].
    """
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


class PacedLines:
    """Prints lines of progress on stderr, for a command without a terminal.

    A line comes ``PROGRESS_PERIOD_S`` after the beginning, and then as an item ends, at most one in that time. Each
    line is flushed.
    """

    def __init__(
        self, what: str, *, at_most: bool = False, clock: Callable[[], float] = time.monotonic,
        first_s: float = PROGRESS_PERIOD_S,
    ) -> None:  # fmt: skip
        """Start without a line.

        Args:
            what: What is counted, in the plural.
            at_most: Whether fewer may be needed than the number of all. Then no line estimates the time left.
            clock: Returns the time [s].
            first_s: The time from ``begin`` to the first line [s].
        """
        self._what, self._at_most, self._clock, self._first = what, at_most, clock, first_s
        self._said = self._began = clock()
        self._phase, self._before = "", 0
        self._newest = (0, 0, "", "")
        self._timer: threading.Timer | None = None

    def begin(self, of: int, before: int = 0) -> None:
        """Begin to count. The first line comes even if nothing ends until then.

        Args:
            of: The number of all.
            before: The number that an earlier call has done.
        """
        self._before, self._newest = before, (before, of, "", "")
        if of > before:
            self._timer = threading.Timer(self._first, self._say)
            self._timer.daemon = True
            self._timer.start()

    def tell(self, done: int, of: int, phase: str = "", note: str = "") -> None:
        """Print how many are done and how long the others will take, unless the last line is too recent.

        Args:
            done: The number that is done.
            of: The number of all.
            phase: A text in front. The time left is estimated from its first call.
            note: A text at the end.
        """
        now = self._clock()
        if phase != self._phase:
            self._phase, self._before, self._began = phase, done, now
        self._newest = (done, of, phase, note)
        if now - self._said >= PROGRESS_PERIOD_S:
            self.close()
            self._say()

    def close(self) -> None:
        """Print no line later."""
        if self._timer is not None:
            self._timer.cancel()

    def _say(self) -> None:
        """Print a line about the newest state."""
        done, of, phase, note = self._newest
        now = self._said = self._clock()
        ran = done - self._before
        each = (now - self._began) / ran if ran > 0 else 0.0
        left = f", about {span((of - done) * each)} left" if ran > 0 and of > done and not self._at_most else ""
        noun, of_what, rest = self._what.partition(" ")
        noun = noun.removesuffix("s") if of == 1 else noun
        most = "at most " if self._at_most else ""
        typer.echo(
            f"{phase}{done} of {most}{of} {noun}{of_what}{rest} done{left}{f'; {note}' if note else ''}.", err=True
        )


class LiveDisplay:
    """A context that shows ``_display``, a live display of rich, if one is set."""

    _display: Any = None

    def __enter__(self) -> Self:
        if self._display is not None:
            self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.stop()


class Speaker(LiveDisplay):
    """Prints lines, in a terminal above a spinner that names the current activity. Nothing is printed if ``quiet``."""

    def __init__(self, first: str, *, quiet: bool) -> None:
        self._quiet, self._console = quiet, None
        if not quiet and sys.stdout.isatty():
            from rich.console import Console

            self._console = Console(highlight=False, file=sys.__stdout__)
            self._display = self._console.status(first)

    def say(self, text: str) -> None:
        """Print a line."""
        if text and self._console is not None:
            self._console.print(clean(text), markup=False)
        elif text and not self._quiet:
            typer.echo(text)

    def now(self, words: str) -> None:
        """Set the text of the spinner."""
        if self._display is not None:
            self._display.update(words)


class RunProgress(Speaker):
    """Prints a line for each event, the first attempt, and each attempt that is better than all before in its
    encounter.
    """

    def __init__(self, *, quiet: bool, seconds: float = math.inf) -> None:
        """Start without an encounter.

        Args:
            quiet: Whether nothing is printed.
            seconds: The time that attempts may take in an encounter [s].
        """
        super().__init__("Looking for an encounter ...", quiet=quiet)
        self._seconds = seconds
        self._begin()

    def _begin(self) -> None:
        self._attempts, self._level, self._began = 0, Level.NONE, time.perf_counter()
        self._rank: tuple[float, float] | None = None

    def tell(self, what: str, value: Any) -> None:
        """Report an event and its value."""
        if self._quiet:
            return
        text = line(what, value)
        if text and self._is_shown(what, value):
            self.say(text)
        self.now(self._words())

    def _is_shown(self, what: str, value: Any) -> bool:
        if what == "encounter":
            self._begin()
        if what != "attempt":
            return True
        self._attempts += 1
        self._level = max(self._level, value.verdict.level)
        new = rank(value.verdict)
        better = self._rank is None or new < self._rank
        self._rank = new if better else self._rank
        return better

    def _words(self) -> str:
        took = time.perf_counter() - self._began
        pace, left = self._attempts / max(took, 1e-3), max(self._seconds - took, 0.0)
        until = f"{took:.0f} s so far" if math.isinf(left) else f"{left:.0f} s left"
        return f"Attacking: {self._attempts} attempts, {pace:.0f} a second, best level {self._level}, {until} ..."


class ServeProgress(Speaker):
    """Prints the events that matter to a server's user, and counts them in the spinner."""

    def __init__(self, *, quiet: bool) -> None:
        super().__init__("Starting ...", quiet=quiet)
        self._counts = [0, 0, 0]
        self._doing = "Starting"

    def __call__(self, event: Mapping[str, Any]) -> None:
        if self._quiet:
            return
        self.say(served(event))
        if event["event"] == "outcome":
            for k, name in enumerate(("number", "critical", "collided")):
                self._counts[k] = event["number"] if name == "number" else self._counts[k] + bool(event[name])
        self._doing = _doing(event) or self._doing
        done, critical, collided = self._counts
        self.now(f"{self._doing} ({done} encounters, {critical} critical, {collided} collisions)")


class _Barred(LiveDisplay):
    """Shows a bar on stderr, with the time left and a note behind it."""

    _task: Any = None
    _lines: PacedLines | None = None

    def __exit__(self, *of: object) -> None:
        super().__exit__(*of)
        if self._lines is not None:
            self._lines.close()

    def _make_bar(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._display = Progress(
            TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"), console=Console(file=sys.__stderr__, highlight=False),
        )  # fmt: skip


class BatchProgress(_Barred):
    """Prints failures at once on stderr.

    In a terminal outside a build server, it also shows a bar with rate and counts, otherwise ``PacedLines``. With
    ``quiet``, only failures are shown.
    """

    def __init__(self, *, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        if not quiet and sys.stderr.isatty() and not os.environ.get("CI"):
            self._make_bar()
        elif not quiet:
            self._lines = PacedLines("episodes", clock=clock)
        self._critical = self._failed = self._ran = self._total = self._before = 0

    def begin(self, total: int, before: Sequence[Row]) -> None:
        self._total, self._before = total, len(before)
        self._critical = sum(bool(r["critical"]) for r in before)
        self._failed = sum(map(is_failed, before))
        if self._display is not None:
            self._task = self._display.add_task("Episodes", total=total, completed=len(before), note="")
            self._show(0)
        elif self._lines is not None:
            self._lines.begin(total, len(before))

    def finished(self, job: EpisodeJob, row: Row) -> None:
        self._critical += bool(row["critical"])
        self._failed += is_failed(row)
        self._ran += 1
        if is_failed(row):
            self._say(f"{job.words} failed: {row['failure']}", "sumo-adv: ")
        if self._display is not None:
            self._show(1)
        elif self._lines is not None:
            self._lines.tell(self._before + self._ran, self._total, note=self._counts())

    def stopping(self, now: bool) -> None:
        self._say(stopping_words(now))

    def _show(self, advance: int) -> None:
        seconds = self._display.tasks[0].elapsed or 0.0
        rate = f"{60 * self._ran / seconds:.1f}/min, " if self._ran and seconds else ""
        self._display.update(self._task, advance=advance, note=f"{rate}{self._counts()}")

    def _counts(self) -> str:
        return f"{self._critical} critical, {self._failed} failed"

    def _say(self, text: str, before: str = "") -> None:
        if self._display is None:
            typer.echo(before + text, err=True)
        else:
            self._display.console.print(clean(text), markup=False)


class BenchProgress(_Barred):
    """Shows a bar in a terminal, otherwise ``PacedLines``. Nothing is shown if ``quiet``."""

    def __init__(self, *, quiet: bool) -> None:
        if not quiet and sys.stderr.isatty():
            self._make_bar()
        elif not quiet:
            self._lines = PacedLines("cells")

    def begin(self, total: int, before: int) -> None:
        self._total, self._done = total, before
        if self._display is not None:
            self._task = self._display.add_task("cells", total=total, completed=before, note="")
        elif self._lines is not None:
            typer.echo(f"{total} cells, {before} of them done before.", err=True)
            self._lines.begin(total, before)

    def finished(self, job: bench.BenchJob) -> None:
        self._done += len(job.rows)
        if self._display is not None:
            self._display.update(self._task, advance=len(job.rows), description=clean(job.case.name))
        elif self._lines is not None:
            self._lines.tell(self._done, self._total)


class Counter:
    """Shows progress in one line of stderr that is overwritten, without a terminal as ``PacedLines``.

    Nothing is shown if ``quiet``.
    """

    def __init__(
        self, what: str, *, quiet: bool, at_most: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:  # fmt: skip
        """Start without a line.

        Args:
            what: What is counted, in the plural.
            quiet: Whether nothing is shown.
            at_most: Whether fewer may be needed than the number of all.
            clock: Returns the time [s].
        """
        self._what, self._most, self._said = what, "at most " if at_most else "", False
        self._shown = not quiet and sys.stderr.isatty()
        self._lines = None if quiet or self._shown else PacedLines(what, at_most=at_most, clock=clock)

    def begin(self, of: int) -> None:
        """Begin to count.

        Args:
            of: The number of all.
        """
        if self._lines is not None:
            self._lines.begin(of)
        elif of:
            self.tell(0, of)

    def tell(self, done: int, of: int, phase: str = "") -> None:
        """Show the progress.

        Args:
            done: The number that is done.
            of: The number of all.
            phase: A text in front.
        """
        if self._lines is not None:
            self._lines.tell(done, of, phase)
        if self._shown:
            self._said = True
            words = f"\r{phase}{done} of {self._most}{of} {self._what} "  # sys.stderr would drop the carriage return
            print(words, end="", file=sys.__stderr__, flush=True)

    def close(self) -> None:
        """End the line if anything was shown, and print none later."""
        if self._lines is not None:
            self._lines.close()
        if self._said:
            typer.echo(err=True)


def stopping_words(now: bool) -> str:
    """Return what to print when Ctrl-C is pressed.

    Args:
        now: Whether it was pressed again.
    """
    if now:
        return "Stopping now."
    return "Finishing the episodes that run; Ctrl-C again stops them. Rerun the same command to continue."


# -- a run in words


def line(what: str, value: Any) -> str:
    """Describe an event of a run; '' if it is not shown."""
    if what == "encounter":
        near = ", ".join(f"{i} ({r})" for i, r, _ in value.ranking)
        earlier = len(value.passed_over)
        passed = f" after passing over {counted(earlier, 'earlier encounter')}" if earlier else ""
        left_out = f"; only obstacles, because SUMO crashes on them: {', '.join(value.beside)}" if value.beside else ""
        return f"Encounter at {value.time:.1f} s{passed}: ego {value.ego}; near it {near}{left_out}"
    if what == "intents":
        top = value[0]
        return f"Most dangerous: {top.bv} — {top.label} (risk {top.risk}; {top.reason})"
    return _attempt(value) if what == "attempt" else ""


def _attempt(a: Attempt) -> str:
    """Describe an attempt."""
    v, p = a.verdict, a.proposal
    outcome = "collision" if v.collided else (f"min TTC {v.min_ttc:.2f} s" if v.min_ttc < 100 else "no conflict")
    if v.collided and v.preventability is not None:
        who = _preventable(v.preventability.by, v.preventability.inconclusive)
        if not v.preventability.simulated and not v.preventability.inconclusive:
            who = f"kinematically {who}"  # the check in the loop may have another result
        level = "" if v.level is Level.COLLISION else f"{v.level}, "
        outcome += f" ({level}{_hard(v.delta_v, v.impact_speed)}, {who})"
    gates = f", not feasible: {', '.join(v.failed_gates)}" if v.failed_gates else ""
    rear = ", rear-end" if v.rear_end else ""
    helped = "".join(f" + {q.bv}: {q.label}" for q in p.supports)
    return f"  attempt {a.index + 1:2d} [{p.by}] {p.bv}: {p.label}/{p.planner.mode}{helped}, {outcome}{rear}{gates}"


def summary(result: Mapping[str, Any], folder: Path) -> str:
    """Describe the result of a run.

    Args:
        result: The content of ``outcome.json``.
        folder: The folder of the run.

    Returns:
        The lines, joined.
    """
    lines = [_result(result)]
    tried = result.get("encounters_tried") or []
    if tried:
        each = "; ".join(f"{t['time']:.1f} s ({t['level']} in {t['attempts']} attempts)" for t in tried)
        lines.append(f"Encounters tried without success: {len(tried)}. {each}.")
    raw, best = result["raw"], result["outcome"]
    if best is not None and raw is not None:
        intent = result["intent"]
        lines.append(f"{intent['label']} by {intent['bv']}. Baseline: {_before(raw)}. Attacked: {_after(best)}.")
    lines += [_attackers(result["attackers"])] if len(result.get("attackers", ())) > 1 else []
    asked = result.get("asked")
    if best is not None and asked is not None:
        lacks = " ".join(["no.", *asked["misfits"], held(asked["parts"])]).rstrip()
        lines.append(f"As asked: {'yes.' if asked['fits'] else lacks}")
    if best is not None and best.get("cause"):
        lines.append(f"Why: {best['cause']['sentence']}")
    if (robust := result.get("robust")) is not None:
        lines.append(
            f"The attack holds in {robust['held']} of {robust['of']} neighbours (other arrivals or parameter values)."
        )
    for success in result["successes"] if len(result["successes"]) > 1 else ():
        path = f" ({folder / success['folder']})" if success["folder"] else ""
        lines.append(f"Attack of attempt {success['attempt'] + 1}: {success['kind']}{path}.")
    lines += [_overridden(result["ego_actions"])] if (result.get("ego_actions") or {}).get("LaneSpeed") else []
    if (driver := read_driver_time(result.get("driver_time"))) is not None and driver.calls:
        lines.append(driver.words(result["timing"]["total"]))
    lines.append(result["agents"]["note"])
    if result["encounter"] is not None and not result["forked"]:
        lines.append("Attempts were loaded and repeated, not forked: slower, but with the same result.")
    lines += [result["bank_change"]] if result.get("bank_change") else []
    lines += said_of([WarningKind(**kind) for kind in result.get("warnings", ())])
    lines.append(f"Files: {folder}")
    return "\n".join(lines)


def _attackers(attackers: Sequence[Mapping[str, Any]]) -> str:
    """Say what each of several attackers did."""
    did = {"touched": "touched the ego", "forced": "forced the contact", "played": "attacked as well"}
    each = (
        f"{a['id']} {did[a['role']]}" + (f" (min TTC {a['min_ttc']:.1f} s)" if a["min_ttc"] else "") for a in attackers
    )
    return f"Attackers: {', '.join(each)}."


def _result(result: Mapping[str, Any]) -> str:
    """Say how the run ended, after how many attempts, and what was wanted."""
    tried, ending = len(result["attempts"]), str(result["ending"])
    of = f" after {tried} of {result['attempts_allowed']} attempts (criterion: {result['goal']})" if tried else ""
    if ending != Ending.GOAL_MET:
        return f"Result: {ending.replace('_', ' ')}{of}. {result['reason']}"
    level = str((result["outcome"] or {}).get("level"))
    reached = "NEAR MISS" if result["goal"].startswith("near miss") else level.upper()
    more = str(result["reason"]).removeprefix(ENDING_SENTENCES[Ending.GOAL_MET])
    return f"Result: {reached}{of}.{more}"


def _overridden(actions: Mapping[str, int]) -> str:
    """Say how often SUMO limited what a driver with ``LaneSpeed`` asked for."""
    steps = actions["LaneSpeed"]
    return f"SUMO's safe speed limited the ego's driver in {actions['limited']} of {steps} steps."


def _before(raw: Mapping[str, Any]) -> str:
    """Describe the baseline."""
    if raw["collided"]:
        return "collision"
    return "no conflict" if raw["min_ttc"] is None else f"min TTC {raw['min_ttc']:.2f} s"


def _after(best: Mapping[str, Any]) -> str:
    """Describe the attempt that counts."""
    if not best["collided"]:
        near = "no conflict" if best["min_ttc"] is None else f"min TTC {best['min_ttc']:.2f} s"
        return f"{near}{_flaws(best)}"
    words = f"collision at {best['contact_time']:.1f} s"
    if best["failed_gates"] or best["rear_end"] or best["preventable_by"] is None:
        return f"{words}, not counted{_flaws(best)}"
    level = [] if best["level"] == "collision" else [str(best["level"])]
    parts = [words, *level, _hard(best["delta_v"], best.get("impact_speed"))]
    parts += ["the ego stood"] if best["ego_stationary"] else []
    parts += ["the ego stood in a junction"] if best["ego_blocking"] else []
    return ", ".join([*parts, _preventable(best["preventable_by"], best["inconclusive"])])


def _hard(delta_v: float | None, impact_speed: float | None) -> str:
    if impact_speed is not None:
        return f"hit at {impact_speed:.1f} m/s"
    return f"delta-v {delta_v:.1f} m/s"


def _preventable(by: Sequence[str], inconclusive: str | None) -> str:
    why = {
        "no_hazard": "inconclusive: no danger showed before the contact",
        "unchanged_ego_misses": "inconclusive: in the check, the unchanged ego misses the adversary",
        "no_plan": "inconclusive: what the adversary planned after the contact is not known",
    }
    if inconclusive:
        return why[inconclusive]
    return f"preventable by {', '.join(by)}" if by else "no reference driver avoids it"


def _flaws(verdict: Mapping[str, Any]) -> str:
    """Say what keeps an attempt from counting."""
    reasons = [g.replace("_", " ") for g in verdict["failed_gates"]]
    reasons += ["rear-end"] if verdict["rear_end"] else []
    return f" ({', '.join(reasons)})" if reasons else ""


# -- a server's events in words


def _doing(event: Mapping[str, Any]) -> str:
    """Describe the activity after an event; '' if it does not change."""
    kind, time = event["event"], event.get("time")
    if kind == "client":
        return "The client drives" if event["state"] == "connected" else "Waiting for a client"
    at = "" if time is None else f"{time:.1f} s: "
    doing = {
        "listening": "Waiting for a client", "encounter": f"{at}deciding", "attack": f"{at}attacking",
        "passed_over": f"{at}watching", "dropped": f"{at}watching", "released": f"{at}watching",
        "ego": f"{at}watching", "again": "The same encounter again",
    }  # fmt: skip
    return doing.get(kind, "")


def served(event: Mapping[str, Any]) -> str:
    """Describe a server's event in words; '' for events that only programs need."""
    kind = event["event"]
    if kind == "listening":
        opens = f"\n{event['opens']}" if event["opens"] else ""
        added = f"\nThe demand has no vehicle '{event['ego']}': your program must add it." if event["added"] else ""
        return f"Waiting at {event['host']}:{event['port']} for the program that drives '{event['ego']}'.{added}{opens}"
    if kind == "status_page":
        return f"Status: http://127.0.0.1:{event['port']}/status"
    if kind == "client":
        return "" if event["state"] == "restarted" or event["again"] else str(event["sentence"])
    if kind == "encounter":
        near = ", ".join(f"{c['id']} ({c['relation']})" for c in event["ranking"])
        return f"Encounter {event['number']} at {event['time']:.1f} s: near {event['ego']} are {near}"
    if kind == "dropped":
        return f"  dropped: {event['reason']}"
    if kind == "outcome":
        return f"  {event['ending']}: {event['folder']}"
    return _served_attempt(event) if kind == "attempt" else ""


def _served_attempt(event: Mapping[str, Any]) -> str:
    """Describe an attempt of a server."""
    outcome = "collision" if event["collided"] else "no conflict"
    if not event["collided"] and event["min_ttc"] is not None:
        outcome = f"min TTC {event['min_ttc']:.2f} s"
    lost = ", the client was lost" if event["ending"] == "ego_lost" else ""
    who = f"{event['adversary']}: {event['intent']}/{event['mode']}"
    helped = "".join(f" + {q['id']}: {q['intent']}" for q in event.get("supports", ()))
    return f"  attempt {event['index'] + 1:2d} [{event['by']}] {who}{helped}, {outcome}{lost}"
