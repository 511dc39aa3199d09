"""Which intents a search may try: those of the settings and of the scenario, without what is excluded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import LibraryEntry
from sumo_adv.errors import UsageError, nearest
from sumo_adv.memory.records import canonical
from sumo_adv.search.composed_intents import COMPOSED
from sumo_adv.search.free_motion import LABEL as FREE_MOTION


@dataclass(frozen=True, slots=True)
class Selection:
    """Labels of intents. only: no others may be tried, None: all may; exclude: these may not."""

    only: frozenset[str] | None = None
    exclude: frozenset[str] = frozenset()

    def allows(self, label: str) -> bool:
        """Whether an intent may be tried."""
        return label not in self.exclude and (self.only is None or label in self.only)

    def names(self, label: str) -> bool:
        """Whether an intent is asked for by its label."""
        return self.only is not None and label in self.only and label not in self.exclude

    @property
    def is_open(self) -> bool:
        """Whether nothing is restricted, so that a language model may invent intents."""
        return self.only is None and not self.exclude

    def of(self, library: Sequence[LibraryEntry]) -> tuple[LibraryEntry, ...]:
        """The entries of a library that may be tried."""
        return tuple(e for e in library if self.allows(e.label))


def select(
    known: Iterable[str], intents: Sequence[str] = (), exclude: Sequence[str] = (), scenario: Sequence[str] = ()
) -> Selection:
    """What the settings ``intents`` and ``exclude`` and the intents of a scenario come to; each is empty for none. The
    setting ``intents`` goes before the scenario's.

    known: labels of the memory bank; those that the expert composes, and free motions, are known as well. Case and
    signs do not count.
    An intent of the scenario that is not known is no error: a bank with fewer intents may run any scenario.

    Raises:
        UsageError: a setting names an intent that is not known, or no intent is left.
    """
    labels = {canonical(label): label for label in (FREE_MOTION, *COMPOSED, *known)}
    chosen, without = (frozenset(_label(name, labels) for name in names) for names in (intents, exclude))
    only = chosen or frozenset(labels.get(canonical(name), name) for name in scenario) or None
    if not (frozenset(labels.values()) if only is None else only) - without:
        source = "the scenario's own list" if scenario and not chosen else "intents"
        raise UsageError(f"No intent is left to try: {source} and exclude together leave none.")
    return Selection(only, without)


def _label(name: str, labels: Mapping[str, str]) -> str:
    """The label that a name means. Raises UsageError with the known ones."""
    label = labels.get(canonical(name))
    if label is None:
        names = ", ".join(sorted(labels.values()))
        raise UsageError(f"There is no intent '{name}'{nearest(name, labels.values())}; known intents are {names}.")
    return label
