"""One simulation shared with a client: the ego's driver without it, what is kept, what a decision is worth later."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_samples import TESTS
from serve_samples import needs_sumo
from sumo_samples import make_spec, vehicle

from sumo_adv.config import load_settings
from sumo_adv.episode.traffic_forecast import traffic_forecast
from sumo_adv.geometry import Pose
from sumo_adv.serve import OnLoss, Options
from sumo_adv.serve.encounter import EncounterMonitor
from sumo_adv.serve.events import Events
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.session import KEPT_STATES_S, EgoLost, EgoPlan, Session, SessionPace
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import read_network

pytestmark = needs_sumo
ROUTE = EgoRoute(("eastbound",), 0.0, 0, 100.0, 15.0)
OTHERS = (vehicle("ahead", "eastbound", 1, 125.0, 15.0), vehicle("behind", "eastbound", 2, 20.0, 15.0))


class Case:
    """A session with an ego of its own on ``straight_3lane``, the events it told, and a client."""

    def __init__(self, folder: Path, gate: Gate, on_loss: OnLoss) -> None:
        self.told: list[dict[str, Any]] = []
        self.spec = make_spec(folder, "straight_3lane", OTHERS)
        events = Events(lambda e: self.told.append(dict(e)))
        plan = EgoPlan("ego", "calm", lambda: ROUTE)
        self.session = Session(self.spec, gate, Options(on_loss=on_loss), plan, events, lambda: None)
        self.gate = gate
        self.client: subprocess.Popen[str] | None = None

    def come(self) -> None:
        """A client that lets SUMO drive connects."""
        command = [sys.executable, str(TESTS / "serve_client.py"), str(self.gate.port)]
        self.client = subprocess.Popen(command, text=True)
        assert self.gate.wait_connected(20.0)

    def go(self) -> None:
        """The client is killed."""
        assert self.client is not None
        self.client.kill()
        self.client.wait()

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.session.tick()

    def speed(self) -> float:
        return self.session.snapshot.raw["ego"][3]


@contextmanager
def sharing(folder: Path, on_loss: OnLoss = OnLoss.SUMO) -> Iterator[Case]:
    with Gate() as gate:
        case = Case(folder, gate, on_loss)
        try:
            yield case
        finally:
            if case.client is not None:
                case.client.kill()
                case.client.wait()
            case.session.close()


def test_the_ego_departs_and_belongs_to_its_client(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(3)
        kinds = [(e["event"], e.get("state")) for e in case.told]
        assert kinds[:2] == [("simulation", "started"), ("ego", "departed")]
        owners = [e for e in case.told if e["event"] == "owners"][-1]
        assert (owners["client"], owners["adversary"], owners["sumo"]) == (["ego"], [], 2)
        assert case.session.ready(0.0) and not case.session.ready(10.0)
        assert case.gate.own == {"ego"}


def test_braking_in_its_stead(tmp_path: Path) -> None:
    with sharing(tmp_path, OnLoss.BRAKE) as case:
        case.come()
        case.steps(10)
        before = case.speed()
        case.go()
        case.steps(1)
        while not case.session.away:
            case.steps(1)
        at = case.speed()
        case.steps(10)
        assert before > 14.0 and case.speed() == pytest.approx(at - 4.5, abs=0.01)  # 1 s at 4.5 m/s2
        case.steps(40)
        assert case.speed() == 0.0
        case.come()
        case.steps(50)
        assert case.speed() > 3.0 and not case.session.away  # the client lets SUMO drive, which starts again


def test_sumo_in_its_stead(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(10)
        case.session.simulation.set_speed("ego", 3.0)  # what the client asked for last
        case.steps(30)
        assert case.speed() == pytest.approx(3.0, abs=0.3)
        case.go()
        while not case.session.away:
            case.steps(1)
        case.steps(50)
        assert case.speed() > 8.0


def test_its_loss_is_told_where_it_matters(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(5)
        case.session.attended = True
        case.go()
        with pytest.raises(EgoLost):
            case.steps(10)
        case.steps(5)  # told once


def test_an_ego_that_leaves_departs_again(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        left = lambda: [e for e in case.told if e["event"] == "ego"]  # noqa: E731
        while len(left()) < 3 and case.session.now < 200.0:
            case.steps(10)
        assert [e["state"] for e in left()] == ["departed", "left", "departed"]
        assert left()[2]["time"] - left()[1]["time"] <= 0.2


def test_old_states_are_dropped(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        most = 0
        for _ in range(70):
            case.steps(10)
            most = max(most, len(case.session.recording.snapshots))
        assert most <= 2 * KEPT_STATES_S / 0.1 and len(case.session.recording.snapshots) >= KEPT_STATES_S / 0.1
        there = {n for s in case.session.recording.snapshots for n in s.raw}
        assert set(case.session.simulation.fleet.sizes) == there


def test_a_client_may_have_subscribed_what_is_removed(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(3)
        case.session.simulation.api.vehicle.subscribe("ahead")  # SUMO has one list for all clients
        case.session.remove("ahead")
        case.steps(3)
        assert "ahead" not in case.session.snapshot.raw


def test_a_scene_that_went_as_foreseen_holds(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(30)
        road = read_network(case.spec.network)
        watch = EncounterMonitor(case.session, road, load_settings(None), (), 0.0)
        tracks = traffic_forecast(road, case.session, 5.0)
        case.steps(15)
        assert watch.changed(tracks, "ahead", "neighbour") == ""
        assert "no longer oncoming but neighbour" in watch.changed(tracks, "ahead", "oncoming")
        moved = {n: replace(t, x=t.x + 6.0) for n, t in tracks.items()}
        assert (
            watch.changed(moved, "ahead", "neighbour")
            == "ego is 6.0 m and 0.0 m/s from its predicted position and speed"
        )
        case.session.remove("ahead")
        case.steps(2)
        assert watch.changed(tracks, "ahead", "neighbour") == "ahead is gone"


def test_it_goes_on_where_it_was_put(tmp_path: Path) -> None:
    with sharing(tmp_path) as case:
        case.come()
        case.steps(20)
        x, y, angle, speed, _ = case.session.snapshot.raw["ahead"]
        case.session.tick({"ahead": Pose(x + 1.5 - 2.5, y + 0.4, math.radians(90.0 - angle), speed)})
        moved = case.session.snapshot.raw["ahead"]
        assert (moved[0], moved[1]) == pytest.approx((x + 1.5, y + 0.4), abs=1e-6)


def test_real_time_is_the_clocks() -> None:
    pace = SessionPace(0.02)
    began = time.monotonic()
    for _ in range(11):
        pace.wait()
    assert time.monotonic() - began >= 0.2 and pace.slips == 0  # the first step is due at once
    time.sleep(1.1)
    pace.wait()
    assert pace.slips == 1
