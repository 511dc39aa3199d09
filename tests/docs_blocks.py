"""The code blocks of README and docs: fenced or indented, with the mark that stands before them.

A mark is an HTML comment on the line before (a blank line may be between): ``<!-- run -->``: the tests run the block in
the page's own folder, in order; ``<!-- file: NAME -->``: they save it there; ``<!-- not run: WHY -->``: they do not.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cli_samples import ROOT

MARK = re.compile(r"<!-- (run|not run|file)(?:: (.+?))? -->")
PROGRAMS = frozenset(
    {"sumo-adv", "python", "python3", "make", "pip", "git", "ray", "cd", "export", "source", "sudo", "docker"}
)
PYTHON = re.compile(r"(?:import|from|def|class) \w|@\w")
INLINE = re.compile(r"(?<!`)`(sumo-adv [^`\n]+|make [a-z]+[^`\n]*|python -m sumo_adv [^`\n]+)`")


@dataclass(frozen=True, slots=True)
class Block:
    """A code block. ``mark``: run, not run, file, or none of them (""); ``detail``: what stands behind the mark."""

    page: Path
    line: int
    language: str
    text: str
    mark: str
    detail: str

    @property
    def location(self) -> str:
        """Page and line, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Its command lines; empty if it is no block of commands."""
        if self.language in ("python", "toml", "text", "json"):
            return []
        lines = [line.strip() for line in self.text.replace("\\\n", " ").splitlines()]
        return [line for line in lines if line.split(" ", 1)[0] in PROGRAMS]

    @property
    def is_python(self) -> bool:
        """Whether it is Python to be run."""
        return self.language == "python" or (not self.language and PYTHON.match(self.text) is not None)


def pages() -> list[Path]:
    """All that is checked: README, CONTRIBUTING, docs, research, and the READMEs of examples and benchmarks."""
    return sorted([
        ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "research").glob("*.md"),
        *(ROOT / "examples").rglob("*.md"), ROOT / "benchmarks" / "README.md",
    ])  # fmt: skip


def blocks(page: Path) -> Iterator[Block]:
    """The code blocks of a page, from its first line to its last."""
    lines = page.read_text(encoding="utf-8").splitlines()
    at, mark, after_blank = 0, ("", ""), True
    while at < len(lines):
        line = lines[at]
        if marked := MARK.fullmatch(line.strip()):
            mark = (marked[1], marked[2] or "")
        elif line.startswith("```"):
            end = next(k for k in range(at + 1, len(lines)) if lines[k].startswith("```"))
            yield Block(page, at + 1, line[3:].strip(), "\n".join(lines[at + 1 : end]) + "\n", *mark)
            at, mark = end, ("", "")
        elif after_blank and line.startswith("    ") and line.strip():
            end = at
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            text = "\n".join(each[4:] for each in lines[at:end]).rstrip() + "\n"
            yield Block(page, at + 1, "", text, *mark)
            at, mark, line = end - 1, ("", ""), lines[end - 1]
        elif line.strip():
            mark = ("", "")
        after_blank = not lines[at].strip() or lines[at].startswith("#") or bool(MARK.fullmatch(lines[at].strip()))
        at += 1


def inline_commands(page: Path) -> list[str]:
    """What stands between backticks in prose and looks like a command."""
    text = page.read_text(encoding="utf-8")
    outside = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return [match[1] for match in INLINE.finditer(outside)]


def words(command: str) -> list[str]:
    """A command line as a shell splits it, without comment and what comes behind a pipe, ``&`` or ``>``."""
    split = shlex.split(command, comments=True)
    for k, word in enumerate(split):
        if word in ("|", "&", "&&", ";", ">", "2>"):
            return split[:k]
    return split
