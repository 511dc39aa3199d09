"""A server as a user has it, and programs that drive its ego: processes of their own, on ports of their own."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cli_samples import PATIENCE, ROOT, Program

EXAMPLE = ROOT / "examples" / "external_ego" / "idm_ego.py"
needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="the SUMO program is not installed: pip install sumo-adv[sumo]"
)
Event = dict[str, Any]


class Server:
    """A running ``serve`` of a program's folder, told by its events file."""

    def __init__(self, program: Program, *arguments: str) -> None:
        self.folder = program.folder
        self._events = program.folder / "events.jsonl"
        self._clients: list[subprocess.Popen[str]] = []
        self.process = program.start(
            "serve", *arguments, "--port", "0", "--out", "out", "--events", self._events, "--memory", "bank.sqlite"
        )

    @property
    def port(self) -> int:
        """Where the client connects."""
        return int(self.wait("listening")["port"])

    def events(self, kind: str | None = None) -> list[Event]:
        """What has happened; every line is whole JSON."""
        if not self._events.exists():
            return []
        text = self._events.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        all_events = [json.loads(line) for line in whole.splitlines()]
        return [e for e in all_events if kind is None or e["event"] == kind]

    def wait(self, kind: str, count: int = 1, *, after: Callable[[Event], bool] = bool) -> Event:
        """The event of that kind that is the ``count``-th for which ``after`` holds."""
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            matches = [e for e in self.events(kind) if after(e)]
            if len(matches) >= count:
                return matches[count - 1]
            assert self.process.poll() is None, (kind, self.process.communicate())
            time.sleep(0.02)
        raise AssertionError(f"no {kind} came: {self.events()[-5:]}")

    def client(self, script: Path = EXAMPLE, *arguments: str) -> subprocess.Popen[str]:
        """A program that drives the ego."""
        command = [sys.executable, str(script), str(self.port), *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self._clients.append(process)
        return process

    def end(self) -> tuple[int, str, str]:
        """Wait for the server's own end: status, stdout, stderr."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def outcomes(self) -> list[dict[str, Any]]:
        """``outcome.json`` of every encounter, in order."""
        folders = sorted((self.folder / "out").glob("encounter-*"))
        return [json.loads((f / "outcome.json").read_text(encoding="utf-8")) for f in folders]

    def simulators(self) -> list[int]:
        """SUMO programs that this server started and that still run: their demand lies in its temporary folder."""
        mark = str(self.folder).encode()
        pids = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if b"--remote-port" in command and mark in command and b"serve\0" not in command:
                pids.append(int(entry.name))
        return pids

    def close(self) -> None:
        """End what is left."""
        for client in self._clients:
            client.kill()
            client.communicate()
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()


@contextmanager
def serving(program: Program, *arguments: str) -> Iterator[Server]:
    """A server; whatever is left of it is ended."""
    server = Server(program, *arguments)
    try:
        yield server
    finally:
        server.close()


def shapes(values: Sequence[Event]) -> list[str]:
    """Kinds in order, the same ones in a row once."""
    kinds = [e["event"] for e in values]
    return [k for i, k in enumerate(kinds) if i == 0 or kinds[i - 1] != k]
