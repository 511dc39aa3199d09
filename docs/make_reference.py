"""Write ``docs/reference.md``, the API reference, from the docstrings of what ``sumo_adv`` exports.

python docs/make_reference.py
"""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import sumo_adv

PAGE = Path(__file__).with_name("reference.md")
HEAD = """# API reference

Look up every call of `import sumo_adv`. `python docs/make_reference.py` makes this page of the docstrings.
"""


def signature(name: str, thing: Any, *, annotated: bool = True) -> str:
    """The call as Python shows it, without the annotations of what it returns."""
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return name
    kept = [p for p in parameters if p.name != "self"]
    shown = inspect.Signature(kept if annotated else [p.replace(annotation=p.empty) for p in kept])
    return f"{name}{shown}".replace("'", "")


def text(thing: Any) -> str:
    """The docstring as Markdown."""
    return inspect.getdoc(thing) or ""


def members(cls: type) -> list[str]:
    """A table of the public methods and properties that a class defines itself, in its order."""
    lines: list[str] = []
    for name, value in vars(cls).items():
        if name.startswith("_"):
            continue
        function = getattr(value, "func", None) or getattr(value, "fget", None) or value
        if dataclasses.is_dataclass(cls) and not inspect.isfunction(function):
            continue
        if inspect.isfunction(function):
            call = signature(name, function, annotated=False) if inspect.isfunction(value) else name
            lines.append(f"| `.{call}` | {' '.join(text(function).split())} |")
    return [f"| {cls.__name__} | |\n|---|---|", *lines, ""] if lines else []


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name in sorted(set(sumo_adv.__all__) - {"__version__"}, key=str.lower):
        thing = getattr(sumo_adv, name)
        parts.append(f"## {name}\n\n`{signature(name, thing)}`\n\n{text(thing)}\n")
        parts += members(thing) if inspect.isclass(thing) else []
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
