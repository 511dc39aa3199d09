"""A real llama.cpp server with random weights: its grammar holds the schema, and doctor finds a short context."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cli_samples import TESTS, Program

pytest.importorskip("xllamacpp", reason="the llama.cpp server is not installed: pip install xllamacpp")
pytest.importorskip("gguf", reason="gguf is not installed, which writes the model: pip install gguf")

SEEDS = range(2)


@contextmanager
def llama(folder: Path, context: int, seed: int = 0) -> Iterator[str]:
    """The base URL of a server with that context."""
    command = [sys.executable, str(TESTS / "soak" / "llama_samples.py"), str(context), str(seed), str(folder)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        assert server.stdout is not None and server.stdin is not None
        try:
            yield server.stdout.readline().strip() + "/v1"
        finally:
            server.stdin.close()


@pytest.mark.soak
@pytest.mark.parametrize(("context", "status", "says"), [(32_768, 0, "json_schema"), (4_096, 1, "4,096 tokens")])
def test_doctor_asks_a_real_server(program: Program, context: int, status: int, says: str) -> None:
    with llama(program.folder, context) as address:
        program.variables = {"SUMO_ADV_LLM_BASE_URL": address}
        done = program.here("doctor", "--llm", "any")
    (line,) = (line for line in done.out.splitlines() if " model any: " in line)
    assert done.status == status and says in line, line


@pytest.mark.soak
@pytest.mark.parametrize("seed", SEEDS)
def test_random_weights_name_only_what_is_there(program: Program, seed: int) -> None:
    """No answer is refused for a vehicle, label or mode that the scene does not have: the grammar holds these."""
    with llama(program.folder, 32_768, seed) as address:
        program.variables = {"SUMO_ADV_LLM_BASE_URL": address, "SUMO_ADV_LLM_ANSWER_TOKENS": "300"}
        done = program.here(
            "run", "priority_crossing", "--llm", "any", "--fallback", "builtin", "--attempts", "1", "--out", "out",
            "--json",
        )  # fmt: skip
    assert done.status == 0, done.err
    told = (done.folder / "model.jsonl").read_text(encoding="utf-8")
    exchanges = [json.loads(line) for line in told.splitlines()[1:]]
    assert exchanges and all(each["reply"]["mode"] == "json_schema" for each in exchanges if "reply" in each)
    for free in ("There is no vehicle", "is not in the library", "has no mode"):
        assert free not in told, free
