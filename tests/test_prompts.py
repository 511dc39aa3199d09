"""Prompts of models and the checks of their answers, without a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_samples import Answers
from situation_samples import changed, crossing, leader, neighbour, situation

from sumo_adv.agents.analyzer import Analysis, Choice, ModelAnalyzer, analyzer_prompt
from sumo_adv.agents.feedback import MAX_EARLIER_ATTEMPTS, AttemptReport, Row, earlier_words, report_words
from sumo_adv.agents.generator import mode_name, without_fence
from sumo_adv.agents.scene_text import Aliases, driver_words, relative_words, road_words, state_words
from sumo_adv.agents.ways import evidence_words, modes_words, opening_comment
from sumo_adv.datatypes import (
    Attempt,
    Diagnosis,
    Level,
    LibraryEntry,
    Limits,
    ModeChoice,
    Parameter,
    Planner,
    Prediction,
    Preventability,
    Proposal,
    Role,
    Track,
    Verdict,
)
from sumo_adv.episode.assessment import diagnose
from sumo_adv.episode.repairs import way_taken
from sumo_adv.episode.task import AttemptResult
from sumo_adv.errors import ModelError, UsageError
from sumo_adv.geometry import make_path
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.chat import Ledger
from sumo_adv.llm.prompts import MAX_PROMPT_TEXT_CHARACTERS, PROMPT_NAMES, Prompts, danger_words, sanitize
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.sumo_states import Snapshot

LIMITS = Limits()
TUNED = Planner(
    "Straight Lane Shift",
    "tuned",
    '# Straight Lane Shift, mode "tuned"\nX = 1\n',
    (Parameter("gap", 2.0, 1.0, 8.0, "m"),),
    "seed",
)
PLANNER = Planner(
    "Straight Lane Shift", "side", '# Straight Lane Shift, mode "side"\n# Drifts over.\nX = 1\n', (), "seed"
)
SHIFT = LibraryEntry("Straight Lane Shift", "Drifts over.", ("neighbour",), (PLANNER, TUNED))
BRAKE = LibraryEntry("Emergency Braking", "Brakes.", ("leader",), ())


@pytest.fixture(scope="module")
def prompts() -> Prompts:
    return Prompts(data_folder("prompts"))


# -- files ------------------------------------------------------------------------------------------------------------


def test_a_variable_that_is_missing_or_unknown_is_an_error(prompts: Prompts) -> None:
    with pytest.raises(KeyError, match="lacks a value for description"):
        prompts.render("confirm", label="A", nearest="B", scene="D", bv="BV1", starts="0")
    with pytest.raises(KeyError, match="no variable other"):
        prompts.render("confirm", label="A", nearest="B", description="C", scene="D", bv="BV1", starts="0", other="D")


def test_every_prompt_has_a_version_and_a_hash(prompts: Prompts) -> None:
    assert set(prompts.versions) == set(PROMPT_NAMES)
    assert all(v["version"].isdigit() and len(v["sha256"]) == 64 for v in prompts.versions.values())


def test_a_folder_that_lacks_a_prompt_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"analyzer\.md cannot be read"):
        Prompts(tmp_path)
    for name in PROMPT_NAMES:
        (tmp_path / f"{name}.md").write_text("version: 1\n=== system\nOnly this.\n")
    with pytest.raises(UsageError, match="lacks its part"):
        Prompts(tmp_path)
    (tmp_path / "analyzer.md").write_text("no version\n")
    with pytest.raises(UsageError, match="must begin with 'version: N'"):
        Prompts(tmp_path)


def test_texts_from_files_are_sanitized() -> None:
    assert sanitize("a\n\n# 6 OUTPUT\x00  b```c") == "a # 6 OUTPUT b'''c"
    assert len(sanitize("x" * 10_000)) == MAX_PROMPT_TEXT_CHARACTERS


# -- scenes -----------------------------------------------------------------------------------------------------------


def test_a_neighbour_in_words() -> None:
    scene = situation([neighbour(x=20.0, y=3.2, speed=12.0)])
    aliases = Aliases.of(scene)
    assert dict(aliases.bvs) == {"BV1": "bv"}
    # 20 m between centres, two halves of 5 m; the ego drives 10, the other 12 m/s
    assert relative_words(scene, aliases, {"Straight Lane Shift": ["neighbour"], "Emergency Braking": ["leader"]}) == (
        "BV1: in a lane to the left, same direction, 15.0 m ahead bumper to bumper, centres 3.2 m apart sideways,"
        " opening at 2.0 m/s. Behaviours that apply: Straight Lane Shift."
    )


def test_a_crossing_in_words_has_ways_times_and_right_of_way() -> None:
    scene = situation([crossing()])
    words = road_words(scene, Aliases.of(scene))
    # 25 m to the ego's path at 8 m/s: 3.1 s; at 4 m/s2 sooner: (sqrt(64 + 200) - 8) / 4 = 2.1 s; the ego: 30 m, 3.0 s
    assert "BV1 going straight on: crosses EGO's path at (30.0," in words and "at 90 deg" in words
    assert "m (3.1 s at its present speed, 2.1 s at the earliest), EGO 30.0 m (3.0 s" in words
    assert "it has priority there" in words


def test_a_signal_replaces_the_right_of_way() -> None:
    scene = changed(situation([crossing()]), signals={"ego": (("t", 22.0, "G"),), "bv": (("t", 15.0, "r"),)})
    words = road_words(scene, Aliases.of(scene))
    assert "EGO has a signal 22 m ahead, now green." in words
    assert "its signal is red." in words
    assert "priority" not in words


def test_states_are_ego_centred_and_rounded() -> None:
    time = 100.0 + 0.1 * np.arange(-11, 1)
    ahead = Track(
        "bv", Role.BACKGROUND, time, 30.04 + 8.0 * (time - 100.0), 0.0 * time + 3.21, 0.0 * time, 0.0 * time + 8.0,
        0.0 * time - 1.26, 5.0, 2.0, ("",) * 12,
    )  # fmt: skip
    scene = changed(situation([leader()]), history=(ahead,))
    line = state_words(scene, Aliases.of(scene))
    assert line.startswith("BV1: t=-1.1: x=21.2 y=3.2 hdg=0 v=8.0; ")
    assert line.endswith("t=0.0: x=30.0 y=3.2 hdg=0 v=8.0; a=-1.3; 5.0 x 2.0 m")


def test_the_egos_driver_model_is_described_if_it_is_known() -> None:
    scene = situation([leader()])
    assert driver_words(scene).startswith("SUMO's Krauss car-following driver; keeps its lane")
    unknown = changed(scene, model=replace(scene.baseline.model, kind="my:Driver"))
    assert "unknown driver" in driver_words(unknown)


def proposal(score: float, **predicted: Any) -> Proposal:
    made = Prediction(**predicted)
    return Proposal("bv", "Straight Lane Shift", PLANNER, {}, 0.0, 0.0, score=score, prediction=made)


def test_evidence_counts_what_can_be_avoided() -> None:
    aliases = Aliases.of(situation([neighbour()]))
    hit = {"hit": True, "min_ttc": 0.0, "gap": 0.0}
    pool = [
        proposal(0.1, **hit, careful=True, manoeuvre=True, warning=2.0),
        proposal(0.2, **hit, careful=False, manoeuvre=True, warning=1.0),
        proposal(1.2, **hit, careful=False, manoeuvre=False, warning=0.4),
        proposal(2.1, hit=False, min_ttc=2.0, gap=3.0),
    ]
    words = evidence_words(pool, aliases, [SHIFT], {"Straight Lane Shift": "2 times tried"})
    assert "BV1, Straight Lane Shift: 3 of 4 candidates collide; 2 of these could be avoided" in words
    assert "1 by a careful driver that only brakes; median warning 1.0 s." in words
    assert "mode side: 3 of 4 collide; the best one (level none, warning 2.0 s, delta-v 0.0 m/s) begins 0 s" in words
    assert "2 times tried" in words
    nothing = evidence_words([proposal(2.1, hit=False, min_ttc=2.0, gap=3.0)], aliases, [SHIFT], {})
    assert "none of 1 candidates collides in a way that counts; least TTC 2.0 s." in nothing


def test_the_opening_comment_describes_a_planner() -> None:
    named = '# Name, mode "wait"\n# Waits.\n# Then goes.\nX = 1\n# not this\n'
    assert opening_comment(named) == "Waits. Then goes."
    assert opening_comment(named.partition("\n")[2]) == "Waits. Then goes."  # a model may leave the name out
    assert opening_comment("X = 1\n") == "without a word on it"


def test_the_prompt_with_and_without_evidence(prompts: Prompts) -> None:
    scene = situation([neighbour()])
    without = analyzer_prompt(prompts, {0.0: scene}, [SHIFT, BRAKE], LIMITS)
    with_it = analyzer_prompt(
        prompts, {0.0: scene}, [SHIFT, BRAKE], LIMITS, lambda aliases: f"EVIDENCE {len(aliases.bvs)}\n"
    )
    assert "EVIDENCE 1" in with_it.user and "EVIDENCE" not in without.user
    assert "Straight Lane Shift\n  mode side: Drifts over." in without.user
    assert "- Emergency Braking: Brakes." in without.system
    assert without.tokens == -(-(len(without.system) + len(without.user)) // 4)


def test_without_evidence_there_is_no_heading(prompts: Prompts) -> None:
    scene, aliases = situation([neighbour()]), Aliases.of(situation([neighbour()]))
    assert evidence_words([], aliases, [SHIFT], {"Straight Lane Shift": "2 times tried"}) == ""
    prompt = analyzer_prompt(
        prompts, {0.0: scene}, [SHIFT], LIMITS, lambda known: evidence_words([], known, [SHIFT], {})
    )
    assert prompt == analyzer_prompt(prompts, {0.0: scene}, [SHIFT], LIMITS)


def test_a_danger_is_told_with_the_numbers_of_the_careful_driver(prompts: Prompts) -> None:
    words = danger_words(prompts)
    assert "less than 0.5 m from EGO within 3 s" in words  # oncoming
    assert (
        "can no longer stop short of it at 3 m/s2 and would be less than 1 m from EGO within 4 s" in words
    )  # crossing
    assert "0.75 s later cc_human brakes, rising within 0.6 s to 7.6 m/s2" in words
    assert "steers acts 0.4 s later." in words  # 0.8 s after it could be seen, which is 0.4 s before it shows
    assert words in analyzer_prompt(prompts, {0.0: situation([neighbour()])}, [SHIFT], LIMITS).system


def test_junctions_are_told_of_where_there_is_one() -> None:
    words = driver_words(situation([crossing()]))
    assert "decides 4.5 m before its line" in words and "arrives less than 1 s after EGO would be across" in words
    assert "junction" not in driver_words(situation([leader()]))


def test_modes_that_read_the_acceleration_are_marked() -> None:
    head = "# Words.\nPARAMETERS = {}\ndef endpoint(bv, ego, road, parameters, acc, horizon):\n    return "
    reads, ignores = (Planner("L", name, head + value, (), "seed") for name, value in (("a", "go(acc)"), ("b", "{}")))
    assert modes_words(LibraryEntry("L", "", (), (reads, ignores))) == [
        "  mode a (uses acceleration): Words.", "  mode b: Words.",
    ]  # fmt: skip


# -- answers ----------------------------------------------------------------------------------------------------------


def choice(label: str, risk: str = "high", **given: object) -> Choice:
    return Choice.model_validate({"bv": "BV1", "label": label, "risk": risk, "acceleration": 0.0, **given})


def analyzer(prompts: Prompts, model: Answers, allowed: Sequence[str] = ()) -> ModelAnalyzer:
    return ModelAnalyzer(MeteredModel(model, Ledger()), prompts, LIMITS, allowed=allowed)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (choice("Straight Lane Shift", bv="V1"), "no vehicle 'V1' that may be chosen; there are BV1"),
        (choice("Honking"), "'Honking' is not in the library"),
        (choice("Emergency Braking"), "'Emergency Braking' does not apply to BV1"),
        (choice("Straight Lane Shift", acceleration=-9.0), "beyond the limits"),
        (choice("Straight Lane Shift", acceleration=[[1.0, 0.0], [0.5, 1.0]]), "ascending"),
        (choice("Straight Lane Shift", acceleration=[[float(k), 0.0] for k in range(5)]), "4"),
        (choice("Straight Lane Shift", novel=True, description="It is in the library after all."), "is not novel"),
        (choice("Wave", novel=True, description="Too short."), "needs a description"),
        (choice("Straight Lane Shift", ways=[{"mode": "loop"}]), "has no mode 'loop'; it has side, tuned"),
        (choice("Straight Lane Shift", ways=[{"mode": "tuned", "parameters": {"far": 1}}]), "no parameter 'far'"),
        (choice("Straight Lane Shift", ways=[{"mode": "tuned", "parameters": {"gap": 9}}]), "within 1 and 8"),
    ],
)
def test_an_unusable_answer_is_sent_back_once_with_its_fault(prompts: Prompts, wrong: Choice, sentence: str) -> None:
    model = Answers(Analysis(intents=[wrong]), Analysis(intents=[choice("straight lane shift")]))
    intents = analyzer(prompts, model).analyze({0.0: situation([neighbour()])}, [SHIFT, BRAKE])
    assert [(i.bv, i.label, i.source) for i in intents] == [("bv", "Straight Lane Shift", "memory")]
    assert sentence in model.asked[1].messages[-1][1]
    stubborn = Answers(*[Analysis(intents=[wrong])] * 2)
    with pytest.raises(ModelError, match="refused 2 times"):
        analyzer(prompts, stubborn).analyze({0.0: situation([neighbour()])}, [SHIFT, BRAKE])


def test_intents_that_are_not_allowed_are_neither_shown_nor_accepted(prompts: Prompts) -> None:
    new = choice("Wave", novel=True, description="It waves at the ego until that one stops.")
    model = Answers(Analysis(intents=[new]), Analysis(intents=[choice("Straight Lane Shift")]))
    analyzer(prompts, model, ["Straight Lane Shift"]).analyze({0.0: situation([neighbour()])}, [SHIFT, BRAKE])
    assert "Emergency Braking" not in model.asked[0].messages[0][1].split("# 5 RULES")[0]
    assert "Only these behaviours are allowed here" in model.asked[1].messages[-1][1]


def test_knots_and_new_intents_come_through(prompts: Prompts) -> None:
    new = choice(
        "Wave", "low", novel=True, description="It waves at the ego until it stops.", acceleration=[[0, 1], [2, -3]]
    )
    (intent,) = analyzer(prompts, Answers(Analysis(intents=[new]))).analyze({0.0: situation([neighbour()])}, [SHIFT])
    assert (intent.label, intent.source, intent.risk) == ("Wave", "generated", "low")
    assert intent.acceleration == ((0.0, 1.0), (2.0, -3.0))


def test_chosen_ways_begin_at_one_of_the_starts(prompts: Prompts) -> None:
    """The neighbour is 15 m ahead and 3 m to the left at first (15.3 m away), then 5 m ahead (5.8 m away)."""
    scenes = {0.0: situation([neighbour(15.0)]), 1.5: situation([neighbour(5.0)])}
    near = {"quantity": "distance", "at_most": 8}
    ways = [
        {"mode": "tuned", "parameters": {"gap": 3}, "begin": 1.2}, {"mode": "side", "begin": near}, {"mode": "side"},
    ]  # fmt: skip
    model = Answers(Analysis(intents=[choice("Straight Lane Shift", ways=ways)]))
    (intent,) = analyzer(prompts, model).analyze(scenes, [SHIFT])
    assert intent.ways == (
        ModeChoice("tuned", {"gap": 3.0}, 1.5),
        ModeChoice("side", {}, 1.5),
        ModeChoice("side", {}, 0.0),
    )


def test_a_model_may_see_nothing_dangerous(prompts: Prompts) -> None:
    assert analyzer(prompts, Answers(Analysis(intents=[]))).analyze({0.0: situation([neighbour()])}, [SHIFT]) == []


def test_fences_are_removed_and_modes_become_one_word() -> None:
    assert without_fence("Here:\n```python\nX = 1\n```\nDone.") == "X = 1\n"
    assert without_fence("X = 1") == "X = 1\n"
    assert (mode_name("Swing & Hit!"), mode_name("")) == ("swing_hit", "direct")


# -- diagnosis --------------------------------------------------------------------------------------------------------


def test_a_near_miss_is_diagnosed() -> None:
    """The ego drives east at 10 m/s and passes x = 30 after 3 s; the BV comes north at 8 m/s and is there after 4 s."""
    dt, steps = 0.1, 61
    snapshots = []
    for k in range(steps):
        t = k * dt
        raw = {
            "ego": (10.0 * t + 2.5, 0.0, 90.0, 10.0, "a"),
            "bv": (30.0, -32.0 + 8.0 * t + 2.5, 0.0, 8.0, "b"),
        }
        snapshots.append(Snapshot(round(t, 6), raw))
    result = AttemptResult(None, None, 0.0, snapshots, {"ego": (5.0, 2.0), "bv": (5.0, 2.0)})  # type: ignore[arg-type]
    diagnosis = diagnose(result, "ego", "bv", make_path([(0.0, 0.0), (400.0, 0.0)]), LIMITS, dt)
    assert diagnosis is not None
    # distance^2 = (30 - 10 t)^2 + (32 - 8 t)^2 is least at t = (300 + 256) / 164 = 3.39 s
    assert diagnosis.time == pytest.approx(3.4, abs=0.01)
    assert diagnosis.ego_frame == pytest.approx((-4.0, -4.8), abs=0.05)  # behind and to the right of the ego
    assert diagnosis.early == pytest.approx(-1.0, abs=0.35)  # within two metres of one place
    assert (diagnosis.ego_reaction, diagnosis.ego_braking, diagnosis.ego_shift, diagnosis.bound) == (None, 0.0, 0.0, ())


def report(prompts: Prompts, verdict: Verdict, ending: str = "passed") -> str:
    d = Diagnosis(3.4, (-4.0, -4.8), (4.8, 4.0), 9.0, 8.0, -1.0, 2.5, 3.2, 0.0, ("braking",))
    attempt = Attempt(0, "analyzer", proposal(0.5), 100.0, verdict, ending, "", d)
    return report_words(
        prompts, AttemptReport(attempt, (Row(0.5, 20.0, 3.2, 0.0, 12.0, 14.0, 0.1),), ("lateral: 5 m/s2.",), 0.0, 6.5)
    )


def test_the_feedback_describes_an_attempt(prompts: Prompts) -> None:
    verdict = Verdict(1.44, 2.31, False, False, False, False, ("lateral",), min_ttc_time=103.4)
    words = report(prompts, verdict)
    assert "lasted 6.5 s; it ended because the two had passed each other" in words
    assert "Level none: no contact; least time to collision 1.44 s, least distance of the boxes 2.3 m." in words
    assert "Not feasible, lateral: 5 m/s2." in words and "needs: a motion that is feasible" in words
    assert "4.0 m behind and 4.8 m to the right of EGO" in words and "the bv was 1.0 s after EGO" in words
    assert "began to brake 2.5 s after the start, at most 3.2 m/s2" in words
    assert "  0.5; 20.0, 3.2; 0; 12.0, 14.0; 0.1" in words


def test_the_feedback_says_what_the_next_level_needs(prompts: Prompts) -> None:
    """The danger shows at 104.2 s, 0.8 s before the contact at 105.0; the attempt began at 100."""
    by = Preventability({"cc_human": "collides", "manoeuvre": "avoids"}, {"cc_human": 104.2})
    hit = Verdict(
        0.0, 0.0, True, True, True, False, True, False, None, contact_time=105.0, level=Level.VALID, preventability=by,
        delta_v=3.1, humanlike=True,
    )  # fmt: skip
    words = report(prompts, hit, "contact")
    assert "Level valid: they collided, delta-v of EGO 3.1 m/s." in words
    assert "a danger that shows earlier. It showed 4.2 s after the start, 0.8 s before the contact;" in words
    assert "it is avoided by manoeuvre. A careful driver that only brakes lets 0.75 s pass" in words
    soft = replace(hit, level=Level.STRICT, delta_v=1.1)
    assert "needs: a harder contact (delta-v 1.1, wanted 2.24 m/s)." in report(prompts, soft, "contact")
    assert "needs: a contact in which the bv does not run into the back of EGO." in report(
        prompts, replace(hit, rear_end=True)
    )


def test_other_attempts_are_a_line_each_with_what_they_lacked(prompts: Prompts) -> None:
    missed = Verdict(1.44, 2.31, False, False, False, False, ())
    missed, off_road = replace(missed, feasible=True), replace(missed, failed_gates=("off_road",))
    tries = [Attempt(k, "tuner", proposal(0.5), 100.0, v, "passed", "") for k, v in enumerate((missed, off_road))]
    first, second = earlier_words(prompts, tries, {"bv": "BV1"}).splitlines()
    side = f"BV1, Straight Lane Shift/side (text {PLANNER.hash[:4]}: no parameters): level none"
    assert first == f"1: {side}; needs a contact."
    assert second == f"2: {side}; not feasible (off_road); needs a motion that is feasible."
    many = earlier_words(prompts, [replace(tries[0], index=k) for k in range(30)], {}).splitlines()
    assert len(many) == MAX_EARLIER_ATTEMPTS and many[-1].startswith("30: a vehicle,")


def test_a_vehicle_is_measured_from_the_way_that_it_took() -> None:
    """The two ways are one for 17 m north; then one goes on, and the other turns left and goes west along y = -2."""
    straight, left = crossing().ways

    def driven(x: list[float], y: list[float]) -> Track:
        n = len(x)
        zero = np.zeros(n)
        return Track(
            "bv", Role.ADVERSARY, 0.1 * np.arange(n), np.array(x), np.array(y), zero, zero, zero, 5.0, 2.0, ("",) * n
        )

    north, west = driven([30.0, 31.0, 31.0], [-25.0, -5.0, 20.0]), driven([30.0, 24.0, 4.0], [-25.0, -1.0, -1.0])
    assert way_taken(north, (straight, left)) is straight and way_taken(north, (left, straight)) is straight
    assert way_taken(west, (straight, left)) is left
    before = driven([30.0, 30.5, 30.5], [-25.0, -20.0, -15.0])
    assert way_taken(before, (straight, left)) is straight and way_taken(before, (left, straight)) is left
