"""``doctor`` and ``--version``: each line tells the state and how to fix it; the key is never in it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from cli_samples import ROOT, Program

from sumo_adv import __version__
from sumo_adv.cli import doctor_checks as checks
from sumo_adv.cli.doctor_checks import FindingLevel
from sumo_adv.config import Settings

SHIPPED = ROOT / "memory_bank.sqlite"


def named(checked: Iterator[checks.DoctorFinding]) -> dict[str, checks.DoctorFinding]:
    return {f.name: f for f in checked}


def test_all_that_a_run_needs_is_here(program: Program) -> None:
    done = program("doctor", "--json")
    report = json.loads(done.out)
    levels = {c["name"]: c["level"] for c in report["checks"]}
    assert (done.status, report["ok"], report["failed"], done.err) == (0, True, 0, "")
    assert {levels[n] for n in ("program", "libraries", "simulator", "model", "memory bank", "output")} == {"ok"}
    assert levels["sandbox"] in ("ok", "warn")
    assert all(c["mend"] for c in report["checks"] if c["level"] != "ok")
    assert not (program.home / "data").exists()  # looking makes no bank
    assert program.leftovers() == []


def test_what_is_broken_fails_and_says_how_to_mend_it(program: Program) -> None:
    (program.folder / "bank.sqlite").write_text("no bank")
    key = "sk-secret-word"
    program.variables = {"SUMO_ADV_LLM_API_KEY": key, "SUMO_ADV_LLM_BASE_URL": "http://127.0.0.1:1/v1"}
    done = program.here("doctor", "--memory", "bank.sqlite", "--llm", "mine")
    failed = [line for line in done.out.splitlines() if line.startswith("fail")]
    assert done.status == 1
    assert [line.split(": ")[0].split()[1] for line in failed] == ["model", "memory"]
    assert "127.0.0.1:1 cannot be reached" in failed[0]
    assert "is not a SQLite file" in failed[1]
    assert all("To fix it: " in line for line in failed)
    assert key not in done.out + done.err


def test_a_bad_setting_is_one_line(program: Program) -> None:
    program.variables = {"SUMO_ADV_ATTEMPTS": "many"}
    done = program.here("doctor")
    assert done.status == 1
    assert "fail  settings: Setting 'attempts' cannot be 'many'" in done.out


def test_a_variable_that_is_no_setting_is_named() -> None:
    given = {"SUMO_ADV_ATTEMPT": "5", "SUMO_ADV_LIMITS__JERK": "9", "sumo_adv_seed": "1", "PATH": "x"}
    (finding,) = checks.variables(Settings.model_fields, given)
    assert (finding.level, finding.found.split(":")[0]) == (FindingLevel.WARN, "SUMO_ADV_ATTEMPT")
    assert list(checks.variables(Settings.model_fields, {"SUMO_ADV_SEED": "1"})) == []


def test_the_version_names_sumo_and_the_bank(program: Program) -> None:
    done = program.here("--version")
    assert done.out.startswith(f"sumo-adv {__version__} (SUMO 1.28.0; memory bank: schema 3, content ")
    assert done.out == program("--version").out
    bank = program.home / "data" / "sumo_adv"
    bank.mkdir(parents=True)
    (bank / "memory_bank.sqlite").write_text("no bank")
    done = program.here("--version")
    assert (done.status, done.err) == (0, "")
    assert "is not a SQLite file" in done.out


def test_the_version_stands_in_one_place() -> None:
    kept = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'dynamic = ["version"]' in kept
    assert 'path = "sumo_adv/__init__.py"' in kept


def test_a_library_that_is_not_there_is_named() -> None:
    (finding,) = checks.libraries(("numpy", "no_such_library"))
    assert finding.level is FindingLevel.FAIL
    assert "no_such_library (ModuleNotFoundError" in finding.found
    assert "numpy" not in finding.found


def test_extras_are_told_apart() -> None:
    findings = named(checks.extras(lambda module: module != "google.protobuf"))
    assert list(findings) == ["extra womd"]
    assert findings["extra womd"].mend == "pip install 'sumo-adv[womd]'"
    assert named(checks.extras(lambda module: True))["extras"].level is FindingLevel.OK


def test_programs_that_only_some_commands_start() -> None:
    findings = named(checks.programs(lambda name: None, developing=True))
    assert findings["ffmpeg"].level is findings["chromium"].level is FindingLevel.WARN
    assert findings["ffmpeg"].mend == "on Debian: apt-get install ffmpeg"
    assert "chromium" not in named(checks.programs(lambda name: None))
    assert findings["sumo"] == checks.DoctorFinding("sumo", FindingLevel.OK, "1.28.0")


def test_without_bubblewrap_a_container_is_the_second_wall() -> None:
    (outside,) = checks.sandbox(False, contained=False)
    (inside,) = checks.sandbox(False, contained=True)
    assert (outside.level, inside.level) == (FindingLevel.WARN, FindingLevel.OK)
    assert "could do what you can do" in outside.found
    assert outside.mend == "leave SUMO_ADV_BUBBLEWRAP unset"
    assert "the second wall" in inside.found


def test_a_container_is_known_by_its_marks(tmp_path: Path) -> None:
    mark = tmp_path / ".dockerenv"
    assert not checks.in_container((str(mark),), {})
    assert checks.in_container((), {"container": "podman"})
    mark.touch()
    assert checks.in_container((str(mark),), {})


def test_where_results_go_must_be_there(tmp_path: Path) -> None:
    (finding,) = checks.output(tmp_path)
    assert (finding.level, finding.name) == (FindingLevel.OK, "output")
    (lost,) = checks.output(tmp_path / "nowhere")
    assert lost.level is FindingLevel.FAIL
    assert "no such file or directory" in lost.found
