"""The replay on the front page of the site: an attack that is run while the site is built (``properdocs.yml``).

``index.md`` has the mark ``<!-- replay -->``. In the site a frame with ``replay.html`` stands there; elsewhere the mark
is a comment, so the page reads well without it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SCENARIO = "signals_red_light"
MARK = "<!-- replay -->"
FRAME = (
    '<iframe src="replay.html" title="Replay of an attack" style="width: 100%; height: 640px; border: 0"></iframe>\n\n'
    f"`sumo-adv run {SCENARIO} --until serious`, replayed: Space plays, `V` puts the run without it beside."
)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page's text with the frame in place of the mark."""
    return markdown.replace(MARK, FRAME)


def on_post_build(config: Any, **_: Any) -> None:
    """Write ``replay.html`` beside the front page. Raises CalledProcessError if the run or its page fails."""
    page = Path(config["site_dir"]) / "replay.html"
    with tempfile.TemporaryDirectory() as folder:
        run = ["run", SCENARIO, "--until", "serious", "--learn", "off", "--out", f"{folder}/run"]
        for words in (
            [*run, "--memory", str(ROOT / "memory_bank.sqlite")],
            ["report", f"{folder}/run", "--out", str(page), "--force"],
        ):
            program = [sys.executable, "-m", "sumo_adv", *words]
            subprocess.run(program, cwd=ROOT, check=True, capture_output=True)
