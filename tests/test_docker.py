"""What the image and the compose file promise, read from the files. Building and running them: docker/check.py."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from cli_samples import ROOT
from typer.main import get_command

from sumo_adv.cli.main import app

FOLDER = ROOT / "docker"
Instruction = tuple[str, str]


def instructions(text: str) -> list[Instruction]:
    """The instructions of a Dockerfile, comments dropped and continued lines joined."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    pairs = [line.split(None, 1) for line in joined.splitlines() if line.strip()]
    return [(word.upper(), rest) for word, rest in pairs]


DOCKERFILE = instructions((FOLDER / "Dockerfile").read_text(encoding="utf-8"))
LAST_STAGE = DOCKERFILE[max(k for k, (word, _) in enumerate(DOCKERFILE) if word == "FROM") :]
COMPOSE: dict[str, Any] = yaml.safe_load((FOLDER / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = {name: service for name, service in SERVICES.items() if service["image"] == "sumo_adv"}
COMMANDS = get_command(app).commands  # type: ignore[attr-defined]


def values(word: str, among: list[Instruction] = LAST_STAGE) -> list[str]:
    return [rest for each, rest in among if each == word]


def test_no_layer_holds_a_key_or_something_fetched_from_an_address() -> None:
    named = " ".join(rest for word, rest in DOCKERFILE if word in ("ENV", "ARG", "LABEL"))
    assert re.findall(r"\w*(?:KEY|TOKEN|SECRET|PASSWORD)\w*", named, re.IGNORECASE) == []
    assert "ADD" not in {word for word, _ in DOCKERFILE}
    text = (FOLDER / "Dockerfile").read_text(encoding="utf-8") + (FOLDER / "compose.yaml").read_text(encoding="utf-8")
    assert re.findall(r"https?://(?!ollama:11434/v1)\S+|--(?:extra-)?index-url|curl |wget ", text) == []


def test_what_is_copied_from_the_checkout_is_there_and_let_through() -> None:
    ignore = (ROOT / ".dockerignore").read_text(encoding="utf-8").split("\n")
    assert "*" in ignore
    copied = [name for rest in values("COPY", DOCKERFILE) if "--from" not in rest for name in rest.split()[:-1]]
    assert len(copied) > 5
    for name in copied:
        assert (ROOT / name).exists(), name
        assert f"!{name}" in ignore, name
    let_through = {line[1:] for line in ignore if line.startswith("!")}
    assert let_through == set(copied)


def test_everything_that_the_wheel_wants_is_copied() -> None:
    """Hatchling's forced inclusions, beside the package itself."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    table = project.split("[tool.hatch.build.targets.wheel.force-include]")[1].split("[")[0]
    included = set(re.findall(r'^"([^"]+)" =', table, re.MULTILINE))
    assert included and included <= {name for rest in values("COPY", DOCKERFILE) for name in rest.split()}


@pytest.mark.parametrize("name", sorted(OURS))
def test_our_services_have_all_walls(name: str) -> None:
    service = OURS[name]
    assert re.fullmatch(r"[1-9]\d+:[1-9]\d+", service["user"])
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"] and "cap_add" not in service and "privileged" not in service
    assert "no-new-privileges:true" in service["security_opt"]
    assert all(mount.split(":")[0] == "/tmp" for mount in service["tmpfs"])
    assert all(re.match(r"(runs|bank):/|\.\./examples/external_ego:/ego:ro$", volume) for volume in service["volumes"])


@pytest.mark.parametrize("name", sorted(set(OURS) - {"ego"}))
def test_commands_of_services_are_commands_of_ours(name: str) -> None:
    command = [re.sub(r"\$\{\w+:-(.*?)\}", r"\1", word) for word in OURS[name]["command"]]
    assert "entrypoint" not in OURS[name]
    with COMMANDS[command[0]].make_context(command[0], command[1:]) as context:
        assert context.params["source"] == Path(command[1])


def test_the_run_with_the_expert_has_no_network() -> None:
    assert SERVICES["run"]["network_mode"] == "none"
    assert "--llm" not in SERVICES["run"]["command"] and "environment" not in SERVICES["run"]


def test_only_the_service_for_providers_is_given_keys_and_none_is_written_down() -> None:
    for name, service in SERVICES.items():
        given = service.get("environment", [])
        if name == "remote":
            assert all("=" not in variable for variable in given)  # passed on from the caller's environment
        else:
            assert not any("KEY" in variable for variable in given)
    assert [name for name, service in OURS.items() if "outside" in service.get("networks", [])] == ["remote"]
    assert COMPOSE["networks"]["pair"]["internal"] and COMPOSE["networks"]["models"]["internal"]


@pytest.mark.parametrize("name", ["serve", "gate"])
def test_a_server_lets_in_the_network_that_it_is_in(name: str) -> None:
    command, network = SERVICES[name]["command"], COMPOSE["networks"][SERVICES[name]["networks"][0]]
    assert command[command.index("--allow") + 1] == network["ipam"]["config"][0]["subnet"]
    assert command[command.index("--host") + 1] == "0.0.0.0"
    assert all(port.startswith("127.0.0.1:") for port in SERVICES[name].get("ports", []))


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docker_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def answer(tmp_path: Path, *words: str) -> int:
    """What health.py says of a container with that command line."""
    line = tmp_path / "cmdline"
    line.write_bytes("\0".join(words).encode() + b"\0")
    status: int = load("health").main(line)
    return status


def test_health_asks_a_server_and_leaves_other_commands_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sumo_adv.serve.events import StatusPage

    state = {"health": "ok"}
    python, program = "/opt/sumo_adv/bin/python", "/opt/sumo_adv/bin/sumo-adv"
    assert answer(tmp_path, python, program, "run", "motorway") == 0
    with StatusPage(0, lambda: dict(state)) as page:
        for option in (["--status-port", str(page.port)], [f"--status-port={page.port}"]):
            state["health"] = "ok"
            assert answer(tmp_path, "/sbin/docker-init", "--", "sumo-adv", "serve", "motorway", *option) == 0
            state["health"] = "stopped"
            assert answer(tmp_path, python, program, "serve", "motorway", *option) == 1
    assert "does not say that all is well (HTTP Error 503" in capsys.readouterr().out
    assert answer(tmp_path, python, program, "serve", "motorway", "--status-port", str(page.port)) == 1
    assert answer(tmp_path, python, program, "serve", "motorway") == 1
    assert "Give serve a --status-port" in capsys.readouterr().out


def test_the_check_says_what_it_lacks() -> None:
    check = load("check")
    with pytest.raises(check.Missing, match="no-such-program is not installed"):
        check.need("no-such-program")


def test_a_tmpfs_without_exec_is_named_by_the_sandbox(tmp_path: Path) -> None:
    """What an engine mounts at /tmp, unless it is told ``exec``."""
    tmpfs = tmp_path / "tmpfs"
    tmpfs.mkdir()
    program = (
        "from sumo_adv.errors import SandboxError\n"
        "from sumo_adv.planners.sandbox import Sandbox\n"
        "try:\n"
        "    Sandbox(bubblewrap=False).note\n"
        "except SandboxError as error:\n"
        "    print(error)\n"
    )
    script = 'mount -t tmpfs -o "$2" tmpfs "$1" || exit 77; TMPDIR="$1" exec "$3" -c "$4"'
    printed = {}
    for options in ("exec", "noexec"):
        command = ["sh", "-c", script, "sh", str(tmpfs), options, sys.executable, program]
        if not shutil.which("unshare"):
            pytest.skip("nothing can be mounted here (unshare is missing)")
        done = subprocess.run(["unshare", "-rm", *command], cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"nothing can be mounted here ({done.stderr.strip()})")
        printed[options] = done.stdout
    assert printed["exec"] == ""
    assert printed["noexec"].startswith(f"No program can be started in {tmpfs}, which is mounted noexec: set TMPDIR")


def test_compose_lines_in_the_docs_name_services_profiles_and_commands_that_are_there() -> None:
    text = (ROOT / "docs" / "docker.md").read_text(encoding="utf-8")
    lines = [shlex.split(line, comments=True)[4:] for line in text.splitlines() if "docker compose -f" in line]
    assert len(lines) > 5
    named = set()
    for words in lines:
        if words[0] == "--profile":
            assert words[1] in {p for service in SERVICES.values() for p in service["profiles"]}
            named.add(words[1])
            words = words[2:]
        rest = [word for word in words[1:] if not word.startswith("--")]
        assert words[0] in ("up", "run", "exec")
        assert set(rest[:1]) <= set(SERVICES), rest
        named |= set(rest[:1])
        if words[0] == "run" and len(rest) > 1:
            command = words[words.index(rest[0], 1) + 1 :]
            COMMANDS[command[0]].make_context(command[0], command[1:])
    assert named >= {"run", "serve", "ego", "ollama", "model", "remote"}
