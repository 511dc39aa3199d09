"""Metrics by embeddings: distances by hand, a tiny BERT worked out by hand, an endpoint through the command line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER
from cli_samples import ROOT, Program
from model_server import ModelServer

from sumo_adv.datatypes import Floats
from sumo_adv.errors import BankError, ModelError, UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.embeddings import Embedded
from sumo_adv.memory.sentence_model import SentenceModel
from sumo_adv.memory.wordpiece import WordPiece

WORDS = ("brak", "cut", "left")


def counts(text: str) -> list[float]:
    """A vector of how often a text has each of a few words, and a bit of everything."""
    return [float(text.lower().count(word)) for word in WORDS] + [0.1]


class Counting:
    """An embedder that needs no model, and notes the questions."""

    name = "counting"

    def __init__(self) -> None:
        self.asked: list[str] = []

    def embed(self, texts: Sequence[str]) -> Floats:
        self.asked += texts
        return np.asarray([counts(text) for text in texts])


class Same:
    """An embedder that gives whatever it was made with."""

    name = "same"

    def __init__(self, vectors: Any) -> None:
        self._vectors = vectors

    def embed(self, texts: Sequence[str]) -> Floats:
        return np.asarray(self._vectors)


def test_distances_are_one_minus_cosine_and_entries_are_embedded_once() -> None:
    embedder = Counting()
    metric = Embedded(embedder, "local")
    metric.fit([("Braking", "It brakes."), ("Cut-in", "It cuts."), ("Braking", "It brakes.")])
    assert metric.name == "local:counting"
    assert embedder.asked == ["Braking. It brakes.", "Cut-in. It cuts."]
    distances = metric.distances("Brake", "")
    cosine_braking = (2.0 * 1.0 + 0.01) / np.sqrt(4.01 * 1.01)  # (2, 0, 0, .1) with (1, 0, 0, .1)
    cosine_cut_in = 0.01 / np.sqrt(4.01 * 1.01)  # (0, 2, 0, .1) with (1, 0, 0, .1)
    assert distances == pytest.approx([1 - cosine_braking, 1 - cosine_cut_in, 1 - cosine_braking])
    metric.fit([("Cut-in", "It cuts."), ("Left", "")])
    assert embedder.asked[3:] == ["Left"]
    metric.fit([])
    assert metric.distances("x", "y").shape == (0,)


@pytest.mark.parametrize("vectors", [[[0.0, 0.0]], [[np.nan, 1.0]], [[1.0], [1.0]], [1.0], []])
def test_vectors_that_cannot_be_compared_are_refused(vectors: Any) -> None:
    with pytest.raises(ModelError, match="local:same gave vectors that cannot be compared"):
        Embedded(Same(vectors), "local").fit([("a", "b")])


def test_a_bank_has_no_epsilon_for_a_metric_until_it_is_calibrated(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite", similarity=Embedded(Counting(), "local")) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.add(CUT_IN, [CUT_PLANNER])
        with pytest.raises(BankError, match="no epsilon for the metric local:counting"):
            bank.retrieve("Braking hard", "It brakes.")
        bank.set_epsilon(0.3, "a test")
        assert bank.epsilon() == (0.3, "a test")
        assert bank.retrieve("Braking hard", "It brakes.").hit == BRAKING.label
        assert bank.retrieve("Turning left", "It goes left.").hit is None
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert bank.epsilon()[0] != 0.3


PIECES = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "brak", "##es", "hard", ",", "2", "m", "cafe", "超")


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        ("Brakes  hard,", ["brak", "##es", "hard", ","]),
        ("Café\t2m", ["cafe", "[UNK]"]),
        ("超超 m\u200b", ["超", "超", "m"]),
        ("x" * 101, ["[UNK]"]),
        ("hard " * 9, ["hard"] * 6),
        ("", []),
    ],
)
def test_pieces_of_words(text: str, pieces: list[str]) -> None:
    tokenizer = WordPiece({piece: i for i, piece in enumerate(PIECES)})
    assert [PIECES[i] for i in tokenizer.numbers(text, 8)] == ["[CLS]", *pieces, "[SEP]"]


def write_tensors(file: Path, tensors: dict[str, Any]) -> None:
    """A safetensors file of 32 bit floats."""
    header, data = {}, b""
    for name, values in tensors.items():
        raw = np.asarray(values, dtype="<f4")
        header[name] = {"dtype": "F32", "shape": list(raw.shape), "data_offsets": [len(data), len(data) + raw.nbytes]}
        data += raw.tobytes()
    text = json.dumps(header).encode()
    file.write_bytes(len(text).to_bytes(8, "little") + text + data)


def tiny_model(folder: Path, **changed: Any) -> Path:
    """One layer, one head, four numbers a word. Every word looks at all words alike; the inner layer is off.

    [CLS] = (1, 0, 0, 0), [SEP] = (0, 1, 0, 0), hard = (0, 0, 1, 0), [UNK] = (0, 0, 0, 1).
    """
    identity, zeros = np.eye(4), np.zeros((4, 4))
    words = np.zeros((len(PIECES), 4))
    words[2:4] = identity[:2]
    words[6], words[1] = identity[2], identity[3]
    dense = {"attention.self.query": zeros, "attention.self.key": zeros, "attention.self.value": identity,
             "attention.output.dense": identity, "intermediate.dense": zeros, "output.dense": zeros}  # fmt: skip
    tensors: dict[str, Any] = {
        "embeddings.word_embeddings.weight": words,
        "embeddings.position_embeddings.weight": np.zeros((16, 4)),
        "embeddings.token_type_embeddings.weight": np.zeros((2, 4)),
    }
    for name, weight in dense.items():
        tensors |= {f"encoder.layer.0.{name}.weight": weight, f"encoder.layer.0.{name}.bias": np.zeros(4)}
    for name in ("embeddings", "encoder.layer.0.attention.output", "encoder.layer.0.output"):
        tensors |= {f"{name}.LayerNorm.weight": np.ones(4), f"{name}.LayerNorm.bias": np.zeros(4)}
    folder.mkdir()
    write_tensors(folder / "model.safetensors", tensors)
    config = {"model_type": "bert", "num_hidden_layers": 1, "num_attention_heads": 1, "layer_norm_eps": 1e-12} | changed
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "vocab.txt").write_text("\n".join(PIECES) + "\n", encoding="utf-8")
    return folder


def normed(x: Floats) -> Floats:
    return np.asarray((x - x.mean(axis=-1, keepdims=True)) / x.std(axis=-1, keepdims=True))


def test_a_tiny_bert_by_hand(tmp_path: Path) -> None:
    model = SentenceModel(tiny_model(tmp_path / "tiny"))
    x = normed(np.eye(4)[[0, 2, 1]])  # [CLS] hard [SEP]
    x = normed(normed(x + x.mean(axis=0)))  # attention gives everyone the mean
    assert model.embed(["hard", "hard"]) == pytest.approx(np.stack([x.mean(axis=0)] * 2), abs=1e-5)
    assert model.name.startswith("tiny-") and len(model.name) == len("tiny-") + 8
    (tmp_path / "tiny" / "1_Pooling").mkdir()
    (tmp_path / "tiny" / "1_Pooling" / "config.json").write_text('{"pooling_mode_cls_token": true}')
    assert SentenceModel(tmp_path / "tiny").embed(["hard"]) == pytest.approx(x[:1], abs=1e-5)


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("config.json", None, "config.json: no such file"),
        ("config.json", b"[]", "holds no object"),
        ("config.json", b'{"model_type": "mpnet"}', "no BERT encoder"),
        ("model.safetensors", b"short", "no safetensors file"),
        ("model.safetensors", (2).to_bytes(8, "little") + b"{}", "there is no 'bert.embeddings"),
        ("vocab.txt", b"a\nb\n", "there is no '[UNK]'"),
        ("vocab.txt", None, "tokenizer.json: no such file"),
    ],
)
def test_a_folder_that_is_no_model_is_a_sentence(tmp_path: Path, file: str, content: bytes | None, says: str) -> None:
    folder = tiny_model(tmp_path / "tiny")
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_bytes(content)
    with pytest.raises(UsageError) as caught:
        SentenceModel(folder)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_an_endpoint_is_calibrated_and_finds(program: Program) -> None:
    shutil.copy(ROOT / "memory_bank.sqlite", program.folder / "bank.sqlite")
    use = ("--memory", "bank.sqlite", "--metric", "endpoint:test-embed")
    paraphrases = ROOT / "tests" / "data" / "intents_paraphrases.toml"
    with ModelServer(vectors=counts) as server:
        program.variables.update(server.environment())
        uncalibrated = program.here("memory", "find", "It brakes", *use)
        assert (uncalibrated.status, uncalibrated.out) == (2, "")
        assert "no epsilon for the metric endpoint:test-embed" in uncalibrated.err
        stored = json.loads(program.here("memory", "calibrate", paraphrases, *use, "--store", "--json").out)
        assert (stored["metric"], stored["before"], stored["stored"]) == ("endpoint:test-embed", None, True)
        recalled = json.loads(program.here("memory", "find", "It brakes", *use, "--json").out)
        assert recalled["epsilon"] == stored["epsilon"]
        assert recalled["nearest"][0]["label"] == "Emergency Braking"
    down = program.here("memory", "find", "It brakes", *use)
    assert down.status == 1 and "start it, or correct SUMO_ADV_LLM_BASE_URL" in down.err


@pytest.mark.parametrize(
    "command",
    [("list",), ("show", "Emergency Braking"), ("find", "brakes"), ("stats",), ("verify",), ("export", "out"),
     ("merge", "--propose"), ("calibrate", ROOT / "tests" / "data" / "intents_paraphrases.toml"),
     ("retire", "Emergency Braking")],
)  # fmt: skip
def test_a_bank_that_is_not_there_is_not_made_by_looking(program: Program, command: tuple[Any, ...]) -> None:
    done = program.here("memory", *command, "--memory", "typo.sqlite")
    assert (done.status, done.out) == (2, "")
    assert done.err == "sumo-adv: There is no memory bank at typo.sqlite; check the path given with --memory.\n"
    assert list(program.folder.glob("typo*")) == []
