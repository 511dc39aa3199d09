"""Ways through junctions: from the end of one stretch along spans to the start of the next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sumo_adv.womd.network.cutting import Spans
from sumo_adv.womd.network.rows import Stretch

MAX_WAYS = 200  # looked at from one stretch
MAX_SPANS = 12  # in one way

Leg = tuple[int, int]  # strand, index of its span


@dataclass(frozen=True, slots=True)
class Way:
    """A connection: the stretches it joins and the spans between, with its length [m]."""

    source: Stretch
    target: Stretch
    legs: tuple[Leg, ...]
    length: float


def find_ways(spans: Spans) -> tuple[list[Way], list[Way]]:
    """The way kept for each pair of stretches, the shortest; and those left over."""
    starts = {(s.number, a): Stretch(s.number, a, b) for s in spans.strands for a, b in spans.stretches(s.number)}
    kept: dict[tuple[Stretch, Stretch], Way] = {}
    over: list[Way] = []
    for stretch in starts.values():
        for way in _from(spans, stretch, starts):
            pair = way.source, way.target
            if pair not in kept:
                kept[pair] = way
            elif way.length < kept[pair].length:
                over.append(kept[pair])
                kept[pair] = way
            else:
                over.append(way)
    return list(kept.values()), over


def _from(spans: Spans, source: Stretch, starts: dict[tuple[int, float], Stretch]) -> Iterator[Way]:
    """All ways from the end of ``source``, depth first."""
    stack: list[tuple[int, float, tuple[Leg, ...], float]] = [(source.strand, source.end, (), 0.0)]
    count = 0
    while stack and count < MAX_WAYS:
        strand, station, legs, length = stack.pop()
        at_end = station >= spans.strands[strand].length - 1e-9
        follow = [(e, 0.0) for e in spans.strands[strand].exits] if at_end else [(strand, station)]
        for number, start in follow:
            k = next((k for k, (a, _) in enumerate(spans.of[number]) if abs(a - start) < 1e-9), None)
            if k is None:
                if (number, start) in starts:
                    count += 1
                    yield Way(source, starts[number, start], legs, length)
            elif (number, k) not in legs and len(legs) < MAX_SPANS:
                a, b = spans.of[number][k]
                stack.append((number, b, (*legs, (number, k)), length + b - a))
