"""Records the answers of a model anew: ``python examples/recorded_model/record.py NAME [ENCOUNTER...]``.

NAME is a model as for ``--llm``; the server is set as ``docs/models.md`` says. A change of the prompts, of the bank, of
the suite or of the search needs new recordings. Each encounter of ``suite81`` is run as
``tests/test_recorded_model.py`` replays it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
SETTINGS = ("--ego", "idm", "--seed", "0", "--until", "strict", "--tuner", "off", "--learn", "off")


def main() -> None:
    """Run the encounters and keep the exchanges beside this file."""
    model, *named = sys.argv[1:]
    for name in named or sorted(p.stem for p in HERE.glob("*.jsonl")):
        with tempfile.TemporaryDirectory() as scratch:
            out, bank = Path(scratch) / "run", Path(scratch) / "bank.sqlite"
            shutil.copyfile(ROOT / "memory_bank.sqlite", bank)
            case = ROOT / "suites" / "suite81" / f"{name}.toml"
            command = [sys.executable, "-m", "sumo_adv", "run", str(case), *SETTINGS, "--llm", model]
            subprocess.run([*command, "--memory", str(bank), "--out", str(out)], check=False)
            shutil.copyfile(out / "model.jsonl", HERE / f"{name}.jsonl")


if __name__ == "__main__":
    main()
