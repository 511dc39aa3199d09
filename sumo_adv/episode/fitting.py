"""Whether the attempts of an encounter are what was asked for: by rules, and where a model plays along, by its reading.

An attempt that does not fit has ``Verdict.misfits``, and meets no goal (``Goal.reached``), so that the search goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sumo_adv.agents.agents import Agents, Bought
from sumo_adv.asked import Asked
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Level, Proposal
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.goal import Goal
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.simulation.recording import tracks_of
from sumo_adv.words.motion import Motion, Scene, misfits, observe
from sumo_adv.words.request import Reading, read_motion

MOST_READINGS = 2  # attempts of an encounter that a model is asked about
Reader = Callable[[Motion], Reading]
"""Reads a motion and says whether it fits the request. Raises ModelError."""


@dataclass
class Fitting:
    """Compares the attempts of one encounter with the request. ``reader`` is asked where the rules find nothing;
    ``readings`` has its answers by the index of the attempt."""

    asked: Asked
    found: FoundEncounter
    settings: Settings
    reader: Reader | None = None
    readings: dict[int, Reading] = field(default_factory=dict, init=False)

    def judged(self, attempt: Attempt, result: AttemptResult, goal: Goal, *, read: bool = True) -> Attempt:
        """The attempt with what it lacks of the request, if it would be a success or comes near one; ``read``: the
        reader may be asked."""
        if attempt.verdict.level < Level.CRITICAL and not goal.met(attempt.verdict):
            return attempt
        motion = motion_of(attempt, result, self.found, self.settings)
        lacks = ("The adversary or the ego was gone at once.",) if motion is None else misfits(self.asked, motion)
        if (
            read
            and not lacks
            and motion is not None
            and goal.met(attempt.verdict)
            and len(self.readings) < MOST_READINGS
        ):
            lacks = self._read(attempt.index, motion)
        return replace(attempt, verdict=replace(attempt.verdict, misfits=lacks))

    def _read(self, index: int, motion: Motion) -> tuple[str, ...]:
        if self.reader is None:
            return ()
        reading = self.readings[index] = self.reader(motion)
        return () if reading.fits else (reading.lacks or reading.happened,)


def reader_of(agents: Agents, words: str) -> Reader | None:
    """The model that plays the analyzer as a reader; None if none does, or without words."""
    if not agents.by_model("analyzer") or not words:
        return None
    metered = MeteredModel(agents.models["analyzer"], agents.ledger)

    def read(motion: Motion) -> Reading:
        reading = read_motion(metered, agents.prompts, motion.words, words)
        agents.bought.append(Bought("reader", "it fits" if reading.fits else "it does not fit"))
        return reading

    return read


def motion_of(attempt: Attempt, result: AttemptResult, found: FoundEncounter, settings: Settings) -> Motion | None:
    """What happened in an attempt; None if the ego or the adversary was gone at once."""
    p, start, end = attempt.proposal, result.start, attempt.verdict.contact_time
    situation = found.situations.get(p.delay)
    target = None if situation is None else situation.targets.get(p.bv)
    if situation is None or target is None:
        return None
    tracks = {t.id: t for t in tracks_of(result.snapshots, result.sizes, {}, settings.step_length)}
    last = float("inf") if end is None else end
    cut = {name: t.between(start, last) for name, t in tracks.items()}
    if found.ego not in cut or p.bv not in cut:
        return None
    others = [t for name, t in cut.items() if name not in (found.ego, p.bv)]
    first = found.first.targets.get(p.bv, target)
    return observe(
        Scene(
            cut[found.ego], cut[p.bv], others, situation.baseline.path, first.relation, first.hidden,
            attempt.verdict.contact_side if attempt.verdict.collided else None, start,
            _red_at(p, result, found, cut[p.bv].time[0] if len(cut[p.bv].time) else start),
        )
    )  # fmt: skip


def _red_at(p: Proposal, result: AttemptResult, found: FoundEncounter, begun: float) -> float | None:
    """When the adversary passes its stop line on red [s]; None if it does not, or if its light changes before."""
    situation = found.situations[p.delay]
    signals = situation.traffic.signals.get(p.bv, ())
    if not signals or signals[0][2] not in "ru":
        return None
    light, distance, _ = signals[0]
    gone, before, shown = 0.0, None, None
    for snapshot in result.snapshots:
        if snapshot.time < begun or p.bv not in snapshot.raw:
            continue
        x, y = snapshot.raw[p.bv][0], snapshot.raw[p.bv][1]
        gone += 0.0 if before is None else ((x - before[0]) ** 2 + (y - before[1]) ** 2) ** 0.5
        before, state = (x, y), snapshot.lights.get(light)
        if shown is not None and state is not None and state != shown:
            return None
        shown = shown or state
        if gone > distance:
            return snapshot.time
    return None
