"""Turn the folder of a run into the folder of a case: what ``sumo-adv keep`` writes."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import MAX_ADVERSARIES, Level, Proposal, plain_acceleration
from sumo_adv.episode.references import state_at
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links, sentences, toml_lines, toml_value
from sumo_adv.regression.at_trigger import AtTrigger
from sumo_adv.regression.case import (
    CASE_FILE,
    CASE_SCHEMA,
    NETWORKS_FOLDER,
    SHAPING,
    Expectation,
    hash_of,
    planner_file,
    read_case,
)
from sumo_adv.report.manifest import RecordedRun, read_manifest
from sumo_adv.report.read import read_outcome, read_run
from sumo_adv.report.run_outcome import level_named
from sumo_adv.report.staging import staged
from sumo_adv.simulation.inputs import EgoRoute, data_folder
from sumo_adv.simulation.playback_spec import Prop
from sumo_adv.simulation.scenario import SCENARIO_FILE
from sumo_adv.simulation.sumo_options import differing

FOUND = ("level", "contact_time", "min_ttc", "delta_v", "severity", "preventable_by")
HASH_AND_DASH_CHARACTERS = 13  # characters before an input's original name in a run's folder
PROPS = {"parked": "parked", "pedestrian": "pedestrians", "cyclist": "cyclists"}


def keep_run(
    run: Path, suite: Path, expect: Expectation, name: str | None = None, passed_by: Sequence[str] | None = None
) -> tuple[Path, bool]:
    """Write the attack of a run as a case into a suite.

    Args:
        run: The folder of the run.
        suite: The folder of the suite.
        expect: What is expected of the ego.
        name: The name of the case. By default it is that of the input with the seed, and a number if another attack has
            that name.
        passed_by: The reference drivers that pass the case (``reference.py``); None if none was tried.

    Returns:
        The folder of the case, and whether it is new.

    Raises:
        UsageError: The folder is not that of a run, its attack reached no level, the name is taken, or the suite cannot
            be written.
    """
    refuse_links(suite)
    recorded, texts = _texts(run, suite, expect, passed_by)
    with sentences(suite):
        folder = _place(suite, name or _named(recorded), texts, fixed=name)
        if folder.exists():
            return folder, False
        with staged(folder, force=False, inside=True) as made:
            for file, text in texts.items():
                (made.stage / file).write_text(text, encoding="utf-8")
            for copy, target in _traffic(recorded).items():
                shutil.copyfile(copy, made.stage / target)
            _copy_network(recorded.task.spec.network, suite)
            made.keep(force=False)
    read_case(folder)
    return folder, True


def held_in(run: Path, suite: Path, name: str | None = None) -> Path | None:
    """Find the case in a suite that already has the attack of a run.

    Args:
        run: The folder of the run.
        suite: The folder of the suite.
        name: The name of the case; None takes that of the input with the seed.

    Returns:
        The folder of the case; None if there is none.

    Raises:
        UsageError: As ``keep_run``.
    """
    recorded, texts = _texts(run, suite, Expectation(avoid="collision"), None)
    with sentences(suite):
        folder = _place(suite, name or _named(recorded), texts, fixed=name)
    return folder if folder.exists() else None


def _texts(
    run: Path, suite: Path, expect: Expectation, passed_by: Sequence[str] | None
) -> tuple[RecordedRun, dict[str, str]]:
    """Return what the manifest of a run records, and the texts of its case by file."""
    recorded, outcome = read_manifest(run), read_outcome(run)
    if level_named((outcome.get("outcome") or {}).get("level")) is Level.NONE:
        raise UsageError(f"The attack of {run} reached no level, so there is nothing to keep.")
    encounter = outcome.get("encounter") or {}
    relations = {r["id"]: r["relation"] for r in encounter.get("ranking", ())}
    if not relations.keys() >= set(recorded.proposal.bvs):
        raise UsageError(f"{run} does not record the relation of its adversary to the ego; rerun the attack.")
    situation = _situation(run, recorded, outcome)
    return recorded, {
        SCENARIO_FILE: _scenario(recorded, outcome, suite),
        **{planner_file(k): p.planner.text for k, p in enumerate(recorded.proposal.members)},
        CASE_FILE: _case(recorded, outcome, relations, expect, passed_by, situation),
    }


def _situation(run: Path, recorded: RecordedRun, outcome: Mapping[str, Any]) -> AtTrigger | None:
    """Return the ego and the adversary when the attack began; None if the recorded states lack one of them."""
    when, tracks = float(outcome["trigger_time"]), {t.id: t for t in read_run(run).best}
    ego, adversary = (tracks.get(name) for name in (str(outcome["ego"]["id"]), recorded.proposal.bv))
    if ego is None or adversary is None:
        return None
    here, there = state_at(ego, when), state_at(adversary, when)
    return None if here is None or there is None else AtTrigger.of(here, there)


def _named(recorded: RecordedRun) -> str:
    """Return the default name of a case."""
    return _slug(f"{recorded.run_input.name}-{recorded.settings.seed}")


def _place(suite: Path, name: str, texts: Mapping[str, str], *, fixed: str | None) -> Path:
    """Return a folder that is free, or holds the same case; raise UsageError if the fixed name is taken."""
    for k in range(1, 10_000):
        folder = suite / (name if k == 1 else f"{name}-{k}")
        if not folder.exists() or _same(folder, texts):
            return folder
        if fixed is not None:
            break
    raise UsageError(f"The suite {suite} has another case '{name}'; give another --name.")


def _same(folder: Path, texts: Mapping[str, str]) -> bool:
    """Return whether a folder holds the same attack; expectation and notes on the finding may differ."""
    held = {name: (folder / name).read_text(encoding="utf-8") for name in texts if (folder / name).is_file()}
    attack = [_attack_in(text[CASE_FILE]) for text in (held, texts) if CASE_FILE in text]
    same = all(held.get(name) == text for name, text in texts.items() if name != CASE_FILE)
    return same and len(attack) == 2 and attack[0] == attack[1]


def _attack_in(case: str) -> str:
    """Return the tables ``[attack]`` and ``[settings]`` of the text of a case."""
    return case.partition("[attack]")[2].partition("[found]")[0]


def _slug(name: str) -> str:
    """Return a name that can be a folder's."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "-" for c in name).strip(".-") or "case"


def _traffic(recorded: RecordedRun) -> dict[Path, str]:
    """Return the run's copies of demand, additional files and recordings, with their names in the case."""
    spec, played = recorded.task.spec, recorded.task.playback
    files = (*spec.routes, *spec.additional, *(played.files if played is not None else ()))
    names: dict[Path, str] = {}
    for file in files:
        own = file.name[HASH_AND_DASH_CHARACTERS:]
        taken = own in (*names.values(), SCENARIO_FILE, CASE_FILE, *map(planner_file, range(MAX_ADVERSARIES)))
        names.setdefault(file, f"{len(names)}-{own}" if taken else own)
    return names


# -- the network ------------------------------------------------------------------------------------------------------


def _network(network: Path, suite: Path) -> str:
    """Return the scenario's name of a network: that of a shipped one, or the path of its copy in the suite."""
    own = network.name[HASH_AND_DASH_CHARACTERS:]
    shipped = data_folder("networks") / own
    if shipped.is_file() and hash_of(shipped) == hash_of(network):
        return own.removesuffix(".net.xml")
    return f"../{NETWORKS_FOLDER}/{_copy_of(network, suite).name}"


def _copy_network(network: Path, suite: Path) -> None:
    """Copy a network into the suite, unless it is a shipped one or is there."""
    target = _copy_of(network, suite)
    if _network(network, suite).startswith("..") and not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(network, target)


def _copy_of(network: Path, suite: Path) -> Path:
    """Return the path of a network's copy in the suite; its hash is in the name if another network has that name."""
    copy = suite / NETWORKS_FOLDER / network.name[HASH_AND_DASH_CHARACTERS:]
    return copy.with_name(network.name) if copy.exists() and hash_of(copy) != hash_of(network) else copy


# -- the texts --------------------------------------------------------------------------------------------------------


def _scenario(recorded: RecordedRun, outcome: Mapping[str, Any], suite: Path) -> str:
    """Return the text of the scenario."""
    task, settings = recorded.task, recorded.settings
    spec, played, files = task.spec, task.playback, _traffic(recorded)
    encounter, helpers = outcome["encounter"], list(recorded.proposal.bvs[1:])
    top = {
        "schema": 1, "network": _network(spec.network, suite),
        "tracks": files[played.tracks] if played is not None and played.tracks is not None else None,
        "background": played.background if played is not None and played.tracks is not None else None,
        "additional": [files[f] for f in spec.additional] or None,
    }  # fmt: skip
    demand = {"files": [files[f] for f in spec.routes] or None, "begin": spec.begin, "end": task.end}
    window = {"warm_up": task.warm_up, "trigger": encounter["time"], "horizon": settings.horizon}
    lines = [
        *toml_lines(top), "", "[demand]", *toml_lines(demand), "", "[ego]",
        *toml_lines(_ego(task.ego, str(outcome["ego"]["id"]))),
        *toml_lines({"controller": task.ego_driver, "type": task.ego_base_type}),
        *toml_lines({"parameters": dict(task.ego_parameters) or None}), "", "[window]", *toml_lines(window),
        "", "[adversary]", *toml_lines({"candidates": [recorded.proposal.bv], "supports": helpers or None}),
    ]  # fmt: skip
    if played is not None and played.signals is not None:
        lines += ["", "[signals]", *toml_lines({"log": files[played.signals]})]
    for move in task.moves:  # the trigger says when the encounter begins
        lines += ["", "[[moves]]", *toml_lines(move.model_dump(exclude_defaults=True, exclude={"attacked"}))]
    for stretch in task.sight:
        lines += ["", "[[sight]]", *toml_lines(stretch.model_dump(by_alias=True))]
    for prop in played.props if played is not None else ():
        lines += ["", f"[[{PROPS[prop.id.rstrip('0123456789')]}]]", *toml_lines(_box(prop))]
    return "\n".join(lines) + "\n"


def _ego(ego: str | EgoRoute | None, name: str) -> dict[str, Any]:
    """Return the table of the ego."""
    if not isinstance(ego, EgoRoute):
        return {"id": name}
    return {
        "route": list(ego.edges), "depart": ego.depart, "lane": ego.lane, "position": ego.position, "speed": ego.speed
    }  # fmt: skip


def _box(prop: Prop) -> dict[str, Any]:
    """Return the table of an object beside the road."""
    keys = ("x", "y", "heading", "length", "width", "speed")
    always = prop.start == 0.0 and math.isinf(prop.end)
    return {k: getattr(prop, k) for k in keys} | {"times": None if always else [prop.start, prop.end]}


def _case(
    recorded: RecordedRun, outcome: Mapping[str, Any], relations: Mapping[str, str], expect: Expectation,
    passed_by: Sequence[str] | None, situation: AtTrigger | None,
) -> str:  # fmt: skip
    """Return the text of case.toml."""
    p, task = recorded.proposal, recorded.task
    encounter, verdict = outcome["encounter"], outcome["outcome"]
    before = encounter.get("driven_before", ()) if task.ego is None else task.driven_before
    attack = {
        "adversary": p.bv, "relation": relations[p.bv], "intent": p.label, "mode": p.planner.mode,
        "origin": p.planner.origin, "delay": p.delay, "acceleration": plain_acceleration(p.acceleration),
        "ego_driven_from": encounter.get("driven_from") if task.ego is None else task.driven_from,
        "ego_before": [list(each) for each in before] or None,
        "network": hash_of(task.spec.network), "composition": p.composition or None, "wait": p.wait or None,
    }  # fmt: skip
    expected = {k: v for k, v in expect.model_dump().items() if v not in (None, False)}
    observed = {"ego": task.ego_driver} | {k: verdict.get(k) for k in FOUND}
    observed["passed_by"] = None if passed_by is None else list(passed_by)
    at_trigger = [] if situation is None else ["", "[found.situation]", *toml_lines(situation.as_data())]
    lines = [
        f"schema = {CASE_SCHEMA}", "", "[expect]", *toml_lines(expected), "", "[attack]", *toml_lines(attack), "",
        "[attack.parameters]", *toml_lines(dict(p.parameters)), "", *_supports(p, relations),
        "[settings]", *_settings(recorded), "",
        "[found]", *toml_lines(observed), *at_trigger,
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _supports(p: Proposal, relations: Mapping[str, str]) -> Sequence[str]:
    """Return the lines of the supports."""
    lines = list[str]()
    for q in p.supports:
        written = {
            "adversary": q.bv, "role": str(q.duty), "relation": relations[q.bv], "intent": q.label,
            "mode": q.planner.mode, "origin": q.planner.origin, "acceleration": plain_acceleration(q.acceleration),
            "wait": q.wait or None,
        }  # fmt: skip
        parameters = toml_lines(dict(q.parameters))
        lines += ["[[attack.supports]]", *toml_lines(written), "[attack.supports.parameters]", *parameters, ""]
    return lines


def _settings(recorded: RecordedRun) -> Sequence[str]:
    """Return the lines of the settings."""
    shaping = recorded.settings.model_dump(mode="json", include=set(SHAPING))
    del shaping["sumo_options"]
    lines = toml_lines({k: shaping[k] for k in SHAPING if k in shaping})
    options = differing(recorded.task.spec.options)
    if options:
        lines += ["", "[settings.sumo_options]", *(f"{json.dumps(k)} = {toml_value(v)}" for k, v in options.items())]
    return lines
