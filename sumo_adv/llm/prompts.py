"""The prompts: versioned files with variables in the folder ``prompts/``.

A file begins with ``version: N``. The lines ``=== system`` and ``=== user`` begin its two parts. A file without these
lines is a piece of other prompts, or has one sentence per line (``key: sentence``). ``$name`` is a variable. A missing
or unknown variable is an error.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Template

from sumo_adv.errors import UsageError
from sumo_adv.llm.chat import estimate_tokens, one_line
from sumo_adv.metrics.avoidance import HAZARD_TO_MANOEUVRE_S
from sumo_adv.metrics.reference import brakers, cc_human

PROMPT_NAMES = (
    "analyzer", "confirm", "danger", "feedback", "generator", "modifier", "novel", "planner", "reading", "request",
    "teams", "walkers", "write",
)  # fmt: skip
MAX_PROMPT_TEXT_CHARACTERS = 600  # of a label or description in a prompt


@dataclass(frozen=True, slots=True)
class Prompt:
    """The prompt of one agent: its system message and its user message."""

    agent: str
    system: str
    user: str

    @property
    def tokens(self) -> int:
        """Estimated number of tokens of both parts."""
        return estimate_tokens((("system", self.system), ("user", self.user)))


def sanitize(text: str) -> str:
    """Make a text from a bank, a file or a person safe for a prompt.

    Returns:
        The text as one line without control characters and fences, cut to ``MAX_PROMPT_TEXT_CHARACTERS``.
    """
    return one_line(text).replace("```", "'''")[:MAX_PROMPT_TEXT_CHARACTERS]


def fenced(text: str) -> str:
    """Change the marks in a person's text so that none can end the part of the prompt that contains the text."""
    return text.replace("<<<", "<").replace(">>>", ">").replace("```", "'''")


class Prompts:
    """All prompt files of a folder.

    Attributes:
        versions: The version and SHA-256 of each file, for the manifest.
    """

    def __init__(self, folder: Path) -> None:
        """Read the files.

        Args:
            folder: The folder of the files.

        Raises:
            UsageError: A file is missing, has no version or lacks a part.
        """
        self._parts: dict[str, tuple[str, str]] = {}
        self.versions: dict[str, dict[str, str]] = {}
        for name in PROMPT_NAMES:
            file = folder / f"{name}.md"
            try:
                text = file.read_text(encoding="utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise UsageError(f"The prompt {file} cannot be read ({error}); reinstall the package.") from error
            head, _, body = text.partition("\n")
            if not re.fullmatch(r"version: \d+", head):
                raise UsageError(f"The prompt {file} must begin with 'version: N'; reinstall the package.")
            digest = hashlib.sha256(text.encode()).hexdigest()
            self.versions[name] = {"version": head.removeprefix("version: "), "sha256": digest}
            self._parts[name] = _split(file, body)

    def piece(self, name: str, **variables: str) -> str:
        """Fill in the variables of a file without parts.

        Raises:
            KeyError: A variable is missing or unknown.
        """
        return _filled(name, self._parts[name][0], variables, set(variables))

    def phrases(self, name: str) -> Mapping[str, str]:
        """Return the sentences of a file with lines ``key: sentence``, by their keys."""
        lines = self._parts[name][0].splitlines()
        return {key: sentence for key, colon, sentence in (line.partition(": ") for line in lines) if colon}

    def phrase(self, name: str, key: str, **variables: str) -> str:
        """Fill in the variables of one sentence of a file with lines ``key: sentence``.

        Raises:
            KeyError: A variable is missing or unknown, or there is no such sentence.
        """
        return _filled(f"{name}: {key}", self.phrases(name)[key], variables, set(variables))

    def render(self, name: str, **variables: str) -> Prompt:
        """Fill in the variables of both parts of a file.

        Raises:
            KeyError: A variable is missing or unknown.
        """
        system, user = self._parts[name]
        return Prompt(name, *(_filled(name, part, variables, _used(system) | _used(user)) for part in (system, user)))


def _split(file: Path, body: str) -> tuple[str, str]:
    if "=== system\n" not in body:
        return body.strip(), ""
    _, _, rest = body.partition("=== system\n")
    system, separator, user = rest.partition("=== user\n")
    if not separator:
        raise UsageError(f"The prompt {file} lacks its part '=== user'; reinstall the package.")
    return system.strip(), user.strip()


def _used(text: str) -> set[str]:
    return set(Template(text).get_identifiers())


def _filled(name: str, text: str, variables: Mapping[str, str], allowed: set[str]) -> str:
    unknown = sorted(set(variables) - allowed)
    if unknown:
        raise KeyError(f"The prompt '{name}' has no variable {', '.join(unknown)}.")
    missing = sorted(_used(text) - set(variables))
    if missing:
        raise KeyError(f"The prompt '{name}' lacks a value for {', '.join(missing)}.")
    return Template(text).substitute(variables)


def danger_words(prompts: Prompts) -> str:
    """Explain by which rules a danger shows and when the reference drivers then act, with the program's values."""
    numbers = {
        "perception": cc_human.PERCEPTION_S, "drift": cc_human.WANDERING_M, "reach": cc_human.DANGER_TTC_S,
        "hard": cc_human.LEADER_HARD_BRAKING_M_S2, "following": cc_human.FOLLOWING_HEADWAY_S,
        "own": cc_human.OWN_BRAKING_M_S2, "reaction": cc_human.HUMAN_REACTION_S, "facing": cc_human.FACING_SIGHT_S,
        "facing_margin": cc_human.FACING_MARGIN_M, "alarm": cc_human.ALARM_BRAKING_M_S2,
        "short": cc_human.YIELDING_BRAKING_M_S2, "crossing": cc_human.CROSSING_SIGHT_S,
        "crossing_margin": cc_human.CROSSING_MARGIN_M, "ramp": brakers.FULL_BRAKING_RAMP_S,
        "full": round(brakers.FULL_BRAKING_M_S2, 1), "steers": round(HAZARD_TO_MANOEUVRE_S - cc_human.PERCEPTION_S, 2),
    }  # fmt: skip
    return prompts.piece("danger", **{name: f"{number:g}" for name, number in numbers.items()})
