"""The shipped bank is built from text: same content each time, differences named, wrong sources refused."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, SHIPPED

from sumo_adv.datatypes import Parameter
from sumo_adv.errors import BankError, PlannerSyntaxError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import build, read_folder
from sumo_adv.memory.records import RELATIONS
from sumo_adv.memory.similarity import TextAndSlots
from sumo_adv.planners.trial import UNPROTECTED_SIZES_M

LABELS = {
    "Emergency Braking", "Close Car-following", "Aggressive Cut-in", "Opposite Direction Intrusion",
    "Intersection Rush-through Turn Left", "Intersection Rush-through Go-straight", "Straight Lane Shift",
}  # fmt: skip
INTENT = 'label = "Emergency Braking"\ndescription = """\nIt brakes\nhard."""\napplies = ["leader"]\n'


def parse(source: str) -> tuple[Parameter, ...]:
    """A reader of PARAMETERS, as the planning package has one."""
    try:
        table = ast.literal_eval(source.partition("=")[2].strip())
    except SyntaxError:
        raise PlannerSyntaxError("It does not parse.") from None
    return tuple(Parameter(name, *values) for name, values in table.items())


def sources(folder: Path) -> Path:
    (folder / "braking").mkdir(parents=True)
    (folder / "braking" / "intent.toml").write_text(INTENT)
    (folder / "braking" / "plain.py").write_text(BRAKE_PLANNER.text)
    (folder / "braking" / "late.py").write_text("PARAMETERS = {}\n")
    return folder


def test_building_twice_gives_the_same_bank(tmp_path: Path) -> None:
    folder = sources(tmp_path / "memory_bank")
    first, second = tmp_path / "one.sqlite", tmp_path / "two.sqlite"
    build(folder, first, parse)
    second.write_text("something old, which is replaced")
    build(folder, second, parse)
    with MemoryBank.open(first, read_only=True) as a, MemoryBank.open(second, read_only=True) as b:
        assert a.content_hash() == b.content_hash()
        assert [record.description for record in a.intents()] == ["It brakes hard."]
        assert [planner.mode for planner in a.planners("Emergency Braking")] == ["late", "plain"]
        assert a.planners("Emergency Braking")[1] == BRAKE_PLANNER
        assert a.epsilon() == (TextAndSlots.epsilon, TextAndSlots.calibrated_on)
    assert first.read_bytes() == second.read_bytes()
    assert {file.name for file in tmp_path.iterdir()} == {"memory_bank", "one.sqlite", "two.sqlite"}


def test_wrong_sources_are_refused_and_the_old_bank_stays(tmp_path: Path) -> None:
    folder = sources(tmp_path / "memory_bank")
    target = tmp_path / "bank.sqlite"
    build(folder, target, parse)
    before = target.read_bytes()
    intent = folder / "braking" / "intent.toml"
    wrong = {
        "colour = 1\n" + INTENT: "must hold label",
        INTENT.replace("leader", "above"): "applies to above",
        INTENT.replace("It brakes\nhard.", " "): "needs a description",
        "label = ": "cannot be read as TOML",
    }
    for text, sentence in wrong.items():
        intent.write_text(text)
        with pytest.raises(BankError, match=sentence):
            build(folder, target, parse)
    intent.write_text(INTENT)
    (folder / "braking" / "plain.py").write_text("PARAMETERS = {(\n")
    with pytest.raises(BankError, match=r"plain\.py is not a planner"):
        build(folder, target, parse)
    for file in (folder / "braking").glob("*.py"):
        file.unlink()
    with pytest.raises(BankError, match="has no planner"):
        build(folder, target, parse)
    with pytest.raises(BankError, match="no bank to build"):
        build(tmp_path / "nowhere", target, parse)
    assert target.read_bytes() == before


SHARED = '# $label\nPARAMETERS = {"late": ($late, 0.0, 3.0, "s")}\n'


def share(folder: Path, text: str, table: str) -> Path:
    """The sources with a shared text for the mode ``wait``, and this line in ``[shared]`` of their intent."""
    sources(folder)
    (folder / "planners").mkdir()
    (folder / "planners" / "wait.template").write_text(text)
    (folder / "braking" / "intent.toml").write_text(f"{INTENT}[shared]\n{table}\n")
    return folder


def test_intents_share_a_text_and_give_it_their_own_words(tmp_path: Path) -> None:
    folder = share(tmp_path, SHARED, 'wait = { late = "0.5" }')
    (folder / "more").mkdir()
    more = INTENT.replace("Emergency", "More")
    (folder / "more" / "intent.toml").write_text(more + '[shared]\nwait = { late = "2.0" }\n')
    braking, more_braking = read_folder(folder, lambda _: ())
    assert [planner.mode for planner in braking.planners] == ["late", "plain", "wait"]
    first, second = braking.planners[2].text, more_braking.planners[0].text
    assert first == '# Emergency Braking\nPARAMETERS = {"late": (0.5, 0.0, 3.0, "s")}\n'
    assert second == '# More Braking\nPARAMETERS = {"late": (2.0, 0.0, 3.0, "s")}\n'


@pytest.mark.parametrize(
    ("text", "table", "sentence"),
    [
        (SHARED, "wait = {}", "needs the words ['late'] in [shared], and is given []"),
        (SHARED, 'wait = { late = "1.0", early = "2.0" }', "needs the words ['late']"),
        (SHARED + "# $ 5\n", 'wait = { late = "1.0" }', "needs the words ['late']"),
        (SHARED, "wait = { late = 1.0 }", "as short texts"),
        (SHARED, 'wait = "late"', "a table of words, not 'wait'"),
        (SHARED, '"../planners/wait" = { late = "1.0" }', "a table of words, not '../planners/wait'"),
        (SHARED, "plain = {}", "shares the modes ['plain'], which have files of their own"),
        (SHARED, "hurry = {}", "hurry.template is not a plain file"),
    ],
)
def test_wrong_words_for_a_shared_text_are_refused(tmp_path: Path, text: str, table: str, sentence: str) -> None:
    folder = share(tmp_path, text, table)
    with pytest.raises(BankError, match=re.escape(sentence)):
        read_folder(folder, lambda _: ())


def test_a_label_may_be_used_once(tmp_path: Path) -> None:
    folder = sources(tmp_path)
    (folder / "again").mkdir()
    (folder / "again" / "intent.toml").write_text(INTENT.replace("Emergency Braking", "emergency-braking"))
    (folder / "again" / "plain.py").write_text("PARAMETERS = {}\n")
    with pytest.raises(BankError, match="Two folders"):
        read_folder(folder, parse)


def test_the_seven_intents_of_the_paper_are_there() -> None:
    intents = [source.intent for source in read_folder(SHIPPED, lambda _: ())]
    assert {record.label for record in intents} == LABELS
    assert len(intents) == 7
    covered = {relation for record in intents for relation in record.applies}
    assert covered == set(RELATIONS) - {"crossing_right", "merging", *UNPROTECTED_SIZES_M}
