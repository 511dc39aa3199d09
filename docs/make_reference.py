"""Write ``docs/reference.md``, the API reference, from the docstrings of what ``sumo_adv`` exports.

python docs/make_reference.py
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import sumo_adv

PAGE = Path(__file__).with_name("reference.md")
HEAD = """# API reference

Look up every call of `import sumo_adv`. `python docs/make_reference.py` makes this page from the docstrings.
"""
SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
ENTRY = re.compile(r"    (\*{0,2}[\w., *]+?)( \[[^\]]+\])?: (.*)")


def signature(name: str, thing: Any) -> str:
    """Return the call as Python shows it, without annotations."""
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return name
    kept = [p.replace(annotation=p.empty) for p in parameters if p.name != "self"]
    return f"{name}{inspect.Signature(kept)}".replace("PosixPath", "Path")


def annotations(thing: Any) -> dict[str, str]:
    """Return the types of the parameters of a call, or of the fields of a class, as they are written."""
    found = {name: str(kind) for name, kind in getattr(thing, "__annotations__", {}).items()}
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return found
    return found | {p.name: str(p.annotation) for p in parameters if p.annotation is not p.empty}


def markdown(text: str) -> str:
    """Turn the marks of docstrings into those of Markdown."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return text.replace("``", "`")


def sections(doc: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the parts of a docstring in Google style: each with its name ('' for running text) and its lines."""
    name, lines = "", list[str]()
    for line in doc.splitlines():
        if line.rstrip(":") in SECTIONS and line.endswith(":"):
            yield name, lines
            name, lines = line.rstrip(":"), []
        elif name and line and not line.startswith(" "):
            yield name, lines
            name, lines = "", [line]
        else:
            lines.append(line)
    yield name, lines


def entries(lines: list[str], types: Mapping[str, str]) -> Iterator[str]:
    """Yield an item of a list for each field of a section; a section without fields is one item."""
    items = list[str]()
    for line in lines:
        field = ENTRY.fullmatch(line)
        if field:
            names = ", ".join(f"`{each.strip()}`" for each in field[1].split(","))
            kind = types.get(field[1].lstrip("*"), "").replace("|", "\\|")
            items.append(f"{names}{f' ({kind})' if kind else ''}{field[2] or ''}: {field[3]}")
        elif line.strip():
            items = [*items[:-1], f"{items[-1]} {line.strip()}"] if items else [line.strip()]
    return (f"- {markdown(item)}" for item in items)


def text(thing: Any) -> str:
    """Return the docstring as Markdown."""
    parts = list[str]()
    for name, lines in sections(inspect.getdoc(thing) or ""):
        if name:
            parts.append(f"**{name}**\n\n" + "\n".join(entries(lines, annotations(thing))))
        elif any(lines):
            parts.append(markdown("\n".join(lines).strip()))
    return "\n\n".join(parts)


def members(cls: type) -> Iterator[str]:
    """Yield a part for each public method and property that a class defines itself, in its order."""
    for name, value in vars(cls).items():
        function = getattr(value, "func", None) or getattr(value, "fget", None) or value
        given = dataclasses.is_dataclass(cls) and not inspect.isfunction(function)
        if name.startswith("_") or given or not inspect.isfunction(function):
            continue
        call = signature(name, function) if inspect.isfunction(value) else name
        yield f"### `{cls.__name__}.{call}`\n\n{text(function)}\n"


def page() -> str:
    """Return the whole page."""
    parts = [HEAD]
    for name in sorted(set(sumo_adv.__all__) - {"__version__"}, key=str.lower):
        thing = getattr(sumo_adv, name)
        parts.append(f"## {name}\n\n`{signature(name, thing)}`\n\n{text(thing)}\n")
        parts += members(thing) if inspect.isclass(thing) else []
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
