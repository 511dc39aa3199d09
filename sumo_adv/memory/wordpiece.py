"""From text to the numbers of a BERT vocabulary: normalise, split at spaces and signs, longest pieces first.

The steps of BERT's own tokenizer (Devlin et al., 2019; WordPiece: Schuster and Nakajima, 2012).
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping

LONGEST_WORD = 100  # characters; longer ones are unknown
_CJK = (
    (0x4E00, 0x9FFF), (0x3400, 0x4DBF), (0x20000, 0x2A6DF), (0x2A700, 0x2B73F), (0x2B740, 0x2B81F), (0x2B820, 0x2CEAF),
    (0xF900, 0xFAFF), (0x2F800, 0x2FA1F),
)  # fmt: skip


class WordPiece:
    """A tokenizer. ``vocabulary``: piece -> number, with [CLS], [SEP] and [UNK]; pieces within a word begin with ##."""

    def __init__(self, vocabulary: Mapping[str, int], *, lower: bool = True) -> None:
        self._vocabulary = vocabulary
        self._lower = lower
        self._unknown = vocabulary["[UNK]"]

    def numbers(self, text: str, most: int) -> list[int]:
        """The numbers of ``text`` between [CLS] and [SEP], at most ``most`` in all."""
        pieces: list[int] = []
        for word in self._words(text):
            pieces += self._pieces(word)
        return [self._vocabulary["[CLS]"], *pieces[: most - 2], self._vocabulary["[SEP]"]]

    def _words(self, text: str) -> list[str]:
        parts: list[str] = []
        for c in text:
            if c in "\t\n\r" or unicodedata.category(c) == "Zs":
                parts.append(" ")
            elif c in "\0\ufffd" or unicodedata.category(c).startswith("C"):
                continue
            else:
                parts.append(f" {c} " if any(low <= ord(c) <= high for low, high in _CJK) else c)
        clean = "".join(parts)
        if self._lower:
            clean = "".join(c for c in unicodedata.normalize("NFD", clean) if unicodedata.category(c) != "Mn").lower()
        return "".join(f" {c} " if _is_sign(c) else c for c in clean).split()

    def _pieces(self, word: str) -> list[int]:
        if len(word) > LONGEST_WORD:
            return [self._unknown]
        pieces: list[int] = []
        at = 0
        while at < len(word):
            for end in range(len(word), at, -1):
                number = self._vocabulary.get(("##" if at else "") + word[at:end])
                if number is not None:
                    pieces.append(number)
                    at = end
                    break
            else:
                return [self._unknown]
        return pieces


def _is_sign(c: str) -> bool:
    return unicodedata.category(c).startswith("P") or (c.isascii() and c.isprintable() and not c.isalnum() and c != " ")
