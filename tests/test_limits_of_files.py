"""Files of others that are too large, too deep or have too many digits: a sentence, whichever command reads them."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from pathlib import Path

import pytest
from cli_samples import Program
from regression_samples import attacked, suite_in

from sumo_adv.config import load_settings
from sumo_adv.errors import UsageError
from sumo_adv.parsing import MAX_NESTING, MAX_UNPACKED_BYTES, parse_json, parse_toml, read_bytes, read_object
from sumo_adv.report.read import columns_of
from sumo_adv.simulation.scan import read_sumo_text

DEEP, LONG = "[" * 100_000, "1" * 5_000


@pytest.mark.parametrize("text", [DEEP, LONG, '{"a":' * 100_000, "[" * (MAX_NESTING + 1) + "]" * (MAX_NESTING + 1)])
def test_json_that_is_too_deep_or_has_too_many_digits_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nests too deeply|digits|more than 64 bits"):
        parse_json(text)
    (tmp_path / "a.json").write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=r"The plan .*a\.json is damaged"):
        read_object(tmp_path / "a.json", "The plan")


def test_a_hundred_levels_are_enough_for_all_that_is_written() -> None:
    assert parse_json("[" * 100 + "]" * 100)
    assert parse_toml(f"a = {'[' * 90}{']' * 90}")


@pytest.mark.parametrize("text", [f"a = {DEEP}", f"schema = {LONG}", f"[a{'.a' * 3_000}]"])
def test_a_case_that_is_damaged_so_is_a_sentence(program: Program, text: str) -> None:
    suite_in(program.folder, "a")
    (program.folder / "suite" / "a" / "case.toml").write_text(text, encoding="utf-8")
    done = program.here("regress", "suite", "--ego", "idm", "--out", "o")
    assert done.status == 2
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("text", [DEEP, LONG, f'{{"schema": {LONG}}}'])
def test_damaged_results_are_sentences_in_every_command(program: Program, text: str) -> None:
    for name, command in (
        ("regress.json", ("compare", "x", "x", "--out", "o")), ("outcome.json", ("report", "x")),
        ("outcome.json", ("compare", "x", "x", "--out", "o")), ("hunt.json", ("figure", "x", "--out", "o.png")),
    ):  # fmt: skip
        shutil.rmtree(program.folder / "x", ignore_errors=True)
        (program.folder / "x").mkdir()
        (program.folder / "x" / name).write_text(text, encoding="utf-8")
        done = program.here(*command)
        assert done.status == 2, (name, command)
        assert done.err.count("\n") == 1


@pytest.mark.parametrize("delay", ["1e300", "-1.0"])
def test_a_delay_that_no_attack_has_is_refused_wherever_it_stands(program: Program, delay: str) -> None:
    file = suite_in(program.folder, "a") / "a" / "case.toml"
    changed = re.sub(r"(?m)^delay = .*$", f"delay = {delay}", file.read_text(encoding="utf-8"))
    file.write_text(changed, encoding="utf-8")
    done = program.here("regress", "suite", "--ego", "idm", "--out", "o")
    assert done.status == 2
    assert "delay" in done.err
    shutil.copytree(attacked(), program.folder / "run")
    manifest = program.folder / "run" / "manifest.json"
    values = json.loads(manifest.read_text(encoding="utf-8"))
    values["attempt"]["delay"] = float(delay)
    manifest.write_text(json.dumps(values), encoding="utf-8")
    done = program.here("run", "--replay", "run", "--out", "again")
    assert done.status == 2
    assert "delay" in done.err
    with pytest.raises(UsageError, match="delays"):
        load_settings(None, delays=[float(delay)])


# -- packed files that unpack to more than there is memory ------------------------------------------------------------


def test_what_unpacks_beyond_a_limit_is_not_unpacked(tmp_path: Path) -> None:
    """Three MiB of zeros fit into 3 KB."""
    file = tmp_path / "a.gz"
    file.write_bytes(gzip.compress(bytes(3 * 2**20)))
    assert len(read_bytes(file)) == 3 * 2**20
    with pytest.raises(ValueError, match="it holds more than 2 MiB"):
        read_bytes(file, 2 * 2**20)
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(ValueError, match="a damaged or truncated gzip file"):
        read_bytes(file)


@pytest.fixture(scope="module")
def bomb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gzip file of less than 1 MB that unpacks to more than the limit."""
    file = tmp_path_factory.mktemp("bomb") / "states.csv.gz"
    part = gzip.compress(b"\n" * 2**26)
    file.write_bytes(part * (MAX_UNPACKED_BYTES // 2**26 + 1))
    assert file.stat().st_size < 1_000_000
    return file


def test_a_table_that_unpacks_to_gigabytes_is_a_sentence(bomb: Path) -> None:
    with pytest.raises(UsageError, match=r"states.csv.gz is damaged \(it holds more than 512 MiB\)"):
        columns_of(bomb)
    with pytest.raises(UsageError, match=r"The tracks .* cannot be used \(it holds more than 512 MiB\)"):
        read_sumo_text(bomb, "The tracks")


def test_a_report_of_such_a_run_is_a_sentence(program: Program, bomb: Path) -> None:
    shutil.copytree(attacked(), program.folder / "run")
    shutil.copyfile(bomb, program.folder / "run" / "states.csv.gz")
    done = program.here("report", "run")
    assert done.status == 2
    assert "it holds more than 512 MiB" in done.err
    assert json.loads((program.folder / "run" / "outcome.json").read_text(encoding="utf-8"))["attempts"]
