"""The adversary follows the ego, and an attack changes nothing but what it explains."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from cli_samples import Done, Program, Runs, States, lacking, moves, position, read_states
from ego_samples import BRAKES_AT

from sumo_adv.simulation.forks import can_fork

needs_fork = pytest.mark.skipif(not can_fork(), reason="this system cannot fork a simulation")

TRIGGER = 5.0  # s, of the scenario motorway_cut_in_left
NEVER_NEAR = 150.0  # m
CLOSE = 4  # s after the trigger by which the braking has had its effect


def tables(done: Done) -> tuple[States, States]:
    """Attacked and unattacked states."""
    return read_states(done.folder / "states.csv.gz"), read_states(done.folder / "raw.csv.gz")


def parties(done: Done) -> tuple[str, str]:
    """The ids of ego and adversary."""
    outcome = done.outcome
    return outcome["ego"]["id"], outcome["adversaries"][0]["id"]


def differs_from(first: States, second: States, vehicle: str) -> float:
    """The first common time [s] at which a vehicle is not the same in both; ``inf`` = never."""
    common = sorted(first[vehicle].keys() & second.get(vehicle, {}).keys())
    return next((t for t in common if moves(first[vehicle][t]) != moves(second[vehicle][t])), math.inf)


def apart(first: States, a: str, second: States, b: str) -> float:
    """Least distance [m] of vehicle a in one table and b in the other from the trigger on."""
    common = first[a].keys() & second[b].keys()
    return min(
        (math.dist(position(first[a][t]), position(second[b][t])) for t in common if t >= TRIGGER), default=math.inf
    )


# -- the adversary follows the ego


def test_the_adversary_follows_the_ego(runs: Runs) -> None:
    calm, braking = runs["calm"], runs["braking"]
    assert (calm.status, braking.status) == (0, 0), calm.err + braking.err
    plans = [done.outcome["attempts"][0] for done in (calm, braking)]
    same = ("adversaries", "intent", "planner", "parameters", "acceleration", "trigger_time")
    assert [plans[0][k] for k in same] == [plans[1][k] for k in same]
    assert plans[0]["trigger_time"] == TRIGGER
    (first, _), (second, _) = tables(calm), tables(braking)
    adversary = parties(calm)[1]
    assert BRAKES_AT < differs_from(first, second, "ego") <= BRAKES_AT + 0.15
    # Up to 6 s both egos are the same; the planner is asked again at 6.0 s, 6.5 s, ...
    assert BRAKES_AT < differs_from(first, second, adversary) <= BRAKES_AT + 2.0
    common = [t for t in first[adversary].keys() & second[adversary].keys() if t <= TRIGGER + CLOSE]
    gaps = [math.dist(position(first[adversary][t]), position(second[adversary][t])) for t in common]
    assert max(gaps) > 0.5  # m; the ego itself brakes by 5 m/s2


def test_a_driver_that_does_not_say_it_may_be_forked_is_not(runs: Runs) -> None:
    calm, braking = runs["calm"].outcome, runs["braking"].outcome
    assert (calm["forked"], braking["forked"]) == (True, False)
    assert (calm["ego"]["controller"], braking["ego"]["controller"]) == (
        "ego_samples:CalmEgo",
        "ego_samples:BrakingEgo",
    )


def test_the_ego_class_drives_in_the_unattacked_run_too(runs: Runs) -> None:
    _, raw = tables(runs["braking"])
    before, after = (float(raw["ego"][t]["speed"]) for t in (6.0, 8.0))
    assert after < before - 9.0  # 2 s at 5 m/s2 are 10 m/s


def test_a_driver_that_fails_ends_the_run_with_a_sentence(program: Program) -> None:
    done = program("run", "motorway_cut_in_left", "--ego", "ego_samples:FailingEgo", "--out", "out", "--attempts", "1")
    assert done.status == 1
    assert done.err.startswith("sumo-adv: ") and len(done.err.splitlines()) == 1
    assert "asleep" in done.err
    assert done.outcome["ending"] in {"simulation_failed", "ego_lost"}
    assert "asleep" in done.outcome["reason"]
    assert program.leftovers() == ["out"]


CRASHING = ("run", "motorway_cut_in_left", "--ego", "ego_samples:CrashingEgo", "--attempts", "3", "--out", "out")


@needs_fork
def test_a_candidate_in_which_sumo_crashes_twice_is_skipped(program: Program) -> None:
    """The run without an attack is the first visit to 6 s; the first attempt and its repetition are the next two."""
    (program.folder / "crashes").write_text("2 3")
    done = program(*CRASHING, "--json", "--until", "serious")
    assert done.status == 0 and done.err == ""
    first, *rest = done.outcome["attempts"]
    assert (first["ending"], first["feasible"]) == ("crashed", False)
    assert (
        "'crashing' ended the simulation process (killed by SIGSEGV, also when the simulation was" in first["message"]
    )
    assert rest and all(attempt["ending"] != "crashed" for attempt in rest)


@needs_fork
def test_where_every_attempt_crashes_the_run_says_so(program: Program) -> None:
    (program.folder / "crashes").write_text(" ".join(map(str, range(2, 50))))
    done = program(*CRASHING)
    assert done.status == 1 and len(done.err.splitlines()) == 1
    assert done.outcome["ending"] == "simulation_failed" and "SIGSEGV" in done.outcome["reason"]
    assert [a["ending"] for a in done.outcome["attempts"]] == ["crashed"] * 3
    assert lacking(done.folder) == set()


# -- attacked and unattacked


def test_before_the_trigger_nothing_differs(runs: Runs) -> None:
    for name in ("first", "braking", "krauss"):
        attacked, raw = tables(runs[name])
        trigger = runs[name].outcome["trigger_time"]
        assert attacked.keys() == raw.keys()
        assert [v for v in raw if differs_from(attacked, raw, v) <= trigger + 1e-6] == []
        assert differs_from(attacked, raw, parties(runs[name])[1]) < math.inf


FAR = """\
<routes>
  <vType id="car" vClass="passenger" sigma="0" speedDev="0" maxSpeed="28" lcKeepRight="0" lcSpeedGain="0"/>
  <route id="road" edges="eastbound"/>
  <vehicle id="ego" type="car" route="road" depart="0" departLane="1" departPos="600" departSpeed="28"/>
  <vehicle id="left" type="car" route="road" depart="0" departLane="2" departPos="620" departSpeed="28"/>
  <vehicle id="behind" type="car" route="road" depart="0" departLane="1" departPos="550" departSpeed="28"/>
  <vehicle id="far_ahead" type="car" route="road" depart="0" departLane="1" departPos="850" departSpeed="28"/>
  <vehicle id="far_behind" type="car" route="road" depart="0" departLane="2" departPos="200" departSpeed="28"/>
  <vehicle id="last" type="car" route="road" depart="0" departLane="1" departPos="120" departSpeed="28"/>
</routes>
"""
CONFIGURATION = '<configuration><net-file value="{}"/><route-files value="far.rou.xml"/></configuration>\n'


def test_far_vehicles_do_not_notice(program: Program, networks: Path) -> None:
    """A user's SUMO configuration on a motorway, with drivers that do not dawdle."""
    (program.folder / "far.rou.xml").write_text(FAR)
    (program.folder / "far.sumocfg").write_text(CONFIGURATION.format(networks / "motorway.net.xml"))
    options = ("--ego-id", "ego", "--trigger", "5", "--attempts", "3", "--until", "collision", "--out", "out")
    done = program("run", "far.sumocfg", *options)
    assert (done.status, done.err) == (0, "")
    attacked, raw = tables(done)
    pair = parties(done)
    assert differs_from(attacked, raw, pair[1]) < math.inf
    near = {v: min(apart(attacked, v, attacked, p) for p in pair) for v in attacked if v not in pair}
    unconcerned = {v for v, distance in near.items() if distance > NEVER_NEAR}
    assert unconcerned >= {"far_ahead", "far_behind", "last"}
    assert [v for v in unconcerned if differs_from(attacked, raw, v) < math.inf] == []
