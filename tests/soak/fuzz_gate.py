"""The gate against random and mutated messages: ``python tests/soak/fuzz_gate.py [MINUTES [SEED]]`` (10 and 0).

SUMO must live, time must go on, and nothing may be the client's that is not. Prints the outcomes of the messages, or
the seed, the number of the message and the last messages before a fault; exit status 1 then.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import traci

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gate_fuzzer import Fuzzer, closing
from gate_samples import scene

OTHERS = {"other", "crossing"}


def fuzz(folder: Path, seed: int, seconds: float, most: int = sys.maxsize) -> Counter[str]:
    """The outcomes of the messages that a client sent within ``seconds``, ``most`` at most.

    Raises:
        AssertionError: something broke; the last messages are in it.
    """
    failures: list[str] = []
    with scene(folder, deadline=2.0) as simulation, closing(Fuzzer(simulation.gate.port, seed)) as fuzzer:

        def attack() -> None:
            until = time.monotonic() + seconds
            try:
                for _ in range(most):
                    if time.monotonic() > until:
                        break
                    fuzzer.send()
            except Exception as error:
                failures.append(f"{type(error).__name__}: {error}")

        attacker = threading.Thread(target=attack, daemon=True)
        attacker.start()
        try:
            while attacker.is_alive():
                simulation.step(10)
                # Where it arrived, or was sent away: there is always one.
                if "ego" not in simulation.ours.vehicle.getIDList():
                    with contextlib.suppress(traci.TraCIException):  # it is about to depart
                        simulation.ours.vehicle.add("ego", "through", departPos="100")
                assert not OTHERS & simulation.gate.own, simulation.gate.own
            before = simulation.time()
            simulation.step(3)
            assert simulation.time() > before and not failures, failures
        except Exception as error:
            last = "\n".join(message.hex() for message in fuzzer.sent[-5:])
            count = sum(fuzzer.counts.values())
            last_error = simulation.sumo.last_error
            raise AssertionError(
                f"seed {seed}, message {count}: {error} {last_error}\nthe last messages:\n{last}"
            ) from error
        fuzzer.close()
        simulation.end()
    return fuzzer.counts


def main(minutes: float = 10.0, seed: int = 0) -> int:
    """One seed after the other, a minute each."""
    total: Counter[str] = Counter()
    until = time.monotonic() + 60.0 * minutes
    status = 0
    while time.monotonic() < until:
        with tempfile.TemporaryDirectory() as folder:
            try:
                total += fuzz(Path(folder), seed, min(60.0, until - time.monotonic()))
            except AssertionError as error:
                print(error)
                status = 1
        seed += 1
    print(dict(total))
    return status


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:3])))
