"""Read a manifest: everything that ``run --replay`` needs, and nothing else."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.asked import Asked, Attacker
from sumo_adv.config import MAX_ATTACK_DELAY_S, Settings, load_settings
from sumo_adv.datatypes import MAX_WAIT_S, Duty, Proposal, acceleration_of
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.episode.task import Task
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links
from sumo_adv.parsing import read_json
from sumo_adv.planners.text import make_planner
from sumo_adv.report.outcome import MANIFEST_SCHEMA
from sumo_adv.simulation.inputs import EgoRoute, RunInput, WaymoSource
from sumo_adv.simulation.maps import MapConversion
from sumo_adv.simulation.playback_spec import PlaybackSpec, Prop, make_playback
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_options import DEFAULTS, FORCED

RETIRED = ("experience",)  # settings of earlier versions; a replay drives the recorded attempt and needs none of them
USERS = ("llm_base_url", "bubblewrap")  # settings that no run folder brings: a model's server, the sandbox's wall


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run as its manifest records it.

    Attributes:
        run_input: The input.
        settings: The settings.
        task: The task.
        proposal: The candidate that was attempted.
        skips: The number of encounters before the one that counts.
    """

    run_input: RunInput
    settings: Settings
    task: Task
    proposal: Proposal
    skips: int  # encounters passed over for being out of reach


def read_manifest(folder: Path) -> RecordedRun:
    """Read the manifest of a run's folder.

    Args:
        folder: The folder.

    Returns:
        The recorded run.

    Raises:
        UsageError: The folder has no manifest, the manifest has another schema or no attempt, or an input's copy is
            missing or changed.
    """
    refuse_links(folder)
    file = folder / "manifest.json"
    if not file.is_file():
        raise UsageError(f"{folder} holds no manifest.json; give the folder of a run.")
    try:
        m: dict[str, Any] = read_json(file)
        if m["schema"] != MANIFEST_SCHEMA:
            raise UsageError(
                f"{file} has schema {m['schema']}, this program reads {MANIFEST_SCHEMA}; use the version that wrote it."
            )
        if m["attempt"] is None:
            raise UsageError(f"The run in {folder} made no attempt, so there is nothing to replay.")
        return _recorded(folder, m)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{file} is not a manifest of this program ({type(error).__name__}: {error}).") from error


def _recorded(folder: Path, m: dict[str, Any]) -> RecordedRun:
    settings = load_settings(None, **_settings(m["settings"]))
    spec = SimulationSpec(
        _copy(folder, m["network"]), tuple(_copy(folder, n) for n in m["routes"]),
        tuple(_copy(folder, n) for n in m["additional"]), m["begin"], m["seed"], settings.step_length,
        {name: value for name, value in m.get("sumo_options", DEFAULTS).items() if name not in FORCED},
        m.get("empty_steps", 0),
    )  # fmt: skip
    ego = m["ego"]
    if isinstance(ego, dict):
        ego = EgoRoute(tuple(ego["edges"]), ego["depart"], ego["lane"], ego["position"], ego["speed"])
    task = Task(
        spec, settings, ego, m["ego_base_type"], m["ego_driver"], m["ego_parameters"], tuple(m["only"]), m["trigger"],
        m["warm_up"], m["end"], _playback(folder, m.get("playback"), spec.routes),
        driven_from=m.get("driven_from"), delay=m.get("delay"),
        driven_before=[(name, begin, end) for name, begin, end in m.get("driven_before", ())],
        moves=tuple(EgoMove.model_validate(move) for move in m.get("moves", ())),
        sight=tuple(SightStretch.model_validate(stretch) for stretch in m.get("sight", ())),
    )  # fmt: skip
    proposal = _proposal(folder, m["attempt"], m["planners"])
    asked, made = m.get("asked"), m.get("conversion")
    conversion = None if made is None else MapConversion(
        Path(made["map"]), spec.network, tuple(made["options"]), dict(made["lost"]), tuple(made["said"])
    )  # fmt: skip
    run_input = RunInput(
        name=m["name"], path=folder, network=spec.network, intents=tuple(m["intents_allowed"]),
        asked=None if asked is None else Asked.model_validate(asked), words=m.get("words") or "",
        attackers=tuple(Attacker.model_validate(each) for each in m.get("attackers", ())),
        conversion=conversion, notes=tuple(m.get("notes", ())),
        waymo=waymo_source(m),
    )  # fmt: skip
    return RecordedRun(run_input, settings, task, proposal, m["skips"])


def _proposal(folder: Path, a: dict[str, Any], planners: dict[str, Any]) -> Proposal:
    p = planners[a["planner"]]
    planner = make_planner(p["label"], p["mode"], p["source"], p["origin"], p["parent"])
    if planner.hash != a["planner"]:
        raise UsageError(f"The planner in {folder}/manifest.json was changed after the run, so it cannot be replayed.")
    if not 0.0 <= a["delay"] <= MAX_ATTACK_DELAY_S:
        raise ValueError(f"its delay of {a['delay']} s is none")
    numbers = {str(k): float(v) for k, v in a["parameters"].items()}
    return Proposal(
        a["bv"], a["label"], planner, numbers, acceleration_of(a["acceleration"]), a["delay"], a["by"],
        duty=Duty(a.get("role", Duty.COLLIDER)), wait=_wait(a.get("wait", 0.0)), composition=a.get("composition", ""),
        supports=tuple(_proposal(folder, q, planners) for q in a.get("supports", ())),
    )  # fmt: skip


def _wait(value: Any) -> float:
    """Return how long an attacker waits [s]; raise ValueError if it is too long."""
    if not 0.0 <= value <= MAX_WAIT_S:
        raise ValueError(f"its wait of {value} s is none")
    return float(value)


def _settings(recorded: dict[str, Any]) -> dict[str, Any]:
    """Return a manifest's settings without those of the user; before version 0.2 ``critical_ttc`` was named ``ttc``."""
    kept = {name: value for name, value in recorded.items() if name not in (*RETIRED, *USERS)}
    return {**kept, "ttc": None, "critical_ttc": kept["ttc"]} if isinstance(kept.get("ttc"), float) else kept


def _playback(folder: Path, p: dict[str, Any] | None, routes: Sequence[Path]) -> PlaybackSpec | None:
    if p is None:
        return None
    props = [Prop(**{**q, "end": math.inf if q["end"] is None else q["end"]}) for q in p["props"]]
    tracks, signals = (_copy(folder, p[k]) if p[k] else None for k in ("tracks", "signals"))
    return make_playback(tracks, p["background"], signals, props, routes)


def waymo_source(m: Mapping[str, Any]) -> WaymoSource | None:
    """Return the Waymo record that a manifest's input was converted from; None without one or in older manifests."""
    made = m.get("waymo")
    return None if made is None else WaymoSource(Path(made["file"]), str(made["id"]), str(made["content"]))


def _copy(folder: Path, name: str) -> Path:
    """Find the copy of an input and check that it is unchanged."""
    file = folder / "inputs" / Path(name).name
    if not file.is_file():
        raise UsageError(f"{file} is missing, so the run in {folder} cannot be replayed.")
    if hashlib.sha256(file.read_bytes()).hexdigest()[:12] != name[:12]:
        raise UsageError(f"{file} was changed after the run, so it cannot be replayed.")
    return file.resolve()
