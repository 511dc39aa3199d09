"""d(phi, phi_j) from vectors: 1 - cosine of what an embedding model makes of "label. description".

The model is an object handed in (an endpoint's client, a local sentence model); vectors of the bank's entries are kept
in RAM.  There is no epsilon for a model until ``memory calibrate --metric NAME --store`` has measured one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import ModelError


class Embedder(Protocol):
    """Makes vectors of texts. ``name`` says which model, and is the same wherever that model is."""

    @property
    def name(self) -> str:
        """Part of the metric's name."""
        ...

    def embed(self, texts: Sequence[str]) -> Floats:
        """A vector a text, shape (n, d), of any length. Raises ModelError."""
        ...


class Embedded:
    """A metric over intents by an embedding model."""

    epsilon: float | None = None
    calibrated_on = ""

    def __init__(self, embedder: Embedder, kind: str) -> None:
        """``kind``: where the model is, ``endpoint`` or ``local``."""
        self.name = f"{kind}:{embedder.name}"
        self._embedder = embedder
        self._vectors: dict[str, Floats] = {}
        self._matrix: Floats = np.zeros((0, 0))

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Take the (label, description) pairs of the bank; vectors of known entries are reused. Raises ModelError."""
        texts = [_text(*entry) for entry in entries]
        lacking = list(dict.fromkeys(text for text in texts if text not in self._vectors))
        vectors = {text: self._vectors[text] for text in texts if text in self._vectors}
        if lacking:
            vectors.update(zip(lacking, self._embed(lacking), strict=True))
        self._vectors = vectors
        self._matrix = np.stack([vectors[text] for text in texts]) if texts else np.zeros((0, 0))

    def distances(self, label: str, description: str) -> Floats:
        """1 - cosine to each fitted entry, brought into [0, 1], shape (n,). Raises ModelError."""
        if not len(self._matrix):
            return np.zeros(0)
        vector = self._embed([_text(label, description)])[0]
        if vector.shape != self._matrix.shape[1:]:
            raise ModelError(f"The embedding model {self.name} changed the length of its vectors; run again.")
        return np.clip(1.0 - self._matrix @ vector, 0.0, 1.0)

    def _embed(self, texts: Sequence[str]) -> Floats:
        """Unit vectors, shape (n, d)."""
        vectors = np.asarray(self._embedder.embed(texts), dtype=np.float64)
        norms = np.linalg.norm(vectors, axis=-1, keepdims=True) if vectors.ndim == 2 else np.zeros(1)
        if len(vectors) != len(texts) or not np.all(np.isfinite(norms)) or np.any(norms <= 0.0):
            raise ModelError(
                f"The embedding model {self.name} gave vectors that cannot be compared; use another model."
            )
        return vectors / norms


def _text(label: str, description: str) -> str:
    return f"{label}. {description}" if description and description != label else label
