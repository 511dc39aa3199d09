"""A sentence-embedding model from a folder in the layout of sentence-transformers, run with numpy alone.

Any BERT encoder with a WordPiece vocabulary and mean or first-token pooling: all-MiniLM, bge, gte, e5 and their like.
Files: ``config.json``, ``model.safetensors``, ``vocab.txt`` or ``tokenizer.json``, and where they are there
``tokenizer_config.json``, ``sentence_bert_config.json`` and ``1_Pooling/config.json``.  Devlin et al., 2019.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.memory.wordpiece import WordPiece

LARGEST_HEADER = 10_000_000  # bytes
TYPES: Mapping[str, str] = {"F32": "<f4", "F16": "<f2", "F64": "<f8"}
Weights = NDArray[np.float32]


class SentenceModel:
    """An encoder in memory. ``name``: the folder's and the first digits of a hash of its weights."""

    def __init__(self, folder: Path) -> None:
        """Read the model. Raises UsageError: no such folder, a file missing or damaged, another architecture."""
        try:
            config = _json(folder / "config.json")
            if config.get("model_type") != "bert" or config.get("hidden_act", "gelu") != "gelu":
                raise UsageError(f"The model in {folder} is no BERT encoder; use all-MiniLM-L6-v2 or another such one.")
            self._tensors, digest = _tensors(folder / "model.safetensors")
            self._layers, self._heads = int(config["num_hidden_layers"]), int(config["num_attention_heads"])
            self._tiny = float(config.get("layer_norm_eps", 1e-12))
            self._words = _tokenizer(folder)
            positions = len(self._tensor("embeddings.position_embeddings.weight"))
            longest = _json(folder / "sentence_bert_config.json", there=False).get("max_seq_length") or positions
            self._most = max(3, min(positions, int(longest)))
            self._first_token = bool(
                _json(folder / "1_Pooling" / "config.json", there=False).get("pooling_mode_cls_token")
            )
            self.name = f"{folder.resolve().name}-{digest[:8]}"
            self._encode("Tried once, so that a missing part is named now.")
        except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
            raise UsageError(
                f"The folder {folder} holds no sentence model that can be used ({_why(error)}); "
                "give one in the layout of sentence-transformers."
            ) from error

    def embed(self, texts: Sequence[str]) -> Floats:
        """A vector a text, shape (n, d)."""
        return np.stack([self._encode(text) for text in texts]).astype(np.float64)

    def _encode(self, text: str) -> Weights:
        numbers = self._words.numbers(text, self._most)
        e = "embeddings."
        x = self._tensor(f"{e}word_embeddings.weight")[numbers]
        x = x + self._tensor(f"{e}position_embeddings.weight")[: len(numbers)]
        x = self._norm(x + self._tensor(f"{e}token_type_embeddings.weight")[0], f"{e}LayerNorm")
        for layer in range(self._layers):
            x = self._block(x, f"encoder.layer.{layer}.")
        return x[0] if self._first_token else np.asarray(x.mean(axis=0))

    def _block(self, x: Weights, at: str) -> Weights:
        q, k, v = (self._heads_of(self._dense(x, f"{at}attention.self.{part}")) for part in ("query", "key", "value"))
        scores = q @ k.transpose(0, 2, 1) / np.sqrt(q.shape[-1])
        scores = np.exp(scores - scores.max(axis=-1, keepdims=True))
        mixed = (scores / scores.sum(axis=-1, keepdims=True)) @ v
        mixed = mixed.transpose(1, 0, 2).reshape(x.shape)
        x = self._norm(x + self._dense(mixed, f"{at}attention.output.dense"), f"{at}attention.output.LayerNorm")
        inner = self._dense(x, f"{at}intermediate.dense")
        inner = inner * 0.5 * (1.0 + erf(inner / np.sqrt(2.0, dtype=np.float32)))
        return self._norm(x + self._dense(inner, f"{at}output.dense"), f"{at}output.LayerNorm")

    def _heads_of(self, x: Weights) -> Weights:
        """(n, d) -> (heads, n, d / heads)."""
        return x.reshape(len(x), self._heads, -1).transpose(1, 0, 2)

    def _dense(self, x: Weights, name: str) -> Weights:
        return x @ self._tensor(f"{name}.weight").T + self._tensor(f"{name}.bias")

    def _norm(self, x: Weights, name: str) -> Weights:
        centred = x - x.mean(axis=-1, keepdims=True)
        scale = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + self._tiny)
        return centred / scale * self._tensor(f"{name}.weight") + self._tensor(f"{name}.bias")

    def _tensor(self, name: str) -> Weights:
        tensor = self._tensors.get(name)
        return self._tensors[f"bert.{name}"] if tensor is None else tensor


def _why(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{Path(str(error.filename)).name}: {(error.strerror or 'cannot be read').lower()}"
    return f"there is no {error}" if isinstance(error, KeyError) else str(error)


def _json(file: Path, *, there: bool = True) -> dict[str, Any]:
    """The object in a file; empty if it need not be ``there``."""
    if not there and not file.exists():
        return {}
    value = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(value, dict):
        raise ValueError(f"{file.name} holds no object")
    return value


def _tokenizer(folder: Path) -> WordPiece:
    lower = bool(_json(folder / "tokenizer_config.json", there=False).get("do_lower_case", True))
    if (folder / "vocab.txt").exists():
        pieces = (folder / "vocab.txt").read_text(encoding="utf-8").split("\n")
        return WordPiece({piece.rstrip("\r"): i for i, piece in enumerate(pieces)}, lower=lower)
    model = _json(folder / "tokenizer.json")["model"]
    if model.get("type", "WordPiece") != "WordPiece":
        raise ValueError("its tokenizer is no WordPiece")
    return WordPiece(model["vocab"], lower=lower)


def _tensors(file: Path) -> tuple[Mapping[str, Weights], str]:
    """The tensors of a safetensors file (8 bytes: size of a JSON header; the header; the data), and its SHA-256."""
    raw = file.read_bytes()
    size = int.from_bytes(raw[:8], "little")
    if not 0 < size <= min(LARGEST_HEADER, len(raw) - 8):
        raise ValueError(f"{file.name} is no safetensors file")
    header: dict[str, Any] = json.loads(raw[8 : 8 + size])
    tensors = {}
    for name, entry in header.items():
        if name == "__metadata__" or entry["dtype"] not in TYPES:
            continue  # whole numbers such as position ids are not needed
        begin, end = entry["data_offsets"]
        values = np.frombuffer(raw[8 + size + begin : 8 + size + end], np.dtype(TYPES[entry["dtype"]]))
        tensors[name] = values.astype(np.float32).reshape(entry["shape"])
    return tensors, hashlib.sha256(raw).hexdigest()
