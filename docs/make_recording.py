"""Write ``docs/images/hunt.svg``, a recording of a hunt in a terminal. (Linux and macOS.)

    python docs/make_recording.py                         a minute and a half; it runs COMMAND
    python docs/make_recording.py --minutes 0.2 --out hunt.svg

The command runs in a terminal of its own, and each line appears when it was printed, ``FASTER`` times as fast. Where
motion is not wanted (``prefers-reduced-motion``) or not known, all lines are there.
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import sys
import tempfile
import textwrap
import time
from collections.abc import Sequence
from html import escape
from pathlib import Path

OUT = Path(__file__).with_name("images") / "hunt.svg"
COMMAND = ("hunt", "motorway", "priority_crossing", "roundabout", "--ego", "idm")
COLUMNS, LINE, CHARACTER, MARGIN = 100, 18, 7.8, 14  # characters in a line; pixels
FASTER = 6.0
LAST = 8.0  # s for which the end is shown
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b\][^\x07]*\x07|\r")
PATHS = re.compile(r"/\S*/(hunt\b\S*)")  # this machine's folders

Line = tuple[float, str]


def recorded(arguments: Sequence[str]) -> list[Line]:
    """The lines that ``sumo-adv`` prints, with the seconds after which each was complete."""
    began, lines, rest = time.monotonic(), list[Line](), ""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ |= {"COLUMNS": str(COLUMNS), "TERM": "dumb"}
        os.execv(sys.executable, [sys.executable, "-m", "sumo_adv", *arguments])
    while True:
        try:
            part = os.read(terminal, 4096)
        except OSError:  # the command has ended
            break
        if not part:
            break
        *whole, rest = (rest + part.decode(errors="replace")).split("\n")
        lines += [(time.monotonic() - began, row) for line in whole for row in wrapped(CONTROL.sub("", line))]
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status:
        raise SystemExit("\n".join(line for _, line in lines) + f"\nThe command ended with status {status}.")
    return lines


def wrapped(line: str) -> list[str]:
    """A line as the terminal shows it."""
    line = PATHS.sub(r"runs/\1", line.rstrip())
    return textwrap.wrap(line, COLUMNS, subsequent_indent="      ", drop_whitespace=False) or [""]


def drawing(command: str, lines: Sequence[Line]) -> str:
    """An animated SVG of the lines."""
    seconds = (lines[-1][0] if lines else 0.0) / FASTER + LAST
    width, height = COLUMNS * CHARACTER + 2 * MARGIN, (len(lines) + 1) * LINE + 2 * MARGIN
    rows = [
        f'<text x="{MARGIN}" y="{MARGIN + LINE - 5}" fill="#7ee787" xml:space="preserve">$ {escape(command)}</text>'
    ]
    rules = []
    for k, (after, text) in enumerate(lines, 1):
        if not text:
            continue
        share = 100 * after / FASTER / seconds
        rules.append(f"@keyframes l{k}{{0%,{share:.2f}%{{opacity:0}}{share + 0.01:.2f}%,100%{{opacity:1}}}}")
        style = f"animation:l{k} {seconds:.1f}s linear infinite"
        y = MARGIN + (k + 1) * LINE - 5
        rows.append(f'<text class="l" style="{style}" x="{MARGIN}" y="{y}" xml:space="preserve">{escape(text)}</text>')
    still = "@media (prefers-reduced-motion){.l{animation:none!important}}"
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height}" font-size="13" fill="#e6edf3" '
        'font-family="ui-monospace,SFMono-Regular,Menlo,Consolas,monospace">',
        f"<style>{''.join(rules)}{still}</style>",
        '<rect width="100%" height="100%" rx="8" fill="#0d1117"/>', *rows, "</svg>", "",
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.5)
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    shown = [*COMMAND, "--minutes", f"{given.minutes:g}"]
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder:
        lines = recorded([*shown, "--out", str(Path(folder) / "hunt")])
    given.out.write_text(drawing(" ".join(["sumo-adv", *shown]), lines), encoding="utf-8")


if __name__ == "__main__":
    main()
