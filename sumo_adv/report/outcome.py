"""``outcome.json`` and ``manifest.json``: the outcome of a run, and all it takes to run it again bit for bit."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sumo_adv import __version__
from sumo_adv.agents.agents import AGENT_ROLES, BUILT_IN_AGENTS
from sumo_adv.config import Settings
from sumo_adv.datatypes import ENDING_SENTENCES, Attempt, Duty, Intent, Level, Proposal, Verdict, plain_acceleration
from sumo_adv.episode.assessment import motion_of
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.llm.chat import Ledger
from sumo_adv.outcome_schema import OUTCOME_SCHEMA
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.playback_spec import PlaybackSpec
from sumo_adv.simulation.warnings_log import kinds_of
from sumo_adv.words.motion import misfits

MANIFEST_SCHEMA = 1
ATTACKS = "attacks"  # in a run's folder: one folder for each further kind of attack, by the number of its attempt
MODEL_FILE = "model.jsonl"  # in a run's folder: every exchange with a model
EXPERT_NOTE = "Built-in expert (kinematic prediction); no language model took part."


def outcome(
    episode: Episode, raw: Mapping[str, Any] | None, further: Mapping[str, Any], realism: Mapping[str, Any]
) -> dict[str, Any]:
    """The contract's ``outcome.json``. Times s, distances m, never = null.

    ``further``: what the full verdict adds to the attempt that counts; ``realism``: the block of that name.
    """
    chosen = episode.task.ego if isinstance(episode.task.ego, str) else None
    best, settings, encounter, robust = episode.best, episode.settings, episode.found, episode.refinement.robustness
    times = {name: round(seconds, 4) for name, seconds in episode.timing.items()}
    return {
        "schema": OUTCOME_SCHEMA, "ending": str(episode.ending),
        "reason": " ".join(filter(None, (ENDING_SENTENCES[episode.ending], episode.reason))),
        "network": episode.source.name, "seed": settings.seed,
        "ego": {"id": encounter.ego if encounter else chosen, "controller": episode.task.ego_driver},
        "adversaries": [p.as_adversary() for p in best.proposal.members] if best else [],
        "trigger_time": number(best.trigger_time) if best else None,
        "encounter": None if encounter is None else _encounter(encounter),
        "agents": _agents(episode),
        "intent": _intent(episode.intent, settings.recall),
        "intents": [_intent(i, settings.recall) for i in episode.intents[:10]],
        "raw": raw, "attempts": [_attempt(a) for a in episode.refinement.attempts],
        "encounters_tried": [
            {"time": number(t.time), "ego": t.ego, "attempts": t.attempts, "level": str(t.level), "reason": t.reason}
            for t in episode.tried
        ],
        "seconds_allowed": settings.seconds, "best": episode.refinement.best,
        "robust": None if robust is None else {**asdict(robust), "robust": robust.enough},
        "successes": _successes(episode), "until": str(settings.until), "goal": _goal(settings),
        "attempts_allowed": settings.attempts,
        "outcome": None if best is None else {**verdict(best.verdict), **further},
        "ego_actions": _ego_actions(episode), "realism": dict(realism),
        "timing": {**times, "first_success": number(episode.refinement.first_success_seconds)}, "llm": _llm(episode),
        "sandbox": episode.isolation, "forked": episode.forked, "learnt": episode.learnt,
        "bank_change": episode.bank_change or None, "notes": [*episode.source.notes, *episode.notes],
        "warnings": [asdict(kind) for kind in kinds_of(episode.warnings)],
        "asked": _asked(episode),
    }  # fmt: skip


def _asked(episode: Episode) -> dict[str, Any] | None:
    """What was asked for, whether the attempt that counts fits, and its motion in words; None where nothing was."""
    if episode.asked is None:
        return None
    best, motion = episode.best, None
    if best is not None and episode.found is not None:
        motion = motion_of(best, episode.refinement.results[best.index], episode.found, episode.settings)
    lacks = () if best is None or motion is None else best.verdict.misfits or misfits(episode.asked, motion)
    fitting = episode.refinement.fitting
    reading = None if fitting is None or best is None else fitting.readings.get(best.index)
    return {
        "words": episode.words or None, "attack": episode.asked.model_dump(mode="json", exclude_defaults=True),
        "fits": motion is not None and not lacks, "misfits": list(lacks),
        "motion": None if motion is None else motion.words,
        "reading": None if reading is None else reading.model_dump(mode="json"),
    }  # fmt: skip


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
    }  # fmt: skip


def _goal(settings: Settings) -> str:
    goal = settings.goal
    plain = goal.ttc is None and not goal.min_delta_v and goal.level is Level.CRITICAL
    return f"min TTC of {settings.critical_ttc:g} s or less" if plain else str(goal)


def _ego_actions(episode: Episode) -> dict[str, int] | None:
    """How often the ego's driver gave each kind of answer in the attempt that counts, from its takeover on, and after
    how many of them SUMO's safe speed was lower than the speed asked for. None: it gave none."""
    best = episode.refinement.best
    actions = episode.refinement.results[best].actions if best is not None else None
    return {**actions.counts, "limited": actions.limited} if actions is not None and actions.counts else None


def _agents(episode: Episode) -> dict[str, Any]:
    """The players of the parts. The built-in expert is never presented as a language model."""
    agents = episode.agents
    players = dict(BUILT_IN_AGENTS) if agents is None else {role: agents.player(role) for role in AGENT_ROLES}
    models = sorted({m.name for m in agents.models.values()}) if agents is not None else []
    note = EXPERT_NOTE
    if models:
        parts = ", ".join(f"{role} {player}" for role, player in players.items())
        note = f"Parts played at the end: {parts}; predictions and tuner are built in."
    return {
        **players, "tuner": episode.settings.tuner, "note": note,
        "calls": dict.fromkeys(AGENT_ROLES, 0) if agents is None else agents.calls,
        "failed": {} if agents is None else agents.failed, "analysis": {} if agents is None else agents.analysis,
    }  # fmt: skip


def _llm(episode: Episode) -> dict[str, Any]:
    """The ledger, with what each question bought; ``model`` names those that took part, null for none."""
    agents = episode.agents
    names = sorted({m.name for m in agents.models.values()}) if agents is not None else []
    ledger = (Ledger() if agents is None else agents.ledger).as_dict()
    return {"model": ", ".join(names) or None, **ledger, "bought": _bought(episode)}


def _bought(episode: Episode) -> list[dict[str, Any]]:
    """The result of each question to a model; of a planner's text, also the attempts with it and their best level."""
    rows = []
    for each in [] if episode.agents is None else episode.agents.bought:
        own = [a.verdict.level for a in episode.refinement.attempts if a.proposal.planner.hash == each.planner]
        row = {"agent": each.agent, "what": each.what, "planner": each.planner, "attempts": len(own)}
        rows.append({**row, "level": str(max(own)) if own else None})
    return rows


def number(value: float | None) -> float | None:
    """A rounded number; infinite and missing are null."""
    return None if value is None or not math.isfinite(value) else round(float(value), 4)


def verdict(v: Verdict) -> dict[str, Any]:
    return {
        "min_ttc": number(v.min_ttc), "min_ttc_any": number(v.min_ttc_any), "min_pet": number(v.min_pet),
        "max_drac": number(v.max_drac), "min_distance": number(v.min_distance), "collided": v.collided,
        "critical": v.critical, "feasible": v.feasible, "rear_end": v.rear_end, "valid": v.valid, "strict": v.strict,
        "fault": v.fault, "failed_gates": list(v.failed_gates), "log_gates": list(v.log_gates),
        "contact_time": number(v.contact_time), "min_ttc_time": number(v.min_ttc_time),
        **level_figures(v),
    }  # fmt: skip


def level_figures(v: Verdict) -> dict[str, Any]:
    """The level, and what it follows from."""
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
        **({"misfits": list(v.misfits)} if v.misfits else {}),
    }  # fmt: skip


def _composed(p: Proposal) -> dict[str, Any]:
    """What an attempt with supports has besides: the label of the composition, and what each support did."""
    if not p.supports:
        return {}
    supports: list[dict[str, Any]] = [
        {**q.as_adversary(), "parameters": {k: number(v) for k, v in q.parameters.items()}} for q in p.supports
    ]
    return {"composition": p.composition, "supports": supports}


def _successes(episode: Episode) -> list[dict[str, Any]]:
    """The attacks of different kinds that reached the level; ``folder``: where the run's folder holds another one."""
    done, rows = episode.refinement, []
    for k in done.successes:
        folder = None if k == done.best or done.chosen is not None else f"{ATTACKS}/{k + 1}"
        rows.append({"attempt": k, "kind": done.attempts[k].kind, "folder": folder})
    return rows


def versions() -> dict[str, str]:
    """What took part in the numbers."""
    names = ("libsumo", "numpy", "scipy", "shapely", "pydantic-monty")
    return {"sumo_adv": __version__, "python": platform.python_version(), **{n: version(n) for n in names}}


def manifest(episode: Episode, inputs: Mapping[Path, str]) -> dict[str, Any]:
    """The contract's ``manifest.json``. ``inputs``: original file -> its copy's name under ``inputs/``."""
    task, best = episode.task, episode.best
    model_agents = episode.agents if episode.agents is not None and episode.agents.models else None
    used = {p.planner.hash: p.planner for a in episode.refinement.attempts for p in a.proposal.members}
    spec, made, record = task.spec, episode.source.conversion, episode.source.waymo
    return {
        "schema": MANIFEST_SCHEMA, "versions": versions(), "name": episode.source.name,
        "settings": episode.settings.model_dump(mode="json", exclude={"memory"}),
        "network": inputs[spec.network], "routes": [inputs[p] for p in spec.routes],
        "additional": [inputs[p] for p in spec.additional], "begin": spec.begin, "end": task.end,
        "seed": spec.seed, "step_length": spec.step_length, "sumo_options": spec.all_options,
        "empty_steps": spec.empty_steps,
        "trigger": task.trigger, "warm_up": task.warm_up, "only": list(task.only),
        "playback": _playback(task.playback, inputs), "conversion": None if made is None else {
            "map": made.source.name, "options": list(made.options), "lost": dict(made.lost), "said": list(made.said),
            "warnings": [asdict(kind) for kind in made.warnings],
        },
        "waymo": None if record is None else {**asdict(record), "file": str(record.file)},
        "notes": list(episode.source.notes),
        "ego": asdict(task.ego) if isinstance(task.ego, EgoRoute) else task.ego,
        "ego_base_type": task.ego_base_type, "ego_driver": task.ego_driver,
        "ego_parameters": dict(task.ego_parameters), "driven_from": task.driven_from,
        "driven_before": [list(each) for each in task.driven_before], "delay": task.delay,
        "skips": episode.skips,
        "intents_allowed": list(episode.source.intents), "words": episode.words or None,
        "asked": None if episode.asked is None else episode.asked.model_dump(mode="json", exclude_defaults=True),
        "bank_hash": episode.bank_hash, "bandit": episode.bandit,
        "model_answers": None if model_agents is None else MODEL_FILE,
        "prompts": None if model_agents is None else model_agents.prompts.versions,
        "planners": {
            name: {"label": p.label, "mode": p.mode, "origin": p.origin, "parent": p.parent, "source": p.source}
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
    return written if p.duty is Duty.COLLIDER else {**written, "role": str(p.duty)}
