"""What a person sees while a run goes on, and at its end. In pipes: plain lines; with --json: nothing."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import typer

from sumo_adv.cli.shown import Shown
from sumo_adv.datatypes import ENDING_SENTENCES, Attempt, Ending, Level
from sumo_adv.episode.assessment import rank


class Reporter(Protocol):
    """Told what happens."""

    def tell(self, what: str, value: Any) -> None:
        """``encounter``, ``intents`` or ``attempt``."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Silent(Shown):
    """Says nothing."""

    def tell(self, what: str, value: Any) -> None:
        """Nothing."""


class Lines(Silent):
    """One line an event; of attempts, those that are better than all before in the encounter."""

    def __init__(self) -> None:
        self._best = Best()

    def tell(self, what: str, value: Any) -> None:
        """Print it."""
        text = line(what, value)
        if text and self._best.shows(what, value):
            typer.echo(text)


class Best:
    """Which attempts are worth a line: the first, and each that came to more than all before in its encounter."""

    def __init__(self, seconds: float = math.inf) -> None:
        """``seconds``: that attempts may take in an encounter."""
        self._seconds = seconds
        self._begin()

    def _begin(self) -> None:
        self.attempts, self.level, self._began = 0, Level.NONE, time.perf_counter()
        self._rank: tuple[float, float] | None = None

    def shows(self, what: str, value: Any) -> bool:
        """Whether an event gets a line."""
        if what == "encounter":
            self._begin()
        if what != "attempt":
            return True
        self.attempts += 1
        self.level = max(self.level, value.verdict.level)
        new = rank(value.verdict)
        better = self._rank is None or new < self._rank
        self._rank = new if better else self._rank
        return better

    def words(self) -> str:
        """Attempts so far, how fast they are made, the best level and the seconds that are left."""
        took = time.perf_counter() - self._began
        pace, left = self.attempts / max(took, 1e-3), max(self._seconds - took, 0.0)
        until = f"{took:.0f} s so far" if math.isinf(left) else f"{left:.0f} s left"
        return f"Attacking: {self.attempts} attempts, {pace:.0f} a second, best level {self.level}, {until} ..."


class Live(Silent):
    """Lines above a spinner, in a terminal."""

    def __init__(self, seconds: float) -> None:
        from rich.console import Console

        self._console, self._best = Console(highlight=False), Best(seconds)
        self._display = self._console.status("Looking for an encounter ...")

    def tell(self, what: str, value: Any) -> None:
        """Print it, and say what comes next."""
        text = line(what, value)
        if text and self._best.shows(what, value):
            self._console.print(text, markup=False)
        self._display.update(self._best.words())


def make_reporter(*, quiet: bool, seconds: float = math.inf) -> Reporter:
    """Silent with --json, live in a terminal, lines in a pipe. ``seconds``: that attempts may take in an encounter."""
    if quiet:
        return Silent()
    return Live(seconds) if sys.stdout.isatty() else Lines()


def line(what: str, value: Any) -> str:
    """An event in words."""
    if what == "encounter":
        near = ", ".join(f"{i} ({r})" for i, r, _ in value.ranking)
        earlier = len(value.passed_over)
        passed = f" after passing over {earlier} earlier encounter{'s' * (earlier != 1)}" if earlier else ""
        left_out = f"; SUMO crashes on {', '.join(value.beside)}, so it does not drive there" if value.beside else ""
        return f"Encounter at {value.time:.1f} s{passed}: ego {value.ego}; near it {near}{left_out}"
    if what == "intents":
        top = value[0]
        return f"Most dangerous: {top.bv} — {top.label} (risk {top.risk}; {top.reason})"
    return _attempt(value) if what == "attempt" else ""


def _attempt(a: Attempt) -> str:
    v, p = a.verdict, a.proposal
    outcome = "collision" if v.collided else (f"min TTC {v.min_ttc:.2f} s" if v.min_ttc < 100 else "no conflict")
    if v.collided and v.preventability is not None:
        who = _preventable(v.preventability.by, v.preventability.inconclusive)
        level = "" if v.level is Level.COLLISION else f"{v.level}, "
        outcome += f" ({level}{_hard(v.delta_v, v.impact_speed)}, {who})"
    gates = f", not feasible: {', '.join(v.failed_gates)}" if v.failed_gates else ""
    rear = ", rear-end" if v.rear_end else ""
    helped = "".join(f" + {q.bv}: {q.label}" for q in p.supports)
    return f"  attempt {a.index + 1:2d} [{p.by}] {p.bv}: {p.label}/{p.planner.mode}{helped}, {outcome}{rear}{gates}"


def summary(result: Mapping[str, Any], folder: Path) -> str:
    """The outcome in a few lines."""
    lines = [_result(result)]
    tried = result.get("encounters_tried") or []
    if tried:
        each = "; ".join(f"{t['time']:.1f} s ({t['level']} in {t['attempts']} attempts)" for t in tried)
        lines.append(f"Encounters tried without success: {len(tried)}. {each}.")
    raw, best = result["raw"], result["outcome"]
    if best is not None and raw is not None:
        intent = result["intent"]
        lines.append(f"{intent['label']} by {intent['bv']}. Baseline: {_before(raw)}. Attacked: {_after(best)}.")
    asked = result.get("asked")
    if best is not None and asked is not None:
        lines.append(f"As asked: {'yes.' if asked['fits'] else 'no. ' + ' '.join(asked['misfits'])}")
    if best is not None and best.get("cause"):
        lines.append(f"Why: {best['cause']['sentence']}")
    if (robust := result.get("robust")) is not None:
        lines.append(f"It holds in {robust['held']} of {robust['of']} neighbours (slightly other numbers or timing).")
    for success in result["successes"] if len(result["successes"]) > 1 else ():
        path = f" ({folder / success['folder']})" if success["folder"] else ""
        lines.append(f"Attack of attempt {success['attempt'] + 1}: {success['kind']}{path}.")
    lines += [_overridden(result["ego_actions"])] if (result.get("ego_actions") or {}).get("LaneSpeed") else []
    lines.append(result["agents"]["note"])
    if result["encounter"] is not None and not result["forked"]:
        lines.append("Attempts were loaded and repeated, not forked: slower, the same result.")
    lines += [result["bank_change"]] if result.get("bank_change") else []
    lines.append(f"Files: {folder}")
    return "\n".join(lines)


def _result(result: Mapping[str, Any]) -> str:
    """How the run ended, after how many attempts, and what was wanted."""
    tried, ending = len(result["attempts"]), str(result["ending"])
    of = f" after {tried} of {result['attempts_allowed']} attempts (criterion: {result['goal']})" if tried else ""
    if ending != Ending.CRITICAL:
        return f"Result: {ending.replace('_', ' ')}{of}. {result['reason']}"
    level = str((result["outcome"] or {}).get("level"))
    reached = "NEAR MISS" if result["goal"].startswith("near miss") else level.upper()
    more = str(result["reason"]).removeprefix(ENDING_SENTENCES[Ending.CRITICAL])
    return f"Result: {reached}{of}.{more}"


def _overridden(actions: Mapping[str, int]) -> str:
    """How often SUMO did not do what a driver that answers with ``LaneSpeed`` asked for."""
    steps = actions["LaneSpeed"]
    return f"SUMO's safe speed limited what the ego's driver asked for in {actions['limited']} of {steps} steps."


def _before(raw: Mapping[str, Any]) -> str:
    """The unattacked run in words."""
    if raw["collided"]:
        return "collision"
    return "no conflict" if raw["min_ttc"] is None else f"min TTC {raw['min_ttc']:.2f} s"


def _after(best: Mapping[str, Any]) -> str:
    """The attempt that counts in words."""
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
    """How hard a collision is, in words."""
    if impact_speed is not None:
        return f"hit at {impact_speed:.1f} m/s"
    return f"delta-v {delta_v:.1f} m/s"


def _preventable(by: Sequence[str], inconclusive: str | None) -> str:
    """The drivers that avoid it, in words."""
    why = {
        "no_hazard": "inconclusive: no danger showed before the contact",
        "unchanged_ego_misses": "inconclusive: the unchanged ego misses in the check",
        "no_plan": "inconclusive: what the adversary planned after the contact is not known",
    }
    if inconclusive:
        return why[inconclusive]
    return f"preventable by {', '.join(by)}" if by else "no reference driver avoids it"


def _flaws(verdict: Mapping[str, Any]) -> str:
    """What keeps an attempt from counting."""
    reasons = [g.replace("_", " ") for g in verdict["failed_gates"]]
    reasons += ["rear-end"] if verdict["rear_end"] else []
    return f" ({', '.join(reasons)})" if reasons else ""
