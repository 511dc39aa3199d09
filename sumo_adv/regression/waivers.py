"""Cases that may fail for a while: ``waive.toml`` in the folder of a suite.

[[waive]]
case = "crossing-3"
reason = "the new planner yields too late; ticket 812"
until = 2027-01-31
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from sumo_adv.errors import UsageError
from sumo_adv.parsing import dotted

WAIVERS = "waive.toml"


class Waiver(BaseModel):
    """A case that does not count until the end of a day, and why."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    case: str
    reason: str
    until: date

    @field_validator("reason")
    @classmethod
    def _said(cls, reason: str) -> str:
        if not reason.strip():
            raise ValueError("say why the case is waived")
        return reason.strip()

    @property
    def words(self) -> str:
        return f"Waived until {self.until}: {self.reason}"


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    waive: tuple[Waiver, ...] = ()


@dataclass(frozen=True, slots=True)
class Waivers:
    """The waivers in force.

    Attributes:
        by_case: The waivers by case.
        notes: A sentence for each waiver that is not in force.
    """

    by_case: dict[str, Waiver] = field(default_factory=dict)
    notes: Sequence[str] = ()


def read_waivers(file: Path, cases: Collection[str], every: Collection[str], today: date | None = None) -> Waivers:
    """Read the waivers of a file.

    Args:
        file: The path of the file.
        cases: The names of the cases that run.
        every: The names of all cases of the suite; a waiver of another one is unknown.
        today: The current day; None takes that of the clock.

    Raises:
        UsageError: The file cannot be read, or a case is waived twice.
    """
    waivers, now = _parsed(file).waive, today or datetime.now().astimezone().date()
    in_force, notes = dict[str, Waiver](), list[str]()
    for waiver in waivers:
        if waiver.case not in every:
            notes.append(f"{file} waives the case '{waiver.case}', which the suite does not have: remove the waiver.")
        elif waiver.until < now:
            notes.append(f"The waiver of the case '{waiver.case}' ended on {waiver.until}, so the case counts again.")
        elif waiver.case in in_force:
            raise UsageError(f"{file} waives the case '{waiver.case}' twice; keep one.")
        else:
            in_force[waiver.case] = waiver
    return Waivers({name: waiver for name, waiver in in_force.items() if name in cases}, notes)


def _parsed(file: Path) -> _File:
    """Parse the file; raise UsageError if it is wrong."""
    try:
        return _File.model_validate(tomllib.loads(file.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"The waivers {file} cannot be read ({error}).") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = dotted(first["loc"])
        raise UsageError(
            f"The waivers {file} have a bad '{key}' ({first['msg'].removeprefix('Value error, ')}); each [[waive]] "
            "needs case, reason and until (a date such as 2027-01-31)."
        ) from error
