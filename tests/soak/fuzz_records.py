"""Waymo records with wrong values in any field, and files of them with wrong bytes.

``python tests/soak/fuzz_records.py --seed 1 --count 300``; three of ten that can be read are converted.
"""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path
from typing import Any

from fuzz import NASTY, main, one_of, wrong_bytes

from womd_samples import four_way, frame, merge, overpass, straight  # isort: skip

from sumo_adv.womd.convert import convert_record
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.scenario_pb2 import Scenario

CONVERTED = 0.3  # share of the records that can be read which are converted, about a second each
FAR = (1e7, 3e4, -3e4, 1e-9, 1e16)  # m


@cache
def samples() -> tuple[bytes, ...]:
    """Some records as bytes."""
    return tuple(build().SerializeToString() for build in (straight, four_way, merge, overpass))


def attack(rng: random.Random, folder: Path) -> str:
    """Write a file with one wrong record, and read it."""
    data = one_of(rng, samples())
    if rng.random() < 0.6:
        message = Scenario.FromString(data)
        for _ in range(rng.choice((1, 1, 2, 5))):
            _wrong_field(rng, message)
        data = message.SerializeToString()
    else:
        data = wrong_bytes(rng, data)
    framed = frame(data)
    path = folder / "a.tfrecord"
    path.write_bytes(wrong_bytes(rng, framed) if rng.random() < 0.1 else framed)
    records = list(read_records(path))
    if records and rng.random() < CONVERTED:
        convert_record(records[0], folder, traffic=False)
        return "converted"
    return "read"


def _wrong_field(rng: random.Random, message: Any) -> None:
    """Change one field somewhere in a message: of a random field down to one of plain values."""
    fields = [field for field, _ in message.ListFields()]
    if not fields:
        return
    field = one_of(rng, fields)
    value = getattr(message, field.name)
    if hasattr(value, "__len__") and not isinstance(value, str | bytes):
        if not len(value):
            return
        k = rng.randrange(len(value))
        if hasattr(value[k], "ListFields") and rng.random() < 0.8:
            _wrong_field(rng, value[k])
        elif rng.random() < 0.5:
            del value[k : k + rng.choice((1, 1, 50))]
        elif hasattr(value[k], "ListFields"):
            value.extend([value[k]] * rng.choice((1, 20)))
        else:
            _put(rng, lambda new: value.__setitem__(k, new))
    elif hasattr(value, "ListFields"):
        _wrong_field(rng, value)
    elif rng.random() < 0.2:
        message.ClearField(field.name)
    else:
        _put(rng, lambda new: setattr(message, field.name, new))


def _put(rng: random.Random, put: Any) -> None:
    """A value that protobuf takes there."""
    for _ in range(8):
        try:
            put(one_of(rng, (*NASTY, *FAR, *FAR)))
        except (TypeError, ValueError, OverflowError):
            continue
        return


if __name__ == "__main__":
    main(attack, 300)
