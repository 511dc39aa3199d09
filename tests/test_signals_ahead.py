"""What a situation knows of the traffic lights, from a real run of a signalised crossing."""

from __future__ import annotations

from pathlib import Path

from sumo_adv.config import load_settings
from sumo_adv.episode.engine import EpisodeCalls, episode_worker
from sumo_adv.episode.task import FoundEncounter, make_task
from sumo_adv.planners.answers import planner_road
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input


def test_the_lights_ahead_of_ego_and_targets_are_in_every_situation(tmp_path: Path) -> None:
    """The ego has green and the vehicle from the right red, as the scenario says."""
    run_input = load_input(Path("signals_red_light"))
    settings = load_settings(None, horizon=run_input.horizon, ego=run_input.ego_controller)
    with Engine(episode_worker) as engine:
        engine.call(EpisodeCalls.open, make_task(run_input, settings, tmp_path))
        encounter = engine.call(EpisodeCalls.seek, "")
    assert isinstance(encounter, FoundEncounter)
    bv = encounter.ranking[0][0]
    for situation in encounter.situations.values():
        ego_light, bv_light = situation.traffic.signals["ego"][0], situation.traffic.signals[bv][0]
        assert (ego_light[0], bv_light[0]) == ("centre", "centre")
        assert (ego_light[2].lower(), bv_light[2]) == ("g", "r")
        assert situation.traffic.signals.keys() <= {"ego", *situation.targets}
        assert planner_road(situation, bv)["signals"]["bv"][0] == {
            "id": "centre",
            "distance": bv_light[1],
            "state": "r",
        }
    first = encounter.first
    ways = [w for w in first.targets[bv].ways if w.conflict is not None]
    stop_line = first.traffic.signals[bv][0][1]  # from the bumper; the conflict lies beyond it
    assert 0.0 < stop_line < ways[0].conflict.bv_s  # type: ignore[union-attr]
