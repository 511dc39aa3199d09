"""Attacks with made-up input: a number of tries, each made of a seed, and what became of them.

An attack does one try in an empty folder: it makes input with ``rng``, gives it to the program, and returns a word for
what it came to. A SumoAdvError with one sentence is the program's refusal. Anything else that is raised, or a try that
lasts longer than ``PATIENCE``, broke it; its number repeats it alone: ``--seed S --first NUMBER --count 1``.

A new attack is a file beside this one: ``attack(rng, folder)`` and ``main(attack)``.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from sumo_adv.errors import SumoAdvError

PATIENCE = 120  # s that a try may last, on a busy machine too
MEMORY = 4 * 2**30  # bytes that a program may have mapped: a try that wants more gets a MemoryError
LONGEST = 20_000  # characters of a refusal, which may quote a long value
KEPT = 10  # broken tries that are told in full

Attack = Callable[[random.Random, Path], str]

NASTY: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, -5, 7, 2**31, 2**63, 10**400, 0.0, -0.0, 1e-300, 1e7, 1e308, -1e308, float("inf"),
    float("nan"), "", " ", "x", "x" * 5000, "\0", "a\nb", "../../x", "/", "\u202e", "\U0001f697", "1e999", [], {}, [[]],
    [None], {"": None}, [0] * 500,
)  # fmt: skip
"""Values that formats allow and nobody means."""


@dataclass
class Tally:
    """How many tries came to what, and those that broke the program: number -> why."""

    words: Counter[str] = field(default_factory=Counter)
    broken: dict[int, str] = field(default_factory=dict)


class Hung(BaseException):
    """A try that lasted too long; no ``except Exception`` of the program takes it."""


def hold(attack: Attack, *, seed: int, count: int, first: int = 0) -> Tally:
    """The tries ``first`` to ``first + count - 1`` of an attack."""
    tally = Tally()
    for number in range(first, first + count):
        with tempfile.TemporaryDirectory(prefix="sumo_adv-fuzz-") as folder:
            try:
                with _alarm():
                    tally.words[attack(random.Random(f"{seed}/{number}"), Path(folder))] += 1
            except SumoAdvError as error:
                words = str(error)
                if "\n" in words or not words.endswith((".", ")")) or len(words) > LONGEST:
                    tally.broken[number] = f"no sentence: {words[:500]!r}"
                tally.words["refused"] += 1
            except (Exception, Hung):
                tally.broken[number] = traceback.format_exc()[-3000:]
    return tally


@contextmanager
def _alarm() -> Iterator[None]:
    def ring(number: int, frame: FrameType | None) -> None:
        raise Hung(f"did not finish within {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def main(attack: Attack, count: int) -> None:
    """The program: a line of JSON about the tries; exit status 1 if any broke something."""
    options = argparse.ArgumentParser()
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--count", type=int, default=count)
    options.add_argument("--first", type=int, default=0)
    given = options.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    tally = hold(attack, seed=given.seed, count=given.count, first=given.first)
    for number, why in list(tally.broken.items())[:KEPT]:
        print(f"-- try {number} (--seed {given.seed} --first {number} --count 1)\n{why}", file=sys.stderr)
    print(json.dumps({"tries": given.count, **tally.words, "broken": sorted(tally.broken)}))
    sys.exit(bool(tally.broken))


# -- making input ------------------------------------------------------------------------------------------------------


def one_of(rng: random.Random, items: Sequence[Any]) -> Any:
    """One of the items."""
    return items[rng.randrange(len(items))]


def wrong_bytes(rng: random.Random, data: bytes) -> bytes:
    """Bytes with some flipped, cut off, doubled or moved."""
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 50))):
        if not made:
            return b""
        at = rng.randrange(len(made))
        damage = rng.randrange(5)
        if damage <= 1:
            made[at] ^= 1 << rng.randrange(8)
        elif damage == 2:
            del made[at : at + rng.choice((1, 10, 1000))]
        elif damage == 3:
            made[at:at] = made[at : at + rng.choice((1, 10, 1000))]
        else:
            made[at : at + 4] = rng.randbytes(4)
    return bytes(made)


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) below a value of lists and dictionaries."""
    left = [value]
    while left:
        each = left.pop()
        keys = list(each) if isinstance(each, dict) else list(range(len(each))) if isinstance(each, list) else []
        for key in keys:
            yield each, key
            left.append(each[key])


def wrong_values(rng: random.Random, value: Any, most: int = 3) -> None:
    """Replace, remove or double up to ``most`` values below one of lists and dictionaries, in place."""
    for _ in range(rng.randint(1, most)):
        all_places = list(places(value))
        if not all_places:
            return
        container, key = one_of(rng, all_places)
        change = rng.randrange(6)
        if change == 0:
            del container[key]
        elif change == 1 and isinstance(container, list):
            container.extend([container[key]] * rng.choice((1, 3, 1000)))
        elif change == 2:
            container[key] = [container[key]]
        else:
            container[key] = one_of(rng, NASTY)
