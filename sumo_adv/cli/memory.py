"""Define ``memory``: look into a memory bank, change it, share it, check it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from sumo_adv.app import open_bank
from sumo_adv.cli import memory_check, memory_edit
from sumo_adv.cli.memory_edit import Bank, Json, answer, known_intent

if TYPE_CHECKING:
    from sumo_adv.memory.records import Composition

app = typer.Typer(
    no_args_is_help=True, help="Look into a memory bank of intents and planners, change it, share it, check it.",
    epilog="Example: sumo-adv memory find 'squeezes in just ahead of us'",
)  # fmt: skip


@app.command("list", epilog="Example: sumo-adv memory list --json")
def list_(memory: Bank = None, as_json: Json = False) -> None:
    """List the intents of the bank, with their planners' modes and their evidence, and the compositions."""
    from sumo_adv.memory.bank import all_compositions
    from sumo_adv.memory.records import plain_composition

    with open_bank(memory) as bank:
        composed = all_compositions(bank)
        rows: list[dict[str, Any]] = [
            {
                "label": r.label, "applies": list(r.applies), "status": r.status,
                "modes": [p.mode for p in bank.planners(r.label)], "evidence": len(bank.evidence(r.label)),
            }
            for r in bank.intents()
        ]  # fmt: skip
    value = {"intents": rows, "compositions": [plain_composition(c) for c in composed]}
    answer(value, as_json, lambda: [
        *(f"{r['label']}: modes {', '.join(r['modes']) or 'none'}; evidence {r['evidence']}; {r['status']}"
          for r in rows),
        *(f"{c.label}: composed of {' + '.join(p.intent for p in c.parts)}; {counts(c)}" for c in composed),
    ])  # fmt: skip


def counts(c: Composition) -> str:
    """Describe how often a composition succeeded and failed."""
    attempts, forgotten = "attempt" if c.succeeded == 1 else "attempts", "; forgotten" if c.hopeless else ""
    return f"{c.succeeded} {attempts} succeeded, {c.failed} failed since the last success{forgotten}"


@app.command("show", epilog="Example: sumo-adv memory show 'Straight Lane Shift'")
def show(label: str, memory: Bank = None, as_json: Json = False) -> None:
    """Show an intent with the source of its planners, retired ones too, or a composition with its parts."""
    from sumo_adv.memory.bank import all_compositions
    from sumo_adv.memory.records import canonical

    with open_bank(memory) as bank:
        composition = next((c for c in all_compositions(bank) if canonical(c.label) == canonical(label)), None)
        if composition is not None and bank.intent(label) is None:
            show_composition(composition, as_json)
            return
        record = known_intent(bank, label)
        stored = next(s for s in bank.stored_intents() if s.intent == record)
    planners: list[dict[str, Any]] = [
        {
            "mode": p.mode, "origin": p.origin, "hash": p.hash, "parent": p.parent,
            "status": "retired" if p.hash in stored.retired else "active",
            "parameters": {x.name: [x.default, x.low, x.high, x.unit, x.meaning] for x in p.parameters},
            "source": p.text,
            "evidence": sum(e.planner_hash == p.hash for e in stored.evidence),
            "successes": sum(e.planner_hash == p.hash and e.success for e in stored.evidence),
        }
        for p in stored.planners
    ]  # fmt: skip
    value = {
        "label": record.label, "description": record.description, "applies": list(record.applies),
        "status": record.status, "merged_into": stored.merged_into, "planners": planners,
    }  # fmt: skip
    gone = f" (merged into {stored.merged_into})" if stored.merged_into else ""
    answer(value, as_json, lambda: [
        f"{record.label}{'' if record.status == 'active' else ', retired'}{gone}", record.description,
        f"applies to: {', '.join(record.applies)}",
        *(f"\n--- {p['mode']} ({p['origin']}, {p['hash'][:12]}, {p['status']}; {p['successes']} of {p['evidence']} "
          f"succeeded)\n{p['source']}" for p in planners),
    ])  # fmt: skip


def show_composition(c: Composition, as_json: bool) -> None:
    """Print a composition with its parts."""
    from sumo_adv.memory.records import plain_composition

    answer(plain_composition(c), as_json, lambda: [
        f"{c.label}, a composition", c.description, counts(c),
        *(f"{p.duty}: {p.intent}{' / ' if p.mode else ''}{p.mode}" for p in c.parts),
    ])  # fmt: skip


@app.command("find", epilog="Example: sumo-adv memory find 'cuts in and brakes' --json")
def find(text: str, memory: Bank = None, as_json: Json = False) -> None:
    """Find the intents nearest to a description: their distance, the epsilon, and whether the nearest is a hit."""
    with open_bank(memory) as bank:
        retrieval = bank.retrieve(text, text)
    nearest = [{"label": label, "distance": round(d, 4)} for label, d in retrieval.nearest]
    value = {"hit": retrieval.hit, "epsilon": retrieval.epsilon, "band": retrieval.band, "nearest": nearest}
    headline = f"{'Hit: ' + retrieval.hit if retrieval.hit else 'No hit'} (epsilon {retrieval.epsilon:.2f})"
    answer(value, as_json, lambda: [
        headline + (", and near epsilon: look at the first three" if retrieval.band else ""),
        *(f"  {n['distance']:.3f}  {n['label']}" for n in nearest),
    ])  # fmt: skip


@app.command("stats", epilog="Example: sumo-adv memory stats --json")
def stats(memory: Bank = None, as_json: Json = False) -> None:
    """Count successes and failures by intent and planner, and list what to merge or retire (changes nothing)."""
    from sumo_adv.memory.curate import hopeless, near_duplicates, planner_counts, statistics

    with open_bank(memory) as bank:
        counts, planners = statistics(bank), planner_counts(bank)
        epsilon, calibrated_on = bank.epsilon()
        merging, retiring = near_duplicates(bank), hopeless(bank)
        value = {
            **counts, "hash": bank.content_hash(), "epsilon": epsilon, "calibrated_on": calibrated_on,
            "by_planner": [asdict(p) for p in planners],
            "merge": [asdict(p) for p in merging], "retire": [asdict(p) for p in retiring],
        }  # fmt: skip
    answer(value, as_json, lambda: [
        f"{value['active']} active of {value['intents']} intents, {value['planners']} planners, {value['evidence']} "
        f"pieces of evidence; epsilon {epsilon:.2f} ({calibrated_on})",
        *(f"  {p.label} / {p.mode}: {p.successes} successes, {p.failures} failures{', retired' if p.retired else ''}"
          for p in planners),
        *(f"To merge? {m.label} into {m.into} (distance {m.distance:.2f}: {m.reason})" for m in merging),
        *(f"To retire? {p.label} / {p.mode}: {p.failures} failures and no success" for p in retiring),
    ])  # fmt: skip


for _name, _command, _example in (*memory_edit.EDIT_COMMANDS, *memory_check.CHECK_COMMANDS):
    app.command(_name, epilog=f"Example: sumo-adv memory {_example}")(_command)
