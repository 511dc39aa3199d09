"""Composing who plays analyzer, generator and modifier from the settings, for the commands that need it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sumo_adv.config import Settings

if TYPE_CHECKING:
    from sumo_adv.agents.agents import Agents
    from sumo_adv.agents.prompts import Prompts
    from sumo_adv.llm.chat import ChatModel
    from sumo_adv.planners.sandbox import Sandbox


@contextmanager
def open_agents(settings: Settings, sandbox: Sandbox, record: Path | None = None) -> Iterator[Agents]:
    """The agents; every exchange with its models goes into the file ``record``. Raises UsageError."""
    from sumo_adv.agents.agents import ROLES, Agents
    from sumo_adv.llm.ledger import Ledger

    names = {role: name for role in ROLES if (name := settings.player(role)) is not None}
    if not names:
        yield Agents(settings, sandbox)
        return
    from sumo_adv.llm.client import connect
    from sumo_adv.llm.recording import Recorder

    ledger = Ledger.for_settings(settings)
    by_name: dict[str, ChatModel] = {name: connect(name, settings, ledger) for name in sorted(set(names.values()))}
    with ExitStack() as stack:
        if record is not None:
            said = ", ".join(model.name for model in by_name.values())
            recorder = stack.enter_context(Recorder(record, said))
            by_name = {name: recorder.wrap(model) for name, model in by_name.items()}
        yield Agents(
            settings, sandbox, {role: by_name[name] for role, name in names.items()}, ledger, shipped_prompts()
        )


def shipped_prompts() -> Prompts:
    """The prompts that come with the program."""
    from sumo_adv.agents.prompts import Prompts
    from sumo_adv.simulation.inputs import data_folder

    return Prompts(data_folder("prompts"))
