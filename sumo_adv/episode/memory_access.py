"""Read the memory bank for a run: library, retrieval and recall of scenes."""

from __future__ import annotations

import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Intent, LibraryEntry, Limits, Planner, Proposal, acceleration_of
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.memory.bank import MemoryBank, retrieve_composition
from sumo_adv.memory.recall import SCENE_SCALES, drawn_order, explain, signature_distance
from sumo_adv.memory.records import Evidence, SceneSignature, canonical
from sumo_adv.planners.scripts import script_entry
from sumo_adv.script import Script
from sumo_adv.search.intents import COMPOSED, FREE, Selection, applies_of, select
from sumo_adv.search.supports import ANY_FITTING, Cast
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.situation import Situation

CONFIRMED_INTENTS = 2  # number of nearest intents with which the analyzer compares a new one


def read_library(
    bank: MemoryBank, now: SceneSignature, seed: int, situations: Mapping[float, Situation],
    scripts: Sequence[Script] = (),
) -> tuple[list[LibraryEntry], list[dict[str, object]]]:  # fmt: skip
    """Read the bank's active intents as a library.

    Thompson sampling orders an intent's planners by their evidence in scenes like ``now``. If a pedestrian or cyclist
    could be the adversary, the shipped intents for them are added (``unprotected_library``). The scripts of the
    scenario are added as intents, which their first success adds to the bank.

    Args:
        bank: The bank.
        now: The present scene.
        seed: The seed of Thompson sampling.
        situations: The situations by delay after the trigger [s].
        scripts: The scripts of the scenario.

    Returns:
        The library, and how the planners of each intent were ordered, for the manifest.
    """
    rng = random.Random(seed)
    entries, explained = [], list[dict[str, object]]()
    for record in bank.intents():
        if record.status == "active":
            arms = drawn_order(bank.planners(record.label), bank.evidence(record.label), now, rng)
            explained.append({"label": record.label, "planners": explain(arms)})
            planners = tuple(arm.planner for arm in arms)
            entries.append(LibraryEntry(record.label, record.description, record.applies, planners))
    targets = [target for situation in situations.values() for target in situation.targets.values()]
    near = {word for target in targets for word in target.applies()}
    held = {record.label: record.status for record in bank.intents()}
    for shipped in unprotected_library():
        if near.intersection(shipped.applies) and held.get(shipped.label, "active") == "active":
            entries = _with(entries, shipped)
    return with_scripts(entries, scripts), explained


def with_scripts(library: Sequence[LibraryEntry], scripts: Sequence[Script]) -> list[LibraryEntry]:
    """Add scripts to a library as intents.

    Args:
        library: The library.
        scripts: The scripts.

    Returns:
        The library. If it has an intent with the label of a script, that intent has the script's planner as well.
    """
    entries = list(library)
    for script in scripts:
        entries = _with(entries, script_entry(script))
    return entries


@lru_cache(maxsize=1)
def unprotected_library() -> tuple[LibraryEntry, ...]:
    """Return the shipped intents of pedestrians and cyclists. Their first success adds them to a bank."""
    with MemoryBank.open(data_folder("unprotected_bank.sqlite"), read_only=True) as shipped:
        return tuple(
            LibraryEntry(r.label, r.description, r.applies, tuple(shipped.planners(r.label)), "generated")
            for r in shipped.intents()
        )


def _with(entries: Sequence[LibraryEntry], shipped: LibraryEntry) -> list[LibraryEntry]:
    """Add an intent to a library; if the library has it, add only the planners and relations that it lacks."""
    held = next((e for e in entries if e.label == shipped.label), None)
    if held is None:
        return [*entries, shipped]
    hashes = {p.hash for p in held.planners}
    planners = (*held.planners, *(p for p in shipped.planners if p.hash not in hashes))
    more = replace(held, planners=planners, applies=tuple(dict.fromkeys((*held.applies, *shipped.applies))))
    return [more if e is held else e for e in entries]


def selected(
    settings: Settings, bank: MemoryBank, scenario: Sequence[str] = (), scripts: Sequence[Script] = ()
) -> Selection:
    """Return the intents of a bank that settings and a scenario allow.

    A scenario may name intents that the bank lacks or has retired, if the program ships them.

    Args:
        settings: The run's settings.
        bank: The bank.
        scenario: The intents that the scenario names; empty allows all.
        scripts: The scripts of the scenario, which are known intents.

    Raises:
        UsageError: The settings or the scenario name an unknown intent, or no intent is left.
    """
    labels = [record.label for record in bank.intents() if record.status == "active"]
    labels += [entry.label for entry in unprotected_library()]
    labels += [script.label for script in scripts]
    if not settings.intents:
        allowed = {canonical(label) for label in (FREE.label, *COMPOSED, *labels)}
        unknown = [n for n in scenario if canonical(n) not in allowed and bank.intent(n) is None]
        if unknown:
            select(labels, [n for n in unknown if canonical(n) not in shipped_labels()])
    return select(labels, settings.intents, settings.exclude, scenario)


@lru_cache(maxsize=1)
def shipped_labels() -> frozenset[str]:
    """Return the canonical labels of the bank that comes with the program."""
    with MemoryBank.open(data_folder("memory_bank.sqlite"), read_only=True) as shipped:
        return frozenset(canonical(record.label) for record in shipped.intents())


def recall(
    found: FoundEncounter, library: Sequence[LibraryEntry], bank: MemoryBank, selection: Selection, limits: Limits,
    driver: str,
) -> tuple[Intent, Proposal] | None:  # fmt: skip
    """Return the attack that the bank remembers from the most similar scene.

    Valid collisions take precedence over other successes; then the nearest scene wins.

    Args:
        found: The encounter.
        library: The library of the run.
        bank: The bank.
        selection: The intents that may be tried.
        limits: The limits of the acceleration.
        driver: The name of the ego's driver.

    Returns:
        The intent and the attack; None if no scene is similar enough.
    """
    best: tuple[tuple[bool, float], Intent, Proposal] | None = None
    for delay, situation in sorted(found.situations.items()):
        for target in situation.target_list():
            scene = signature(situation, target.state.id, driver)
            evidence = bank.recall_scene(scene)
            remains = _remembered(library, evidence, limits) if evidence is not None else None
            if evidence is None or remains is None or not selection.allows(evidence.label):
                continue
            entry, planner = remains
            order = (not evidence.valid, signature_distance(evidence.scene, scene))
            if best is None or order < best[0]:
                why = f"a like scene in '{evidence.network}' has evidence (distance {order[1]:.2f})"
                intent = Intent(target.state.id, entry.label, entry.description, "high", evidence.acceleration, why)
                proposal = Proposal(
                    target.state.id, entry.label, planner, dict(evidence.parameters), evidence.acceleration, delay,
                    by="memory", score=0.0,
                )  # fmt: skip
                best = (order, intent, proposal)
    return None if best is None else best[1:]


def _remembered(
    library: Sequence[LibraryEntry], evidence: Evidence, limits: Limits
) -> tuple[LibraryEntry, Planner] | None:
    """Return the entry and the planner that a piece of evidence is about.

    Return None if they are retired, or if the acceleration is beyond the limits of this run.
    """
    try:
        acceleration_of(evidence.acceleration, limits)
    except ValueError:
        return None
    for entry in library:
        for planner in entry.planners:
            if entry.label == evidence.label and planner.hash == evidence.planner_hash:
                return entry, planner
    return None


@dataclass(frozen=True, slots=True)
class Retrieved:
    """The library for the intents of an encounter.

    Attributes:
        intents: The intents, each with the label of its entry.
        library: The library that has these entries.
        seconds: The time spent in the bank [s].
    """

    intents: Sequence[Intent]
    library: Sequence[LibraryEntry]
    seconds: float


def retrieve(
    given: Sequence[Intent], agents: Agents, situations: Mapping[float, Situation], library: Sequence[LibraryEntry],
    bank: MemoryBank,
) -> Retrieved:  # fmt: skip
    """Return the library with entries for intents.

    An intent that a model calls novel is novel, unless the model says that it is one of the nearest two. Without a
    judgement, an intent within epsilon of a library entry takes that entry's label. A novel intent gets a new entry,
    with generated planners.

    Args:
        given: The intents.
        agents: The models of the run.
        situations: The situations by delay after the trigger [s].
        library: The library so far.
        bank: The bank.

    Raises:
        ModelError: A model that plays the analyzer or the generator failed.
    """
    entries, by_label, intents, spent = list(library), {e.label: e for e in library}, list(given), 0.0
    situation = situations[min(situations)]
    for intent in given:
        if intent.label in by_label:
            continue
        began = time.perf_counter()
        retrieved = bank.retrieve(intent.label, intent.description)
        spent += time.perf_counter() - began
        near = [by_label[label] for label, _ in retrieved.nearest if label in by_label]
        if agents.by_model("analyzer") and not applies_of(intent.label) and near:
            same = agents.confirm(intent, near[:CONFIRMED_INTENTS], situations)
        else:
            same = None if retrieved.hit is None else replace(intent, label=retrieved.hit)
        words = situation.targets[intent.bv].applies()
        if same is not None:  # use the planners of the near intent, and extend it to this vehicle's place
            hit = by_label[same.label]
            entry = replace(hit, applies=tuple(dict.fromkeys((*hit.applies, *words))))
            entries = [entry if e.label == hit.label else e for e in entries]
            by_label[hit.label] = entry
            intents = [replace(i, label=hit.label, ways=same.ways) if i.label == intent.label else i for i in intents]
            continue
        planners = agents.generate(intent, situation, near or library)
        if planners:
            own = applies_of(intent.label) or words
            entry = LibraryEntry(intent.label, intent.description, own, planners, "generated")
            by_label[intent.label] = entry
            entries.append(entry)
    return Retrieved(intents, entries, spent)


def known_casts(casts: Sequence[Cast], bank: MemoryBank) -> list[Cast]:
    """Replace each proposed composition by the bank's own if the bank knows one with its label or description.

    The bank's parts and modes then count. A part is carried out by the vehicle that was proposed for its role, or by
    any that fits if none was.

    Args:
        casts: The proposed compositions with their vehicles.
        bank: The bank.

    Returns:
        The compositions with their vehicles, in the same order.
    """
    replaced = []
    for cast in casts:
        composition = retrieve_composition(bank, cast.composition.label, cast.composition.description)
        if composition is not None:
            left = [(p.duty, bv) for p, bv in zip(cast.composition.parts, cast.vehicles, strict=True)]
            vehicles = []
            for part in composition.parts:
                match = next((each for each in left if each[0] is part.duty), None)
                if match is not None:
                    left.remove(match)
                vehicles.append(ANY_FITTING if match is None else match[1])
            cast = Cast(composition, tuple(vehicles))
        replaced.append(cast)
    return replaced


def remembered(bank: MemoryBank, library: Sequence[LibraryEntry], now: SceneSignature) -> dict[str, str]:
    """Count the attempts with each intent in encounters of this geometry against this driver.

    Args:
        bank: The bank.
        library: The library of the run.
        now: The present scene.

    Returns:
        A sentence for each intent that was tried, by label.
    """
    tallies, key = {}, (now.geometry, now.controller)
    for entry in library:
        like = [e for e in bank.evidence(entry.label) if (e.scene.geometry, e.scene.controller) == key]
        if like:
            critical, valid = sum(e.success for e in like), sum(e.valid is True for e in like)
            tallies[entry.label] = (
                f"{len(like)} times tried, {critical} times critical, {valid} times an avoidable collision"
            )
    return tallies


def signature(situation: Situation, bv: str, driver: str) -> SceneSignature:
    """Return what makes scenes alike: geometry class, relation, relative state of the BV, and the ego's driver.

    Args:
        situation: The situation at the start of the attack.
        bv: The id of the BV. Its relative state is in m, rad and m/s.
        driver: The name of the ego's driver.
    """
    target = situation.targets[bv]
    x, y, heading = situation.frame.to_local(target.state.x, target.state.y, target.state.heading)
    scene = (x, y, heading, target.state.speed, situation.ego.speed)
    kinds = {w.conflict.kind for w in target.ways if w.conflict is not None}
    geometry = "straight" if not kinds else ("crossing" if "crossing" in kinds else "merging")
    relative = {
        name: round(value, 3 if name == "heading" else 2) for name, value in zip(SCENE_SCALES, scene, strict=True)
    }
    return SceneSignature(geometry, target.relation, relative, driver)
