"""Similarity of texts and of intents: stems, phrases, distances by hand, speed at 5,000 entries."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from sumo_adv.memory.similarity import TextAndSlots, TfIdf, term_counts
from sumo_adv.memory.words import stem, text_features


@pytest.mark.parametrize(
    ("words", "root"),
    [
        ("brake brakes braked braking", "brak"),
        ("stop stops stopped stopping", "stop"),
        ("hurry hurries hurried", "hurri"),
        ("sudden suddenly", "sudden"),
        ("sharp sharply", "sharp"),
        ("decelerate decelerates decelerating deceleration", "deceler"),
        ("merge merges merging", "merg"),
    ],
)
def test_forms_of_a_word_have_one_stem(words: str, root: str) -> None:
    assert {stem(word) for word in words.split()} == {root}


def test_the_longest_phrase_wins_and_stop_words_vanish() -> None:
    assert list(text_features("The zebra drives head-on")) == ["zebra", "@oncoming"]
    assert list(text_features("in front of us it stops")) == ["@ahead", "@brake"]
    assert list(text_features("... 42 !")) == []


def test_counts_of_label_and_description_are_damped() -> None:
    counts = term_counts("Braking", "brakes, brakes; zebra")
    assert counts == {"@brake": pytest.approx(1 + math.log(3)), "zebra": pytest.approx(1.0)}


def test_distances_by_hand() -> None:
    metric = TfIdf()
    metric.fit([("zebra", ""), ("zebra lion", ""), ("oncoming", "")])
    distances = metric.distances("zebra", "")
    # idf(zebra) = ln(4/3) + 1 = 1.287682, idf(lion) = ln(4/2) + 1 = 1.693147, equal counts:
    # cos = 1.287682 / sqrt(1.287682^2 + 1.693147^2) = 0.605348
    assert distances == pytest.approx([0.0, 1 - 0.605348, 1.0], abs=1e-6)
    assert metric.distances("", "") == pytest.approx([1.0, 1.0, 1.0])
    metric.fit([])
    assert metric.distances("zebra", "").shape == (0,)


def test_a_word_nobody_knows_makes_the_distance_larger() -> None:
    metric = TfIdf()
    metric.fit([("brakes", ""), ("left turn", "")])
    distance = metric.distances("brakes", "")[0]
    assert distance == pytest.approx(0.0, abs=1e-12)
    assert metric.distances("brakes xylophone", "")[0] > 0.05


def test_a_contradiction_in_a_slot_makes_the_distance_larger() -> None:
    metric = TextAndSlots()
    metric.fit([("quartz", "")])
    # idf(quartz) = ln(2/2) + 1 = 1, idf of an unknown word = ln 2 + 1 = 1.693147:
    # cos = 1 / sqrt(1 + 1.693147^2) = 0.508542
    assert metric.distances("quartz xylophone", "") == pytest.approx([1 - 0.508542], abs=1e-6)
    assert metric.distances("quartz reversing", "") == pytest.approx([1 - 0.4 * 0.508542], abs=1e-6)
    # two unknown words, two slots: cos = 1 / sqrt(1 + 2 * 1.693147^2) = 0.385372
    assert metric.distances("quartz reversing roundabout", "") == pytest.approx([1 - 0.4**2 * 0.385372], abs=1e-6)


def test_a_manoeuvre_must_be_mentioned_and_a_place_need_not_be() -> None:
    plain, metric = TfIdf(), TextAndSlots()
    entries = [("quartz reversing", ""), ("quartz roundabout", ""), ("quartz reversing or skidding", "")]
    plain.fit(entries)
    metric.fit(entries)
    cosines = 1 - plain.distances("quartz", "")
    assert metric.distances("quartz", "") == pytest.approx(1 - cosines * [0.4, 1.0, 0.4])
    cosines = 1 - plain.distances("reversing", "")
    assert metric.distances("reversing", "") == pytest.approx(1 - cosines * [1.0, 0.4, 1.0])  # one in common is enough
    metric.fit([])
    assert metric.distances("quartz", "").shape == (0,)


def test_five_thousand_entries_are_searched_in_under_a_millisecond() -> None:
    rng = np.random.default_rng(0)
    vocabulary = [f"{a}{b}{c}" for a in "bdfgklm" for b in "aeiou" for c in ("rt", "nk", "st", "lm", "mp", "sk")]
    words = [*vocabulary, "brakes", "oncoming", "lane", "sudden", "front"]
    entries = [(" ".join(rng.choice(words, 3)), " ".join(rng.choice(words, 25))) for _ in range(5000)]
    metric = TextAndSlots()
    metric.fit(entries)
    seconds = []
    for entry in entries[:50]:
        start = time.process_time()
        distances = metric.distances(*entry)
        seconds.append(time.process_time() - start)
    assert distances.shape == (5000,)
    assert distances[49] == pytest.approx(0.0, abs=1e-12)
    assert float(np.median(seconds)) < 1e-3
