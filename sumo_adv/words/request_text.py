"""The words of a person: checked before they are sent to a model or kept in a file."""

from __future__ import annotations

from sumo_adv.asked import LONGEST_WORDS
from sumo_adv.errors import UsageError


def checked_words(text: str) -> str:
    """The words without control characters, as one paragraph. Raises UsageError for none, and for too many."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    if not any(c.isalpha() for c in plain):
        raise UsageError("The request holds no words: say in a sentence or two what is to happen on the road.")
    if len(plain) > LONGEST_WORDS:
        raise UsageError(
            f"The request has {len(plain)} characters, and at most {LONGEST_WORDS} are read: shorten it to what "
            "happens on the road."
        )
    return plain
