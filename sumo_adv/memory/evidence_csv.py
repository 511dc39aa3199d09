"""Evidence as a CSV file, one row a piece, sorted: text that can be compared and reviewed.

Columns: ``planner`` (the name of its file without ``.py``), then those of Evidence; ``relative`` and ``parameters`` are
JSON objects of numbers, ``acceleration`` is a number or a JSON list of [time, m/s2], yes or no is 1 or 0, and what does
not arise (or a TTC that is never) is empty.  Time stamps are left out: they are no part of a bank's content.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Collection, Mapping, Sequence

from sumo_adv.datatypes import acceleration_of, plain_acceleration
from sumo_adv.errors import BankError
from sumo_adv.memory.records import Evidence, SceneSignature, named_numbers

COLUMNS = (
    "planner", "geometry", "relation", "controller", "relative", "parameters", "acceleration", "delay", "attempts",
    "min_ttc", "collided", "critical", "feasible", "rear_end", "valid", "strict", "version", "network", "seed",
)  # fmt: skip

MOST_ROWS = 200_000  # of a file: about 150 MB in memory


def write_evidence(evidence: Sequence[Evidence], names: Mapping[str, str]) -> str:
    """The text of the file; ``names``: planner hash -> name of its file."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(sorted(_row(each, names[each.planner_hash]) for each in evidence))
    return lines.getvalue()


def _row(e: Evidence, name: str) -> list[str]:
    return [
        name, e.scene.geometry, e.scene.relation, e.scene.controller,
        json.dumps(dict(e.scene.relative), sort_keys=True), json.dumps(dict(e.parameters), sort_keys=True),
        json.dumps(plain_acceleration(e.acceleration)), repr(float(e.delay)), str(e.attempts),
        "" if math.isinf(e.min_ttc) else repr(float(e.min_ttc)),
        *(("" if flag is None else str(int(flag))) for flag in
          (e.collided, e.critical, e.feasible, e.rear_end, e.valid, e.strict)),
        e.version, e.network, str(e.seed),
    ]  # fmt: skip


def read_evidence(
    text: str, label: str, hashes: Mapping[str, str], where: str, left_out: Collection[str] = ()
) -> tuple[Evidence, ...]:
    """Evidence about ``label`` from the text of a file; ``hashes``: name of a planner's file -> its hash; rows about
    the planners in ``left_out`` are passed over.

    Raises BankError with the line, ``where`` being the file's name for the sentence.
    """
    try:
        lines = csv.reader(io.StringIO(text), strict=True)
        head = tuple(next(lines, ()))
        if head != COLUMNS:
            raise BankError(f"{where} must have the columns {', '.join(COLUMNS)}.")
        evidence: list[Evidence] = []
        for row in lines:
            if len(evidence) >= MOST_ROWS:
                raise BankError(f"{where} has more than {MOST_ROWS} rows; leave old ones out.")
            if row and row[0] in left_out:
                continue
            try:
                evidence.append(_evidence(dict(zip(COLUMNS, row, strict=True)), label, hashes))
            except (ValueError, KeyError, TypeError, RecursionError, BankError) as error:
                fault = str(error).rstrip(".")
                raise BankError(f"{where}, line {lines.line_num}, is no evidence: {fault}.") from error
    except csv.Error as error:
        raise BankError(f"{where} cannot be read as CSV: {error}.") from error
    return tuple(evidence)


def _evidence(row: Mapping[str, str], label: str, hashes: Mapping[str, str]) -> Evidence:
    if row["planner"] not in hashes:
        raise ValueError(f"there is no planner {row['planner'][:80]!r}")
    for name in ("geometry", "relation", "controller", "version", "network"):
        if len(row[name]) > 200 or not row[name].isprintable():
            raise ValueError(f"{name} must be short text")
    return Evidence(
        label=label,
        planner_hash=hashes[row["planner"]],
        scene=SceneSignature(row["geometry"], row["relation"], _numbers(row["relative"]), row["controller"]),
        attempts=int(row["attempts"]),
        min_ttc=_number(row["min_ttc"]) if row["min_ttc"] else math.inf,
        collided=_flag(row["collided"]),
        critical=_flag(row["critical"]),
        feasible=_flag(row["feasible"]),
        rear_end=_flag(row["rear_end"]),
        valid=_flag(row["valid"]) if row["valid"] else None,
        strict=_flag(row["strict"]) if row["strict"] else None,
        version=row["version"],
        network=row["network"],
        seed=int(row["seed"]),
        parameters=_numbers(row["parameters"]),
        acceleration=acceleration_of(json.loads(row["acceleration"])),
        delay=_number(row["delay"]),
    )


def _flag(text: str) -> bool:
    if text not in ("0", "1"):
        raise ValueError(f"yes or no is 1 or 0, not {text[:20]!r}")
    return text == "1"


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]!r} is not a finite number")
    return value


def _numbers(text: str) -> dict[str, float]:
    return named_numbers(json.loads(text))
