"""Builds the finished networks from their plain XML: ``python networks/build.py [NAME ..]`` (all without a name).

``src/<name>/<name>.{nod,edg,con,tll,typ}.xml`` -> ``<name>.net.xml``, byte for byte the same on every machine with the
same netconvert (SUMO 1.28): its comment with time stamp and paths, and the schema's address, are taken out.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCES = {
    "nod": "--node-files",
    "edg": "--edge-files",
    "con": "--connection-files",
    "tll": "--tllogic-files",
    "typ": "--type-files",
}
FLAGS = (
    "--offset.disable-normalization", "--precision", "3", "--no-turnarounds", "--junctions.corner-detail", "6",
    "--junctions.internal-link-detail", "12", "--default.junctions.radius", "6", "--no-warnings",
)  # fmt: skip

LEFT_HAND = frozenset({"left_hand_crossing"})


def netconvert_program() -> str:
    """The netconvert beside this Python or on the PATH; ends the program with a sentence if there is none."""
    beside = Path(sys.executable).parent / "netconvert"
    program = str(beside) if beside.is_file() else shutil.which("netconvert")
    if program is None:
        raise SystemExit("netconvert is missing: install it with `pip install eclipse-sumo==1.28.0`.")
    return program


def names() -> list[str]:
    """All networks that have sources."""
    return sorted(folder.name for folder in (HERE / "src").iterdir() if folder.is_dir())


def build(name: str, folder: Path = HERE) -> Path:
    """Writes ``<name>.net.xml`` into ``folder`` and returns its path; ends the program if netconvert refuses."""
    arguments = [netconvert_program(), *FLAGS, *(["--lefthand"] if name in LEFT_HAND else [])]
    for kind, flag in SOURCES.items():
        source = HERE / "src" / name / f"{name}.{kind}.xml"
        if source.is_file():
            arguments += [flag, str(source)]
    with tempfile.TemporaryDirectory() as scratch:
        raw = Path(scratch) / "raw.net.xml"
        done = subprocess.run([*arguments, "-o", str(raw)], capture_output=True, text=True, check=False)
        if done.returncode != 0 or not raw.is_file():
            raise SystemExit(f"netconvert could not build {name}: {done.stderr.strip() or done.stdout.strip()}")
        text = cleaned(raw.read_text(encoding="utf-8"), name)
    target = folder / f"{name}.net.xml"
    unfinished = target.with_suffix(".part")
    unfinished.write_text(text, encoding="utf-8", newline="\n")
    return unfinished.replace(target)


def cleaned(text: str, name: str) -> str:
    """netconvert's output without its comment (time stamp, paths) and without the schema's address."""
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns:xsi="[^"]*"| xsi:noNamespaceSchemaLocation="[^"]*"', "", text)
    return text.replace("<net ", f"<!-- built from networks/src/{name} by networks/build.py -->\n\n<net ", 1)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the networks from their plain XML sources.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(names())}; all if left out")
    chosen = parser.parse_args().names or names()
    unknown = [name for name in chosen if name not in names()]
    if unknown:
        raise SystemExit(f"There is no network '{unknown[0]}' in networks/src: choose from {', '.join(names())}.")
    for name in chosen:
        print(build(name).name)


if __name__ == "__main__":
    main()
