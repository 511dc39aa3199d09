"""Does a planner still do in a scenario what its evidence says? A real run with a bank that holds nothing else."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sumo_adv.datatypes import Planner
    from sumo_adv.memory.records import Evidence, Source
    from sumo_adv.planners.sandbox import Sandbox


@dataclass(frozen=True, slots=True)
class Rerun:
    """A planner's new run: whether it was critical, feasible and not rear-end within ``attempts`` attempts."""

    ok: bool
    attempts: int
    min_ttc: float | None


def successes_on(source: Source, planner: Planner, network: str) -> list[Evidence]:
    """The evidence that a run on ``network`` can be held against, in the order of the bank.

    Not that of an ego which is a Python class: evidence may have been imported, and must not name code to be run.
    """
    from sumo_adv.drivers.registry import is_foreign

    own = [e for e in source.evidence if e.success and e.planner_hash == planner.hash]
    return [e for e in own if e.network == network and not is_foreign(e.scene.controller)]


def rerun(
    sandbox: Sandbox, source: Source, planner: Planner, evidence: Evidence, scenario: Path, attempts: int
) -> Rerun:
    """Run ``scenario`` with this planner alone, with the evidence's seed and ego driver, until it succeeds.

    Raises UsageError for a scenario that cannot be read.
    """
    from sumo_adv.agents.agents import Agents
    from sumo_adv.config import load_settings
    from sumo_adv.episode.loop import run_episode
    from sumo_adv.episode.task import make_task
    from sumo_adv.episode.worker import body
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.inputs import load_input

    given = load_input(scenario)
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder:
        settings = load_settings(
            None,
            ego=evidence.scene.controller,
            seed=evidence.seed,
            learn="off",
            horizon=given.horizon,
            attempts=attempts,
        )
        task = make_task(given, settings, Path(folder))
        with MemoryBank.open(Path(folder) / "one.sqlite") as bank, Engine(body) as engine:
            bank.add(source.intent, [planner])
            episode = run_episode(given, settings, task, engine, Agents(settings, sandbox), bank, lambda *_: None)
    own = [a.verdict for a in episode.refinement.attempts if a.proposal.planner.hash == planner.hash]
    good = any(v.critical and v.counts for v in own)
    nearest = min((v.min_ttc for v in own), default=math.inf)
    return Rerun(good, len(own), nearest if math.isfinite(nearest) else None)
