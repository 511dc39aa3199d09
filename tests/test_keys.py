"""A model's key goes to no address that a file names."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_samples import Program

from sumo_adv.api_batch import planned
from sumo_adv.campaigns.plan import read_plan
from sumo_adv.config import load_settings
from sumo_adv.errors import UsageError
from sumo_adv.simulation.sumocfg import read_sumocfg

THEIRS, OURS = "http://attacker.example/v1", "http://gpu:8000/v1"


@pytest.fixture(params=["settings", "plan", "vary"])
def file(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A file of a stranger that names a server."""
    made = tmp_path / f"{request.param}.toml"
    text = {
        "settings": f'llm_base_url = "{THEIRS}"',
        "plan": f'inputs = ["motorway"]\n[settings]\nllm_base_url = "{THEIRS}"',
        "vary": f'inputs = ["motorway"]\n[vary]\nllm_base_url = ["{THEIRS}", "{OURS}"]',
    }
    made.write_text(text[request.param], encoding="utf-8")
    return made


def read(file: Path) -> object:
    return load_settings(file) if file.name == "settings.toml" else read_plan(file)


def test_a_file_may_not_name_the_server_while_the_key_comes_from_elsewhere(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read(file)  # without a key nothing is given away
    monkeypatch.setenv("SUMO_ADV_LLM_API_KEY", "secret-of-mine")
    with pytest.raises(UsageError, match="names llm_base_url, a server that would receive your key") as refused:
        read(file)
    assert "secret-of-mine" not in str(refused.value)
    if file.name != "vary.toml":  # which has two addresses
        monkeypatch.setenv("SUMO_ADV_LLM_BASE_URL", THEIRS)  # the user trusts it
        read(file)


def test_an_empty_address_of_the_users_is_none(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Docker Compose sets it for a variable without a value: the file's address would be used, with the key."""
    monkeypatch.setenv("SUMO_ADV_LLM_API_KEY", "secret-of-mine")
    monkeypatch.setenv("SUMO_ADV_LLM_BASE_URL", "")
    with pytest.raises(UsageError, match="names llm_base_url, a server that would receive your key"):
        read(file)


@pytest.mark.parametrize("name", ["LLM_BASE_URL", "Llm_base_url"])
def test_a_setting_has_one_name(file: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """In capitals the address went past the check, and the key to it."""
    file.write_text(file.read_text(encoding="utf-8").replace("llm_base_url", name), encoding="utf-8")
    monkeypatch.setenv("SUMO_ADV_LLM_API_KEY", "secret-of-mine")
    with pytest.raises(UsageError, match=f"There is no setting '{name}'; the nearest is 'llm_base_url'"):
        load_settings(file) if file.name == "settings.toml" else planned(file, {}, {})
    with pytest.raises(UsageError, match=f"There is no setting '{name}'"):
        load_settings(None, **{name: THEIRS})  # of a manifest


def test_the_users_own_address_goes_before_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "settings.toml"
    file.write_text(f'llm_base_url = "{THEIRS}"', encoding="utf-8")
    monkeypatch.setenv("SUMO_ADV_LLM_API_KEY", "secret-of-mine")
    assert load_settings(file, llm_base_url=OURS).llm_base_url == OURS
    monkeypatch.setenv("sumo_adv_llm_base_url", OURS)
    assert load_settings(file).llm_base_url == OURS


def test_a_run_with_such_a_file_ends_before_it_asks(program: Program) -> None:
    (program.folder / "s.toml").write_text(f'llm_base_url = "{THEIRS}"\nllm = "gpt-x"', encoding="utf-8")
    program.variables = {"SUMO_ADV_LLM_API_KEY": "secret-of-mine"}
    done = program.here("run", "motorway", "--settings", "s.toml", "--out", "out")
    assert done.status == 2
    assert "would receive your key" in done.err


@pytest.mark.parametrize("option", ["device.emissions.explicit", "threads", "net-file", "weight-files"])
@pytest.mark.parametrize("value", ["a${SUMO_ADV_LLM_API_KEY}", "$${NONE}{SUMO_ADV_LLM_API_KEY}"])
def test_a_sumocfg_has_no_key_among_its_values(tmp_path: Path, option: str, value: str) -> None:
    """They stand in messages, ``manifest.json`` and ``outcome.json``, which people share."""
    file = tmp_path / "c.sumocfg"
    file.write_text(f'<configuration><{option} value="{value}"/></configuration>', encoding="utf-8")
    with pytest.raises(UsageError, match="names the variable 'SUMO_ADV_LLM_API_KEY', which may hold a secret"):
        read_sumocfg(file, {"SUMO_ADV_LLM_API_KEY": "secret-of-mine"})
