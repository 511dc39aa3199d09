"""Write ``docs/images/hunt.svg``, a recording of a hunt in a terminal. (Linux and macOS.)

    python docs/make_recording.py                         a minute; it runs COMMAND
    python docs/make_recording.py --minutes 0.2 --out hunt.svg

The command runs in a terminal of its own, and each line appears when it was printed, ``FASTER`` times as fast, but no
sooner than ``APART`` after the line before. The picture shows as many lines as a terminal, and scrolls. At the end it
goes back to the table of failures; where motion is not wanted (``prefers-reduced-motion``), that is all it shows.
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
COLUMNS, LINE, CHARACTER, MARGIN = 124, 18, 7.8, 14  # characters in a line; pixels
FASTER = 6.0
APART = 0.12  # s between two lines that are shown
SHOWN = 40  # lines
LAST = 12.0  # s for which the table of failures is shown at the end
TABLE = "rank "  # the first line of the table begins with it
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b\][^\x07]*\x07|\r")
PATHS = re.compile(r"/\S*/(hunt\b\S*)")  # this machine's folders

Line = tuple[float, str]


def recorded(arguments: Sequence[str]) -> list[Line]:
    """The lines that ``sumo-adv`` prints, with the seconds after which each was complete."""
    began, lines, rest = time.monotonic(), list[Line](), ""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ |= {"COLUMNS": str(COLUMNS), "TERM": "xterm", "NO_COLOR": "1"}
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
    return textwrap.wrap(line, COLUMNS, subsequent_indent="      ") or [""]


def drawing(command: str, lines: Sequence[Line]) -> str:
    """An animated SVG of the lines."""
    shown = [(0.0, f"$ {command}"), *lines]
    times = [0.0]
    for after, _ in lines:
        times.append(max(after / FASTER, times[-1] + APART))
    seconds = times[-1] + LAST
    table = next((k for k, (_, text) in enumerate(shown) if text.startswith(TABLE)), 0)
    rest = -LINE * max(0, min(table, len(shown) - SHOWN))
    moves, rules, rows = [], [], []
    for k, (at, (_, text)) in enumerate(zip(times, shown, strict=True)):
        share = 100 * at / seconds
        if k >= SHOWN:
            moves.append(f"{share:.2f}%{{transform:translateY({-LINE * (k + 1 - SHOWN)}px)}}")
        if not text:
            continue
        if k:
            rules.append(f"@keyframes l{k}{{0%,{share:.2f}%{{opacity:0}}{share + 0.01:.2f}%,100%{{opacity:1}}}}")
        style = f"animation:l{k} {seconds:.1f}s linear infinite" if k else "fill:#7ee787"
        y = MARGIN + (k + 1) * LINE - 5
        rows.append(f'<text class="l" style="{style}" x="{MARGIN}" y="{y}" xml:space="preserve">{escape(text)}</text>')
    back = 100 * (1 - 0.8 * LAST / seconds)
    rules.append(
        "@keyframes s{0%{transform:none}" + "".join(moves) + f"{back:.2f}%,100%{{transform:translateY({rest}px)}}}}"
    )
    rules.append(f".s{{transform:translateY({rest}px);animation:s {seconds:.1f}s step-end infinite}}")
    still = "@media (prefers-reduced-motion){.l,.s{animation:none!important}}"
    width, inside = COLUMNS * CHARACTER + 2 * MARGIN, min(SHOWN, len(shown)) * LINE
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {inside + 2 * MARGIN}" font-size="13" '
        'fill="#e6edf3" font-family="ui-monospace,SFMono-Regular,Menlo,Consolas,monospace">',
        f"<style>{''.join(rules)}{still}</style>",
        f'<clipPath id="c"><rect y="{MARGIN}" width="100%" height="{inside}"/></clipPath>',
        '<rect width="100%" height="100%" rx="8" fill="#0d1117"/>',
        '<g clip-path="url(#c)"><g class="s">', *rows, "</g></g></svg>", "",
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    shown = [*COMMAND, "--minutes", f"{given.minutes:g}"]
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder:
        lines = recorded([*shown, "--out", str(Path(folder) / "hunt")])
    given.out.write_text(drawing(" ".join(["sumo-adv", *shown]), lines), encoding="utf-8")


if __name__ == "__main__":
    main()
