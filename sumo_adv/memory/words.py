"""From text to features: words, stop words, a small stemmer, and a thesaurus of driving.

The stemmer follows the shape of Porter's (M. F. Porter, "An algorithm for suffix stripping", 1980): plural, -ed/-ing,
-y, then one derivational ending, each only where enough of the word is left.  It is meant for behaviours in traffic,
a few sentences of plain English; it need not agree with Porter's on anything else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache

from sumo_adv.memory.thesaurus import CONCEPTS, STOP_WORDS

CONCEPT_MARK = "@"

_WORD = re.compile(r"[a-z]+")
_VOWEL = re.compile(r"[aeiouy]")
_MEASURE = re.compile(r"[aeiouy]+[^aeiouy]+")
_SUFFIXES = (
    ("ational", ""), ("ization", ""), ("fulness", ""), ("ousness", ""), ("iveness", ""), ("ively", ""), ("ently", ""),
    ("antly", ""), ("fully", ""), ("lessly", ""), ("ously", ""), ("ation", ""), ("ingly", ""), ("ally", ""),
    ("ness", ""), ("ment", ""), ("able", ""), ("ible", ""), ("edly", ""), ("ion", ""), ("ous", ""), ("ive", ""),
    ("ful", ""), ("less", ""), ("ily", "y"), ("ant", ""), ("ent", ""), ("ate", ""), ("ly", ""), ("al", ""), ("er", ""),
    ("or", ""),
)  # fmt: skip


@lru_cache(maxsize=65536)
def stem(word: str) -> str:
    """The stem of a lower-case word: ``braking``, ``brakes`` and ``braked`` are all ``brak``."""
    if len(word) <= 3:
        return word
    word = _past_or_progressive(_singular(word))
    for suffix, ending in _SUFFIXES:
        if word.endswith(suffix) and len(_MEASURE.findall(word[: -len(suffix)])) >= 1 and len(word) - len(suffix) >= 4:
            word = word[: -len(suffix)] + ending
            break
    if word.endswith("y") and _VOWEL.search(word[:-1]):
        word = word[:-1] + "i"
    if word.endswith("e") and len(word) > 4:
        word = word[:-1]
    return _without_double(word) if len(word) > 4 else word


def _singular(word: str) -> str:
    if word.endswith("sses"):
        return word[:-2]
    if word.endswith("ies"):
        return word[:-3] + ("y" if len(word) > 4 else "ie")
    if word.endswith("s") and not word.endswith(("ss", "us", "is")):
        return word[:-1]
    return word


def _past_or_progressive(word: str) -> str:
    for suffix in ("ing", "ed"):
        root = word[: -len(suffix)]
        if word.endswith(suffix) and _VOWEL.search(root) and len(root) >= 3:
            return root if _MEASURE.findall(root) and not root.endswith(("at", "iz")) else root + "e"
    return word


def _without_double(word: str) -> str:
    double = word[-1] == word[-2] and word[-1] not in "aeiouls"
    return word[:-1] if double else word


_STOPS = frozenset(STOP_WORDS) | frozenset(stem(word) for word in STOP_WORDS)


def _phrases() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Stemmed words of each entry of the thesaurus -> its concepts."""
    table: dict[tuple[str, ...], list[str]] = {}
    for concept, entries in CONCEPTS.items():
        for entry in entries.split(","):
            key = tuple(stem(word) for word in _WORD.findall(entry))
            names = table.setdefault(key, [])
            if concept not in names:
                names.append(concept)
    return {key: tuple(names) for key, names in table.items()}


_PHRASES = _phrases()
_LONGEST = max(len(key) for key in _PHRASES)


def features(text: str) -> Iterator[str]:
    """Features in order of the text: ``@concept`` for each word or phrase that the thesaurus knows (longest phrase
    first), the bare stem for each other word that is no stop word."""
    raw = _WORD.findall(text.casefold().replace("'", ""))
    stems = [stem(word) for word in raw]
    at = 0
    while at < len(stems):
        for size in range(min(_LONGEST, len(stems) - at), 0, -1):
            if names := _PHRASES.get(tuple(stems[at : at + size])):
                yield from (CONCEPT_MARK + name for name in names)
                at += size
                break
        else:
            if raw[at] not in _STOPS and stems[at] not in _STOPS and len(raw[at]) > 1:
                yield stems[at]
            at += 1
