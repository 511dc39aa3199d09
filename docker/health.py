"""How the container is: a server is asked at its status page; any other command is well as long as it runs.

usage: python health.py [FILE]     FILE: the command line of the container's first process, parts ended by NUL.
"""

import sys
import urllib.error
import urllib.request
from pathlib import Path

COMMAND = Path("/proc/1/cmdline")  # of sumo-adv, or of the init process that was given it
SECONDS = 4.0


def status_port(words: list[str]) -> int | None:
    """The port in ``--status-port N`` or ``--status-port=N``; None if there is none."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, _, value = word.partition("=")
        if name == "--status-port":
            text = value or following
            return int(text) if text.isdecimal() else None
    return None


def health(words: list[str]) -> str | None:
    """None if all is well, else a sentence."""
    if "serve" not in words:
        return None
    port = status_port(words)
    if not port:
        return "Give serve a --status-port other than 0: there is nothing to ask."
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=SECONDS) as answer:
            return None if answer.status == 200 else f"The status page answered {answer.status}."
    except (OSError, urllib.error.URLError) as error:
        return f"The status page at port {port} does not say that all is well ({error})."


def main(file: Path = COMMAND) -> int:
    """Print what is wrong; the exit status says it to the engine."""
    wrong = health(file.read_bytes().decode(errors="replace").split("\0"))
    if wrong is not None:
        print(wrong)
    return int(wrong is not None)


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
