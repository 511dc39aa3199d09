"""Numbers, texts and files that no user means: one sentence, whichever command reads them."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_samples import ROOT

from sumo_adv.benchmark.suites import load_suite
from sumo_adv.campaigns.plan import read_plan
from sumo_adv.config import load_settings
from sumo_adv.errors import BankError, UsageError
from sumo_adv.memory.similarity import read_paraphrases
from sumo_adv.parsing import parse_json, parse_toml
from sumo_adv.simulation.scan import scan_network
from sumo_adv.simulation.scenario import load_scenario


def read_suite(file: Path) -> object:
    """A suite of the list in a file."""
    return load_suite(str(file))


HUGE = "1" + "0" * 400
DEEP = "[" * 5_000
TEXTS = {
    f"a = {DEEP}": "nests too deeply",
    f"a = {HUGE}": "more than 64 bits",
    f"a = [{{b = -{HUGE}}}]": "more than 64 bits",
    'a = "x\\u0000y"': "the character NUL",
    '"x\\u0000y" = 1': "the character NUL",
    "a = ": "Invalid value",
}
"""TOML -> what is wrong with it."""


@pytest.mark.parametrize("text", TEXTS, ids=[f"{k}" for k in range(len(TEXTS))])
def test_toml_that_python_reads_or_breaks_on_is_a_sentence_everywhere(tmp_path: Path, text: str) -> None:
    file = tmp_path / "a.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=TEXTS[text]):
        parse_toml(text)
    for read in (load_scenario, read_plan, load_settings, read_suite):
        with pytest.raises(UsageError, match=rf"a\.toml is not valid TOML: .*{TEXTS[text]}"):
            read(file)
    with pytest.raises(BankError, match=TEXTS[text]):
        read_paraphrases(file)


@pytest.mark.parametrize("text", [DEEP, '{"a":' * 5_000, HUGE, "NaN", "[1e999]", "{", ""], ids=range(7))
def test_json_that_python_reads_or_breaks_on_is_an_error_of_one_kind(text: str) -> None:
    with pytest.raises(ValueError):
        parse_json(text)


def test_what_is_plain_is_read() -> None:
    assert parse_toml("a = inf\nb = [1, -9223372036854775807]") == {"a": float("inf"), "b": [1, 1 - 2**63]}
    assert parse_json('{"a": [1, 2.5, null, "x"]}') == {"a": [1, 2.5, None, "x"]}


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("length", "-5", "a length of -5 m"), ("length", "nan", "a length of nan m"), ("length", "1e400", "a length"),
        ("length", "long", "a wrong one"), ("width", "0", "a width of 0 m"), ("speed", "nan", "a speed of nan m/s"),
        ("speed", "-1", "a speed of -1 m/s"), ("shape", "", "no shape of two places"),
        ("shape", "0,0", "no shape of two places"), ("shape", "0,0 nan,1", "no shape of two places"),
    ],
)  # fmt: skip
def test_a_lane_that_nothing_can_be_on_is_named(tmp_path: Path, key: str, value: str, says: str) -> None:
    text = (ROOT / "networks" / "straight_3lane.net.xml").read_text(encoding="utf-8")
    before, lane = text.split('<lane id="eastbound_1"', 1)
    head, rest = lane.split(f' {key}="', 1)
    changed = f'{before}<lane id="eastbound_1"{head} {key}="{value}"{rest[rest.index(chr(34)) + 1 :]}'
    (tmp_path / "bad.net.xml").write_text(changed, encoding="utf-8")
    with pytest.raises(UsageError, match=f"The lane 'eastbound_1' of the network .*bad.net.xml .*{says}"):
        scan_network(tmp_path / "bad.net.xml")
