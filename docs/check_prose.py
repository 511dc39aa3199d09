"""Find sentences that are hard to read in ``docs/*.md``, and in docstrings and comments of ``sumo_adv``.

python docs/check_prose.py      (a part of make lint; exit status 1 if there are any)

The rules are those of ``CONTRIBUTING.md`` that a pattern can check. Docstrings that a user or a language model reads
at run time (commands, pydantic models) and the generated reference page are left out.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = ("docs/reference.md", "_pb2.py")
NOUNS = re.compile(
    r"(?:The|An?|How|Whether|What|Where|Which|Why|When|One|All|Some|Each|Those|No|Its|Only|Such|Nothing)\b"
)
PATTERNS = {
    "write 'if' for a condition": r"\b(?:None|empty|null|nan|inf|True|False)`*,? where\b"
    r"|(?:^|[.;,] )[Ww]here (?:there (?:is|are)|none|nothing|no \w+|one|several)\b",
    "write 'otherwise' or 'and if not'": r"(?<!or)[,;(] else\b(?! if)|(?:^|[.;] |\| )Else\b",
    "name the result": r"\b(?:come|comes|came|coming) to (?:what|more|no more|less|nothing|none|the same|another)\b"
    r"|\b[Ww]hat (?:[\w`']+ ){1,6}(?:comes?|came) to\b",
    "use the common word": r"\b(?:anew(?!:)|astride|by turns|goes on[.:;|]|brought (?:no|nothing|none)\b|says? so\b"
    r"|say it again|even (?:speed|braking|acceleration)|[Ll]east (?:TTC|distance|badness))",
    "use another verb than 'is of'": r"\b(?:is|are|was|were) of (?:an?|the|this|its|their|one|two|another|all)\b",
}
RULES = {advice: re.compile(pattern) for advice, pattern in PATTERNS.items()}


def prose(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the prose of a page or a module, with the number of its first line."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        fenced = False
        for number, line in enumerate(text.splitlines(), 1):
            fenced ^= line.startswith("```")
            if not fenced and not line.startswith(("```", "    ", "<!--", "#")):
                yield number, line
        return
    for node in documented(ast.parse(text)):
        yield node.body[0].lineno, " ".join((ast.get_docstring(node) or "").split())
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string[1:].strip()


Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def documented(tree: ast.Module) -> Iterator[Documented]:
    """Yield what has a docstring, without pydantic models and commands."""
    for node in ast.walk(tree):
        if isinstance(node, Documented) and ast.get_docstring(node) is not None and not read_at_run_time(node):
            yield node


def read_at_run_time(node: Documented) -> bool:
    """Return whether a docstring is a command's help or goes into the schema of a model."""
    if isinstance(node, ast.ClassDef):
        return any("Model" in ast.unparse(base) or "Part" in ast.unparse(base) for base in node.bases)
    decorators = "" if isinstance(node, ast.Module) else " ".join(map(ast.unparse, node.decorator_list))
    return "grouped" in decorators or ".command" in decorators or ".callback" in decorators


def noun_phrases(file: Path) -> Iterator[tuple[int, str]]:
    """Yield docstrings of functions that begin with a noun phrase where an imperative belongs."""
    for node in documented(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = any(name in ast.unparse(each) for each in node.decorator_list for name in ("property", "setter"))
            head = (ast.get_docstring(node) or "").splitlines()[0]
            if not given and NOUNS.match(head):
                yield node.body[0].lineno, head


def faults() -> Iterator[str]:
    """Yield each place with its fault and what to do."""
    modules = sorted((ROOT / "sumo_adv").rglob("*.py"))
    for file in [*sorted((ROOT / "docs").glob("*.md")), *modules]:
        name = file.relative_to(ROOT).as_posix()
        if name.endswith(GENERATED):
            continue
        for number, text in prose(file):
            for advice, rule in RULES.items():
                for found in rule.finditer(text):
                    yield f"{name}:{number}: '{found[0].strip()}': {advice}"
        if file.suffix == ".py":
            for number, head in noun_phrases(file):
                yield f"{name}:{number}: '{head[:60]}': begin with a verb"


if __name__ == "__main__":
    found = list(faults())
    print(*found, sep="\n", end="\n" if found else "")
    sys.exit(bool(found))
