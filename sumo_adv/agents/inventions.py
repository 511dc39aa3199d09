"""Planners for behaviours that no known intent has: written by a language model, tried in the sandbox, and kept."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from sumo_adv.agents.generator import ModelGenerator
from sumo_adv.config import Settings
from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.prompts import Prompts
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import IntentRecord
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.scripts import script_entry
from sumo_adv.planners.trial import trial
from sumo_adv.script import Script


@dataclass
class Inventions:
    """The novel intents of one request.

    They are tried with a copy of the bank, and enter the bank only if they are kept.

    Attributes:
        metered: The model that writes planners.
        prompts: The prompts.
        settings: The settings of the run, such as the limits of vehicles and how often a planner is repaired.
        sandbox: Where planners are tried.
        bank: The bank, which has the examples for the model.
        copy: The file of the bank's copy. It is made with the first invention.
        written: The intents so far, with their planners, by label.
    """

    metered: MeteredModel
    prompts: Prompts
    settings: Settings
    sandbox: Sandbox
    bank: MemoryBank
    copy: Path
    written: dict[str, tuple[IntentRecord, Planner]] = field(default_factory=dict, init=False)

    def add(self, record: IntentRecord) -> None:
        """Have a planner written for a behaviour, and add both to the bank's copy.

        A fault of the planner goes back to the model, at most ``generations`` times.

        Args:
            record: The behaviour.

        Raises:
            ModelError: No planner passed the sandbox.
            BudgetError: The run may ask no more.
        """
        nearest = (self.bank.intent(label) for label, _ in self.bank.retrieve(record.label, record.description).nearest)
        examples = [
            LibraryEntry(r.label, r.description, r.applies, tuple(self.bank.planners(r.label))) for r in nearest if r
        ]
        generator = ModelGenerator(
            self.metered, self.prompts, self.settings.limits.limits(),
            lambda planner: trial(self.sandbox, planner, record.applies, type_check=True),
            tries=self.settings.generations, applies=record.applies,
        )  # fmt: skip
        (planner,) = generator.generate(Intent("", record.label, record.description, "high", 0.0), None, examples)
        with MemoryBank.open(self.copy, seed_from=self.bank.path) as copy:
            copy.add(record, [planner])
        self.written[record.label] = record, planner

    def used_by(self, settings: Settings) -> Settings:
        """Return the settings of a run that knows the inventions.

        Args:
            settings: The settings of the run.
        """
        return settings.model_copy(update={"memory": self.copy}) if self.written else settings

    def keep(self, label: str) -> None:
        """Add an invention to the bank.

        Args:
            label: The label of the intent.

        Raises:
            BankError: The bank cannot be written.
        """
        record, planner = self.written[label]
        self.bank.add(record, [planner])

    def keep_script(self, script: Script) -> None:
        """Add a script to the bank.

        Args:
            script: The script.

        Raises:
            BankError: The bank cannot be written.
        """
        entry = script_entry(script)
        self.bank.add(IntentRecord(entry.label, entry.description, entry.applies), entry.planners)
