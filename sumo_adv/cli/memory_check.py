"""Define ``memory verify`` and ``memory calibrate``: check planners, and find where "known" ends."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import open_bank
from sumo_adv.cli.memory_edit import Bank, Json, answer, known_intent
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Planner
from sumo_adv.files import scratch_prefix

if TYPE_CHECKING:
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import Composition, Evidence, StoredIntent
    from sumo_adv.memory.similarity import Paraphrase, SetFigures
    from sumo_adv.planners.sandbox import Sandbox


@dataclass(frozen=True, slots=True)
class Rerun:
    """A new run of a planner.

    Attributes:
        ok: Whether an attempt was critical, feasible and not a rear-end.
        attempts: The number of attempts.
        min_ttc: The smallest minimum TTC of the attempts [s]; None if there was no conflict.
    """

    ok: bool
    attempts: int
    min_ttc: float | None


def successes_on(stored: StoredIntent, planner: Planner, network: str) -> list[Evidence]:
    """List a planner's successes that a new run can be compared with.

    Successes against an ego that is a Python class are left out: evidence may have been imported, and must not name
    code to be run.

    Args:
        stored: The intent in the bank.
        planner: The planner.
        network: The name of the network.

    Returns:
        The evidence, in the order of the bank.
    """
    from sumo_adv.drivers.registry import is_foreign

    own = [e for e in stored.evidence if e.success and e.planner_hash == planner.hash]
    return [e for e in own if e.network == network and not is_foreign(e.scene.controller)]


def rerun(
    sandbox: Sandbox, stored: StoredIntent, planner: Planner, evidence: Evidence, scenario: Path, attempts: int
) -> Rerun:
    """Run a scenario with one planner until it succeeds, with the seed and the ego's driver of the evidence.

    Args:
        sandbox: Where the planner runs.
        stored: The intent of the planner.
        planner: The planner.
        evidence: The success that is repeated.
        scenario: The scenario.
        attempts: The largest number of attempts.

    Returns:
        The result of the run.

    Raises:
        UsageError: The scenario cannot be read.
    """
    from sumo_adv.agents.agents import Agents
    from sumo_adv.episode.engine import episode_worker
    from sumo_adv.episode.loop import run_episode
    from sumo_adv.episode.task import make_task
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.inputs import load_input

    run_input = load_input(scenario)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder:
        settings = load_settings(
            None, ego=evidence.scene.controller, seed=evidence.seed, learn="off", horizon=run_input.horizon,
            attempts=attempts,
        )  # fmt: skip
        task = make_task(run_input, settings, Path(folder))
        with MemoryBank.open(Path(folder) / "one.sqlite") as bank, Engine(episode_worker) as engine:
            bank.add(stored.intent, [planner])
            run = run_episode(run_input, settings, task, engine, Agents(settings, sandbox), bank, lambda *_: None)
    made = () if run.best is None else run.best.attempts
    own = [a.verdict for a in made if a.proposal.planner.hash == planner.hash]
    good = any(v.critical and v.counts for v in own)
    nearest = min((v.min_ttc for v in own), default=math.inf)
    return Rerun(good, len(own), nearest if math.isfinite(nearest) else None)


def verify(
    label: Annotated[str | None, typer.Option(help="Only the planners of this intent.")] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Also run this scenario with each planner that has a success in it (slow).")
    ] = None,
    attempts: Annotated[
        int, typer.Option(min=1, help="With --scenario: maximum number of attempts for each planner.")
    ] = 25,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Run each active planner in the sandbox on made-up situations; exit status 1 if one fails.

    A composition fails if the bank lacks one of its parts. Whether a planner still succeeds as its evidence says is
    tried only with --scenario.
    """
    from sumo_adv.memory.bank import compositions
    from sumo_adv.planners.sandbox import Sandbox

    with open_bank(memory) as bank:
        chosen_label = known_intent(bank, label).label if label is not None else None
        active = [s for s in bank.stored_intents() if s.intent.status == "active"]
        stored_intents = [s for s in active if chosen_label in (None, s.intent.label)]
        composed = [] if chosen_label is not None else [lacking_row(c, active) for c in compositions(bank)]
    with Sandbox() as sandbox:
        results = [row for stored in stored_intents for row in _verify(sandbox, stored, scenario, attempts)]
        isolation = sandbox.isolation if results else None
    failed = sum(not row["ok"] for row in results)
    bad = [row for row in composed if not row["ok"]]
    value = {"planners": results, "compositions": composed, "failed": failed + len(bad), "isolation": isolation}
    answer(value, as_json, lambda: [
        *(f"{'ok    ' if r['ok'] else 'FAILED'}  {r['label']} / {r['mode']}{_remark(r)}" for r in results),
        *(f"FAILED  {r['label']}: {r['failure']}" for r in bad),
        f"{len(results) - failed} of {len(results)} planners passed.",
    ])  # fmt: skip
    if failed or bad:
        raise typer.Exit(1)


def lacking_row(composition: Composition, active: Sequence[StoredIntent]) -> dict[str, Any]:
    """Check that the bank or the program has each part of a composition.

    Args:
        composition: The composition.
        active: The active intents of the bank.

    Returns:
        The label, whether all parts are available, and the first missing one in a sentence.
    """
    from sumo_adv.search.intents import COMPOSED
    from sumo_adv.search.support_intents import SUPPORT_INTENTS

    available = {(p.label, p.mode) for entries in SUPPORT_INTENTS.values() for e in entries for p in e.planners}
    available |= {(s.intent.label, p.mode) for s in active for p in s.planners if p.hash not in s.retired}
    available |= {(label, "") for label, _ in available}  # a part without a mode takes any
    parts = [p for p in composition.parts if p.intent not in COMPOSED]
    lacking = [f"{p.intent} / {p.mode}" for p in parts if (p.intent, p.mode) not in available]
    failure = f"there is no active {lacking[0]}." if lacking else None
    return {"label": composition.label, "ok": not lacking, "failure": failure}


def _remark(row: dict[str, Any]) -> str:
    if row["failure"] is not None:
        return f": {row['failure']}"
    return f": succeeded again, {row['rerun']['attempts']} attempts" if row["rerun"] is not None else ""


def _verify(sandbox: Sandbox, stored: StoredIntent, scenario: Path | None, attempts: int) -> list[dict[str, Any]]:
    from sumo_adv.planners.trial import trial

    rows = []
    for planner in stored.planners:
        if planner.hash not in stored.retired:
            failure, again = trial(sandbox, planner, stored.intent.applies), None
            if failure is None and scenario is not None:
                again, failure = _again(sandbox, stored, planner, scenario, attempts)
            successes = sum(e.success for e in stored.evidence if e.planner_hash == planner.hash)
            rows.append({
                "label": stored.intent.label, "mode": planner.mode, "hash": planner.hash, "ok": failure is None,
                "failure": failure, "successes": successes, "rerun": again,
            })  # fmt: skip
    return rows


def _again(
    sandbox: Sandbox, stored: StoredIntent, planner: Planner, scenario: Path, attempts: int
) -> tuple[dict[str, Any] | None, str | None]:
    """Run a planner again on a scenario that it has evidence on; return the result and what is wrong with it."""
    from sumo_adv.simulation.inputs import load_input

    held = successes_on(stored, planner, load_input(scenario).name)
    if not held:
        return None, None
    result = rerun(sandbox, stored, planner, held[0], scenario, attempts)
    failure = None if result.ok else f"It succeeded in {scenario} before, but not in {result.attempts} attempts now."
    return asdict(result), failure


def calibrate(
    files: Annotated[list[Path], typer.Argument(help="Paraphrases of known intents, and novel behaviours, in TOML.")],
    store: Annotated[bool, typer.Option("--store", help="Keep the epsilon in the bank.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Measure how well the bank tells known from novel intents: epsilon from half of the files, figures from the rest.

    Behaviours with an intent that the bank lacks count as novel. The intervals are 95 % bootstrap.
    """
    from sumo_adv.memory.similarity import calibrate as measure
    from sumo_adv.memory.similarity import read_paraphrases

    with open_bank(memory, make=store) as bank:
        halves = [read_paraphrases(file) for file in files]
        sets = [(_as_known(bank, tuning), _as_known(bank, reporting)) for tuning, reporting in halves]
        active = [record for record in bank.intents() if record.status == "active"]
        calibration = measure(active, sets)
        has_intent = [p.intent is not None for tuning, _ in sets for p in tuning]
        on = (
            f"{' and '.join(file.name for file in files)}, tuning halves: {sum(has_intent)} paraphrases and "
            f"{len(has_intent) - sum(has_intent)} novel behaviours, a bank of {len(active)} intents"
        )
        before = bank.epsilon()[0]
        if store:
            bank.set_epsilon(calibration.epsilon, on)
    names = [file.name for file in files]
    value = asdict(calibration) | {"calibrated_on": on, "before": before, "stored": store}
    value["sets"] = [{"file": name} | figures for name, figures in zip(names, value["sets"], strict=True)]
    answer(value, as_json, lambda: [
        f"Metric {calibration.metric}: epsilon {calibration.epsilon:.3f}, "
        f"{'stored' if store else 'not stored'} (was {before:.3f})",
        f"Calibrated on {on}.",
        *(line for name, figures in zip(names, calibration.sets, strict=True) for line in _lines(name, figures)),
    ])  # fmt: skip


def _lines(name: str, figures: SetFigures) -> list[str]:
    named = {
        "top-1": figures.top1, "AUC": figures.auc, "known recognised": figures.recognised,
        "novel refused": figures.refused, "balanced accuracy": figures.balanced_accuracy,
    }  # fmt: skip
    return [
        f"On the other half of {name} ({figures.known} known, {figures.novel} novel):",
        *(f"  {title:<18} {f.value:.3f} [{f.low:.3f}, {f.high:.3f}]" for title, f in named.items()),
    ]


def _as_known(bank: MemoryBank, half: list[Paraphrase]) -> list[Paraphrase]:
    """Mark paraphrases of intents that are not active in the bank as novel."""

    def there(label: str) -> bool:
        record = bank.intent(label)
        return record is not None and record.status == "active"

    return [p if p.intent is None or there(p.intent) else replace(p, intent=None) for p in half]


CHECK_COMMANDS = (
    ("verify", verify, "verify --label 'Aggressive Cut-in'"),
    ("calibrate", calibrate, "calibrate tests/data/intents_independent.toml --store"),
)
