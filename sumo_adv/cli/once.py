"""One episode with everything it takes: bank, sandbox, models and engine, put together for ``run`` and for Python."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sumo_adv.config import Settings
    from sumo_adv.episode.episode import Episode
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.inputs import RunInput


def play(
    given: RunInput,
    settings: Settings,
    stage: Path,
    scratch: Path,
    tell: Callable[[str, Any], None],
    played: Callable[[], None] = lambda: None,
) -> Episode:
    """The episode; what models say is recorded in the folder ``stage``, demand is generated into ``scratch``, which the
    episode needs until it is written. ``played``: called before all is taken down.

    Raises UsageError or BankError for wrong use; what else goes wrong is the episode's ending.
    """
    from sumo_adv.cli.memory_common import open_for_run
    from sumo_adv.cli.models import open_agents
    from sumo_adv.episode.loop import make_task, run_episode
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.report.outcome import MODEL_FILE

    task = make_task(given, settings, scratch)
    with (
        open_for_run(settings) as bank,
        Sandbox(bubblewrap=None if settings.bubblewrap else False) as sandbox,
        open_agents(settings, sandbox, stage / MODEL_FILE) as agents,
        new_engine() as engine,
    ):
        episode = run_episode(given, settings, task, engine, agents, bank, tell)
        played()
    return episode


def new_engine() -> Engine:
    """An engine process that does not run the user's script again, and that no Ctrl-C reaches while it starts."""
    from sumo_adv.episode.worker import body
    from sumo_adv.simulation.engine import Engine, deaf

    with _without_main(), deaf():
        return Engine(body)


@contextmanager
def _without_main() -> Iterator[None]:
    """A new process is told to import the main module, unless that has no file: so neither scripts need a guard
    (``if __name__ == "__main__"``) nor notebooks a file."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
