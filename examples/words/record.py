"""Records the answers of a model to the requests anew: ``python examples/words/record.py MODEL [NAME...]``.

MODEL is a model as for ``--llm``; the server is set as ``docs/models.md`` says. A change of the prompts, of the shipped
networks, of the intents or of the search needs new recordings. Each request is written as
``tests/test_words_recorded.py`` replays it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
SETTINGS = ("--attempts", "40", "--seconds", "3600")


def main() -> None:
    """Write the scenarios and keep the exchanges beside this file."""
    model, *named = sys.argv[1:]
    requests = tomllib.loads((HERE / "requests.toml").read_text(encoding="utf-8"))
    for name in named or requests:
        with tempfile.TemporaryDirectory() as scratch:
            out, run, bank = (Path(scratch) / file for file in ("made.toml", "run", "bank.sqlite"))
            shutil.copyfile(HERE.parent.parent / "memory_bank.sqlite", bank)
            command = [sys.executable, "-m", "sumo_adv", "write", requests[name]["words"], *SETTINGS, "--llm", model]
            subprocess.run([*command, "--memory", bank, "--out", out, "--run-out", run], check=True)
            shutil.copyfile(run / "model.jsonl", HERE / f"{name}.jsonl")


if __name__ == "__main__":
    main()
