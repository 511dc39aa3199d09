"""The API reference says what the docstrings say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_reference_is_what_the_docstrings_make(tmp_path: Path) -> None:
    code = "import runpy, sys; print(runpy.run_path(sys.argv[1])['page'](), end='')"
    script = ROOT / "docs" / "make_reference.py"
    made = subprocess.run([sys.executable, "-c", code, str(script)], capture_output=True, text=True, check=True)
    assert made.stdout == (ROOT / "docs" / "reference.md").read_text(encoding="utf-8"), (
        "docs/reference.md is out of date: run python docs/make_reference.py"
    )
