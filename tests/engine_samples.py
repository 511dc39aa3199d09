"""What the engine process of the tests does; importable by name, as a spawned process needs it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy
from sumo_samples import over_the_line

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.simulation.forks import in_forks
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot


class Errands:
    """Commands that go well and commands that go wrong."""

    def __init__(self, slots: list[Connection]) -> None:
        self.slots = slots

    def add(self, a: int, b: int) -> int:
        return a + b

    def ask(self, questions: list[Any]) -> list[Any]:
        """The front's answers, one after the other, through the first slot."""
        answers = []
        for question in questions:
            self.slots[0].send(question)
            answers.append(self.slots[0].recv())
        return answers

    def talk(self, total: int) -> None:
        """Add the squares of the numbers that come in the first slot; the front squares them. 0 is a mistake."""
        self.slots[0].send(total)
        while (number := self.slots[0].recv()) is not None:
            if number == 0:
                raise SimulationError("Nothing was added.")
            self.slots[1].send(number)
            total += self.slots[1].recv()
            self.slots[0].send(total)

    def ask_in_forks(self) -> list[Any]:
        """Each fork asks with its process id through its own slot."""

        def work(slot: Connection) -> Any:
            slot.send(os.getpid())
            return slot.recv()

        return in_forks([partial(work, slot) for slot in self.slots])

    def wrong_use(self) -> None:
        raise UsageError("The input is wrong; give another.")

    def complain(self, words: str, failure: str) -> None:
        """Say something on stderr as SUMO does, and fail."""
        if words:
            os.write(2, f"Error: {words}\n".encode())
        raise SimulationError(failure)

    def bug(self) -> None:
        raise ZeroDivisionError("one by none")

    def hoard(self) -> None:
        numpy.empty(2**56)

    def hoard_in_forks(self) -> list[Any]:
        return list(in_forks([self.hoard]))

    def squares(self, numbers: list[int]) -> list[int]:
        return list(in_forks([partial(pow, n, 2) for n in numbers]))

    def fork_that(self, failure: str) -> list[Any]:
        """A fork that does well, and a fork that fails in the way named."""
        failures: dict[str, Callable[[], Any]] = {
            "divides": lambda: 1 // 0,
            "refuses": self.wrong_use,
            "dies": lambda: os.kill(os.getpid(), signal.SIGKILL),
            "crashes": lambda: os.kill(os.getpid(), signal.SIGSEGV),
            "cannot_be_sent": lambda: lambda: 0,
            "exits": lambda: os._exit(3),
        }
        return in_forks([lambda: 1, failures[failure]])

    def fork_again(self, numbers: list[int], skip: bool = False) -> list[str]:
        """Numbers as words. A negative one crashes until the simulation was loaded again, 0 always; with ``skip`` the
        sentence about it, in capitals, is its result."""

        def work(number: int, note: str = "") -> str:
            if number == 0 or (number < 0 and not note):
                os.kill(os.getpid(), signal.SIGSEGV)
            return f"{number}{note}"

        def reloaded(work: Callable[[], Any]) -> Callable[[], Any]:
            return partial(work, note=" reloaded")

        return in_forks([partial(work, n) for n in numbers], reloaded, str.upper if skip else None)

    def simulate(self, spec: SimulationSpec) -> float:
        """Start SUMO, take one step, stop."""
        simulation = Simulation(spec)
        try:
            simulation.step()
            return simulation.time
        finally:
            simulation.close()

    def branches(self, spec: SimulationSpec) -> list[list[Snapshot]]:
        """30 steps of an attack from step 20 on: two forks at once, in place, and in place after loading again."""
        simulation = Simulation(spec)

        def attack() -> list[Snapshot]:
            seen = []
            for k in range(30):
                simulation.inject({"leader": over_the_line(k)})
                simulation.step()
                seen.append(simulation.read())
            return seen

        def until_trigger() -> None:
            for _ in range(20):
                simulation.step()
                simulation.read()

        until_trigger()
        runs = [*in_forks([attack, attack]), attack()]
        simulation.reload()
        until_trigger()
        runs.append(attack())
        simulation.close()
        return runs

    def pid(self) -> int:
        return os.getpid()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def die(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class BrokenErrands(Errands):
    """A worker that cannot be made."""

    def __init__(self, slots: list[Connection]) -> None:
        raise UsageError("Nothing works here.")
