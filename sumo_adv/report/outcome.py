"""Assemble ``outcome.json`` (the outcome of a run) and ``manifest.json`` (all that it takes to rerun it exactly)."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sumo_adv import __version__
from sumo_adv.agents.agents import AGENT_ROLES, BUILT_IN_AGENTS, Agents
from sumo_adv.asked import Attacker
from sumo_adv.config import Settings
from sumo_adv.datatypes import (
    ENDING_SENTENCES,
    AttackerResult,
    Attempt,
    Duty,
    Intent,
    Level,
    NamedScenario,
    Proposal,
    Verdict,
    plain_acceleration,
)
from sumo_adv.episode.assessment import motions_of
from sumo_adv.episode.run import EncounterRecord, Request, Run, seconds_by_part
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.llm.chat import Ledger
from sumo_adv.outcome_schema import OUTCOME_SCHEMA
from sumo_adv.scenario_names import columns_of
from sumo_adv.simulation.inputs import EgoRoute, RunInput
from sumo_adv.simulation.playback_spec import PlaybackSpec
from sumo_adv.simulation.warnings_log import kinds_of
from sumo_adv.words.fit import Part, compare_attackers, misfits
from sumo_adv.words.motion import DescribedMotion, words_of

MANIFEST_SCHEMA = 1
ATTACKS = "attacks"  # a run's folder has one folder in it for each further kind of attack, by attempt number
MODEL_FILE = "model.jsonl"  # a run's folder has every exchange with a model in it
EXPERT_NOTE = "Built-in expert (kinematic prediction); no language model took part."


def outcome(
    run: Run, record: EncounterRecord | None, raw: Mapping[str, Any] | None, further: Mapping[str, Any],
    realism: Mapping[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Assemble the content of ``outcome.json``. Times are in s, distances in m; an infinite value is null.

    Args:
        run: The run.
        record: The record that counts; None if no encounter does.
        raw: The figures of the unattacked run over the window of the attempt that counts; None if unknown.
        further: Further keys of the verdict on the attempt that counts.
        realism: The content of the key ``realism``.

    Returns:
        The content.
    """
    settings, task = run.settings, run.task
    chosen = task.ego if isinstance(task.ego, str) else None
    encounter = None if record is None else record.found
    best = None if record is None else record.best
    robust = None if record is None else record.robustness
    tried = [each for each in run.records if each.left and each.attacked]
    return {
        "schema": OUTCOME_SCHEMA, "ending": str(run.ending),
        "reason": " ".join(filter(None, (ENDING_SENTENCES[run.ending], run.reason))),
        "network": run.run_input.name, "seed": settings.seed,
        "ego": {"id": encounter.ego if encounter else chosen, "controller": task.ego_driver},
        "adversaries": [] if best is None else _adversaries(best, run, record),
        "attackers": [] if best is None else [_attacker(each) for each in best.verdict.attackers],
        "trigger_time": number(best.trigger_time) if best else None,
        "encounter": None if encounter is None else _encounter(encounter),
        "agents": _agents(run),
        "intent": None if record is None else _intent(record.intent, settings.recall),
        "intents": [_intent(i, settings.recall) for i in (() if record is None else record.intents[:10])],
        "raw": raw, "attempts": [_attempt(a) for a in attempts_of(record)],
        "encounters_tried": [
            {
                "time": number(t.found.time), "ego": t.found.ego, "attempts": len(t.attempts), "level": str(t.level),
                "reason": t.reason, "named_scenarios": _tally(t.attempts),
            }
            for t in tried
        ],
        "seconds_allowed": settings.seconds, "best": None if best is None else best.index,
        "robust": None if robust is None else {**asdict(robust), "robust": robust.enough},
        "successes": [] if record is None else _successes(record),
        "until": str(settings.until), "goal": _goal(settings),
        "attempts_allowed": settings.attempts,
        "outcome": None if best is None else {**verdict(best.verdict), **further},
        "named_scenario": None if best is None else _scenario(best),
        "ego_actions": None if record is None else _ego_actions(record), "realism": dict(realism),
        "driver_time": None if run.driver_time is None else run.driver_time.as_data(),
        "timing": timing(run, record, {}), "llm": _llm(run.agents, attempts_of(record)),
        "sandbox": run.isolation, "forked": run.forked, "learnt": run.learnt,
        "bank_change": run.bank_change or None, "notes": run.notes,
        "warnings": [asdict(kind) for kind in kinds_of(run.warnings)],
        "asked": _asked(run.request if record is None else record.request, record, settings),
    }  # fmt: skip


def _adversaries(best: Attempt, run: Run, record: EncounterRecord | None) -> list[dict[str, Any]]:
    """Return the adversaries of the attempt that counts, the collider first, each with what it does in words."""
    words = {script.label: script.description for script in run.run_input.scripts}
    words |= {intent.label: intent.description for intent in (() if record is None else record.intents)}
    return [{**p.as_adversary(), "does": words.get(p.label)} for p in best.proposal.members]


def _attacker(attacker: AttackerResult) -> dict[str, Any]:
    """Return the result of one attacker in the attempt that counts."""
    return {"id": attacker.id, "role": str(attacker.role), "min_ttc": number(attacker.min_ttc)}


def timing(run: Run, record: EncounterRecord | None, writing: Mapping[str, float]) -> dict[str, float | None]:
    """Return the block ``timing`` of ``outcome.json``: how long each part took, and all of them together [s].

    ``first_success`` is no part: it is the time from the first attempt to the first success.

    Args:
        run: The run.
        record: The record that counts; None if no encounter does.
        writing: How long each part of writing took [s].
    """
    spent = seconds_by_part(run.timing, writing)
    if "total" in spent:
        spent["total"] += sum(writing.values())
    first = None if record is None else record.first_success_seconds
    return {**{part: round(each, 4) for part, each in spent.items()}, "first_success": number(first)}


def _scenario(attempt: Attempt) -> dict[str, Any] | None:
    """Return the names of the scenario that an attempt shows."""
    return None if attempt.scenario is None else columns_of(attempt.scenario)


def _tally(made: Sequence[Attempt]) -> list[dict[str, Any]]:
    """Return each named scenario of an encounter once, with its number of attempts and their highest level."""
    levels: dict[NamedScenario, list[Level]] = {}
    for attempt in made:
        if attempt.scenario is not None:
            levels.setdefault(attempt.scenario, []).append(attempt.verdict.level)
    return [{**columns_of(s), "attempts": len(own), "level": str(max(own))} for s, own in levels.items()]


def attempts_of(record: EncounterRecord | None) -> Sequence[Attempt]:
    """Return the attempts of a record; none if there is no record."""
    return () if record is None else record.attempts


def _asked(request: Request, record: EncounterRecord | None, settings: Settings) -> dict[str, Any] | None:
    """Describe what was asked for, and whether the attempt that counts fits; return None if nothing was asked for."""
    if request.asked is None:
        return None
    best = reading = None
    motions: dict[str, DescribedMotion] = {}
    parts: tuple[Part, ...] = ()
    lacks: tuple[str, ...] = ()
    if record is not None and (best := record.best) is not None:
        of = tuple(request.attackers)
        motions = motions_of(best, record.results[best.index], record.found, settings, of)
        reading = record.readings.get(best.index)
    if best is not None and motions:
        parts = compare_attackers(request.asked, request.attackers, motions, best.proposal.bv)
        lacks = best.verdict.misfits or misfits(parts)
    return {
        "words": request.words or None, **_requested(request),
        "fits": bool(motions) and not lacks, "misfits": list(lacks), "parts": [asdict(part) for part in parts],
        "motion": words_of(list(motions.values())) if motions else None,
        "reading": None if reading is None else reading.model_dump(mode="json"),
    }  # fmt: skip


def _requested(request: Request) -> dict[str, Any]:
    """Return what must be true of the attack and, of several attackers, of each; and the scripts that words led to."""
    assert request.asked is not None
    attack = request.asked.model_dump(mode="json", exclude_defaults=True)
    each = {name: own.model_dump(mode="json", exclude_defaults=True) for name, own in request.attackers.items()}
    scripts = [script.model_dump(mode="json", exclude_defaults=True) for script in request.scripts]
    more = {"attackers": each, "scripts": scripts}
    return {"attack": attack, **{key: value for key, value in more.items() if value}}


def _attackers(run_input: RunInput, request: Request) -> list[dict[str, Any]]:
    """Return the vehicles that attack together with what is requested of each, as in a scenario file."""
    intents = {each.id: each.intents for each in run_input.attackers}
    made = [Attacker(id=name, intents=intents.get(name, ()), asked=own) for name, own in request.attackers.items()]
    return [each.model_dump(mode="json", exclude_defaults=True) for each in made]


def _encounter(encounter: FoundEncounter) -> dict[str, Any]:
    place = encounter.place
    return {
        "time": number(encounter.time), "passed_over": list(encounter.passed_over),
        "beside": list(encounter.beside),
        "ranking": [{"id": i, "relation": r, "risk": k} for i, r, k in encounter.ranking],
        "driven_from": number(encounter.driven_from),
        "driven_before": [[name, number(begin), number(end)] for name, begin, end in encounter.driven_before],
        "road": None if place is None or place.road is None else str(place.road),
        "ego_speed": None if place is None else number(place.speed),
        "limit": None if place is None else number(place.limit),
        "vehicles_near": None if place is None else place.vehicles_near,
        "geometry": None if place is None or place.geometry is None else str(place.geometry),
    }  # fmt: skip


def _goal(settings: Settings) -> str:
    goal = settings.goal
    plain = goal.ttc is None and not goal.min_delta_v and goal.level is Level.CRITICAL
    return f"min TTC of {settings.critical_ttc:g} s or less" if plain else str(goal)


def _ego_actions(record: EncounterRecord) -> dict[str, int] | None:
    """Count the driver's answers by kind in the attempt that counts, from its takeover on; None without answers.

    ``limited`` counts the answers after which SUMO's safe speed was lower than the speed that the driver asked for.
    """
    result = record.best_result
    actions = None if result is None else result.actions
    return {**actions.counts, "limited": actions.limited} if actions is not None and actions.counts else None


def _agents(run: Run) -> dict[str, Any]:
    """Describe who played each agent's part; the built-in expert is never presented as a language model."""
    agents = run.agents
    players = dict(BUILT_IN_AGENTS) if agents is None else {role: agents.player(role) for role in AGENT_ROLES}
    models = sorted({m.name for m in agents.models.values()}) if agents is not None else []
    note = EXPERT_NOTE
    if models:
        parts = ", ".join(f"{role} {player}" for role, player in players.items())
        note = f"Agents at the end: {parts}; predictions and tuner are built in."
    return {
        **players, "tuner": run.settings.tuner, "note": note,
        "calls": dict.fromkeys(AGENT_ROLES, 0) if agents is None else agents.calls,
        "failed": {} if agents is None else agents.failed, "analysis": {} if agents is None else agents.analysis,
    }  # fmt: skip


def _llm(agents: Agents | None, attempts: Sequence[Attempt]) -> dict[str, Any]:
    """Return the ledger with the result of each question; ``model`` names the models that took part, or is null."""
    names = sorted({m.name for m in agents.models.values()}) if agents is not None else []
    ledger = (Ledger() if agents is None else agents.ledger).as_dict()
    return {"model": ", ".join(names) or None, **ledger, "bought": _bought(agents, attempts)}


def _bought(agents: Agents | None, attempts: Sequence[Attempt]) -> list[dict[str, Any]]:
    """Return the result of each question to a model; for a planner's text, add its attempts and their best level."""
    rows = []
    for each in [] if agents is None else agents.bought:
        own = [a.verdict.level for a in attempts if a.proposal.planner.hash == each.planner]
        row = {"agent": each.agent, "what": each.what, "planner": each.planner, "attempts": len(own)}
        rows.append({**row, "level": str(max(own)) if own else None})
    return rows


def number(value: float | None) -> float | None:
    """Round a number to 4 decimals; None, infinite and undefined values become None."""
    return None if value is None or not math.isfinite(value) else round(float(value), 4)


def verdict(v: Verdict) -> dict[str, Any]:
    """Return the content of the key ``outcome`` that a verdict gives."""
    return {
        "min_ttc": number(v.min_ttc), "min_ttc_any": number(v.min_ttc_any), "min_pet": number(v.min_pet),
        "max_drac": number(v.max_drac), "min_distance": number(v.min_distance), "collided": v.collided,
        "critical": v.critical, "feasible": v.feasible, "rear_end": v.rear_end, "valid": v.valid, "strict": v.strict,
        "fault": v.fault, "failed_gates": list(v.failed_gates), "log_gates": list(v.log_gates),
        "contact_time": number(v.contact_time), "min_ttc_time": number(v.min_ttc_time),
        **level_figures(v),
    }  # fmt: skip


def level_figures(v: Verdict) -> dict[str, Any]:
    """Return the level of a verdict, and the figures that the level follows from."""
    p = v.preventability
    return {
        "level": str(v.level), "preventable_by": None if p is None else list(p.by),
        "references": None if p is None else dict(p.answers), "alarms": None if p is None else dict(p.alarms),
        "inconclusive": None if p is None else p.inconclusive, "simulated": None if p is None else p.simulated,
        "in_loop": None if p is None else dict(p.in_loop),
        "ego_stationary": v.ego_stationary, "ego_blocking": v.ego_blocking, "humanlike": v.humanlike,
        "beyond_human": list(v.beyond_human), "contact_side": v.contact_side, "delta_v": number(v.delta_v),
        "adversary_delta_v": number(v.adversary_delta_v), "severity": v.severity, "injury_risk": number(v.injury_risk),
        "impact_speed": number(v.impact_speed), "overlap": number(v.overlap),
    }  # fmt: skip


def _intent(intent: Intent | None, recall: str) -> dict[str, Any] | None:
    if intent is None:
        return None
    return {
        "bv": intent.bv, "label": intent.label, "description": intent.description, "risk": intent.risk,
        "acceleration": plain_acceleration(intent.acceleration), "reason": intent.reason, "source": intent.source,
        "recall": recall,
    }  # fmt: skip


def _attempt(a: Attempt) -> dict[str, Any]:
    v, p = a.verdict, a.proposal
    return {
        "index": a.index, "by": p.by, "phase": a.phase, "adversaries": list(p.bvs), "intent": p.label,
        "planner": {"mode": p.planner.mode, "hash": p.planner.hash, "origin": p.planner.origin},
        "parameters": {k: number(q) for k, q in p.parameters.items()},
        "acceleration": plain_acceleration(p.acceleration),
        "trigger_time": number(a.trigger_time), "predicted_score": number(p.score),
        "predicted_level": None if p.prediction is None else str(p.prediction.level),
        "min_ttc": number(v.min_ttc),
        "min_distance": number(v.min_distance), "collided": v.collided, "critical": v.critical, "feasible": v.feasible,
        "rear_end": v.rear_end, "valid": v.valid, "strict": v.strict,
        "failed_gates": list(v.failed_gates), "log_gates": list(v.log_gates), "ending": a.ending, "message": a.message,
        "level": str(v.level), "preventable_by": None if v.preventability is None else list(v.preventability.by),
        "inconclusive": None if v.preventability is None else v.preventability.inconclusive,
        "ego_stationary": v.ego_stationary, "delta_v": number(v.delta_v), "humanlike": v.humanlike,
        "impact_speed": number(v.impact_speed), "contact_side": v.contact_side, "kind": a.kind,
        "diagnosis": None if a.diagnosis is None else asdict(a.diagnosis), **_composed(p),
        **({"misfits": list(v.misfits)} if v.misfits else {}), "named_scenario": _scenario(a),
    }  # fmt: skip


def _composed(p: Proposal) -> dict[str, Any]:
    """Return the additional keys of an attempt with supports: the composition's label, each support, and the waits."""
    if not p.supports:
        return {}
    supports: list[dict[str, Any]] = [
        {**q.as_adversary(), "parameters": {k: number(v) for k, v in q.parameters.items()}, "wait": q.wait}
        for q in p.supports
    ]
    return {"composition": p.composition, "supports": supports, "wait": p.wait}


def _successes(record: EncounterRecord) -> list[dict[str, Any]]:
    """List the attempts of different kinds that reached the level; ``folder`` is null for the one that counts."""
    best, rows = record.best, []
    for k in record.successes:
        counts = record.chosen is not None or (best is not None and k == best.index)
        rows.append({"attempt": k, "kind": record.attempts[k].kind, "folder": None if counts else f"{ATTACKS}/{k + 1}"})
    return rows


def versions() -> dict[str, str]:
    """Return the versions of this program, of Python and of the libraries that affect the numbers."""
    names = ("libsumo", "numpy", "scipy", "shapely", "pydantic-monty")
    return {"sumo_adv": __version__, "python": platform.python_version(), **{n: version(n) for n in names}}


def manifest(run: Run, record: EncounterRecord | None, inputs: Mapping[Path, str]) -> dict[str, Any]:
    """Assemble the content of ``manifest.json``.

    Args:
        run: The run.
        record: The record that counts; None if no encounter does.
        inputs: The name of each input's copy under ``inputs/``, by original file.

    Returns:
        The content.
    """
    task, run_input, best = run.task, run.run_input, None if record is None else record.best
    model_agents = run.agents if run.agents is not None and run.agents.models else None
    used = {p.planner.hash: p.planner for a in attempts_of(record) for p in a.proposal.members}
    spec, made, waymo = task.spec, run_input.conversion, run_input.waymo
    request = run.request if record is None else record.request
    return {
        "schema": MANIFEST_SCHEMA, "versions": versions(), "name": run_input.name,
        "settings": run.settings.model_dump(mode="json", exclude={"memory"}),
        "network": inputs[spec.network], "routes": [inputs[p] for p in spec.routes],
        "additional": [inputs[p] for p in spec.additional], "begin": spec.begin, "end": task.end,
        "seed": spec.seed, "step_length": spec.step_length, "sumo_options": spec.all_options,
        "empty_steps": spec.empty_steps,
        "trigger": task.trigger, "warm_up": task.warm_up, "only": list(task.only),
        "moves": [move.model_dump(exclude_defaults=True) for move in task.moves],
        "sight": [stretch.model_dump(by_alias=True) for stretch in task.sight],
        "playback": _playback(task.playback, inputs), "conversion": None if made is None else {
            "map": made.path.name, "options": list(made.options), "lost": dict(made.lost), "said": list(made.said),
            "warnings": [asdict(kind) for kind in made.warnings],
        },
        "waymo": None if waymo is None else {**asdict(waymo), "file": str(waymo.file)},
        "notes": list(run_input.notes),
        "ego": asdict(task.ego) if isinstance(task.ego, EgoRoute) else task.ego,
        "ego_base_type": task.ego_base_type, "ego_driver": task.ego_driver,
        "ego_parameters": dict(task.ego_parameters), "driven_from": task.driven_from,
        "driven_before": [list(each) for each in task.driven_before], "delay": task.delay,
        "skips": run.encounters_before(record),
        "intents_allowed": list(run_input.intents), "words": request.words or None,
        "asked": None if request.asked is None else request.asked.model_dump(mode="json", exclude_defaults=True),
        "attackers": _attackers(run_input, request),
        "bank_hash": run.bank_hash, "bandit": [] if record is None else list(record.bandit),
        "model_answers": None if model_agents is None else MODEL_FILE,
        "prompts": None if model_agents is None else model_agents.prompts.versions,
        "planners": {
            name: {"label": p.label, "mode": p.mode, "origin": p.origin, "parent": p.parent, "source": p.text}
            for name, p in used.items()
        },
        "attempt": None if best is None else _proposal(best.proposal),
    }  # fmt: skip


def _playback(p: PlaybackSpec | None, inputs: Mapping[Path, str]) -> dict[str, Any] | None:
    if p is None:
        return None
    return {
        "tracks": inputs[p.tracks] if p.tracks else None, "background": p.background,
        "signals": inputs[p.signals] if p.signals else None,
        "props": [{**asdict(q), "end": None if math.isinf(q.end) else q.end} for q in p.props],
    }  # fmt: skip


def _proposal(p: Proposal) -> dict[str, Any]:
    written: dict[str, Any] = {
        "bv": p.bv, "label": p.label, "planner": p.planner.hash, "parameters": dict(p.parameters),
        "acceleration": plain_acceleration(p.acceleration), "delay": p.delay, "by": p.by,
    }  # fmt: skip
    if p.supports:
        written |= {"composition": p.composition, "supports": [_proposal(q) for q in p.supports]}
    if p.wait > 0.0:
        written["wait"] = p.wait
    return written if p.duty is Duty.COLLIDER else {**written, "role": str(p.duty)}
