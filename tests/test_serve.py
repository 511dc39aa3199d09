"""``serve`` from a new user's hand: the real program, the real SUMO, and a real client in a process of its own."""

from __future__ import annotations

import json
import signal
import socket
import urllib.error
import urllib.request
from typing import Any

import pytest
from cli_samples import TESTS, Program, lacking, read_states
from serve_samples import needs_sumo, serving

CLIENT = TESTS / "serve_client.py"
FILES = {"outcome.json", "manifest.json", "states.csv.gz", "criticality.csv.gz", "encounter.png", "inputs"}
pytestmark = needs_sumo


def asked(port: int, path: str) -> tuple[int, dict[str, Any]]:
    """What the status page answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5.0) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_two_terminals_and_one_critical_encounter(program: Program) -> None:
    with serving(program, "straight_3lane", "--encounters", "2", "--json", "--status-port", "0") as server:
        page = server.wait("status_page")["port"]
        assert asked(page, "/health") == (200, {"status": "ok"})
        assert asked(page, "/status")[1]["client"] == "away"
        assert asked(page, "/nothing")[0] == 404
        seen = program.folder / "seen.jsonl"
        client = server.client(CLIENT, str(seen))
        server.wait("outcome")
        code, status = asked(page, "/status")
        assert code == 200 and status["client"] == "connected" and status["encounters"] == 1
        assert status["outcomes"][0]["number"] == 1 and status["time"] > 20.0
        code, out, err = server.end()
        assert (code, err) == (0, "")
        summary = json.loads(out)
        outcomes = server.outcomes()
        assert summary["encounters"] == len(outcomes) == 2 and summary["ending"] is None
        assert summary["critical"] == sum(o["ending"] == "critical" for o in outcomes) >= 1
        for number, outcome in enumerate(outcomes, 1):
            folder = program.folder / "out" / f"encounter-{number:04d}"
            assert lacking(folder, FILES) == set() and not (folder / "raw.csv.gz").exists()
            assert outcome["ego"] == {"id": "ego", "controller": "external"} and outcome["raw"] is None
            assert len(outcome["attempts"]) == 1
            states = read_states(folder / "states.csv.gz")
            adversary = outcome["adversaries"][0]["id"]
            roles = {name: {row["role"] for row in rows.values()} for name, rows in states.items()}
            assert {n: r for n, r in roles.items() if r != {"background"}} == {"ego": {"ego"}, adversary: {"adversary"}}
        owners = server.events("owners")
        assert [e for e in owners if e["client"] == ["ego"] and e["adversary"] == [outcomes[0]["adversaries"][0]["id"]]]
        assert [e["event"] for e in server.events()][-2:] != [] and server.events("stopped")[0]["encounters"] == 2
        ended = server.events("simulation")[-1]
        assert ended["state"] == "ended" and 0 <= ended["steps"] - ended["client_steps"] <= 1
        assert server.simulators() == []
        client.wait()
        (row,) = [json.loads(line) for line in seen.read_text().splitlines()]  # times of both sides are one
        assert row["last"] - row["first"] == pytest.approx(0.1 * (row["steps"] - 1))
        assert row["last"] == pytest.approx(ended["time"], abs=0.11)
    done = program.here("memory", "list", "--json", "--memory", "bank.sqlite")
    evidence = sum(entry["evidence"] for entry in json.loads(done.out)["intents"])
    assert evidence >= sum(o["learnt"] for o in outcomes) >= 1  # what was critical is remembered


def test_the_same_encounter_again_until_the_collision_is_valid(program: Program) -> None:
    settings = program.folder / "off.toml"
    settings.write_text('tuner = "off"\n')  # it finds a valid attempt at once
    arguments = ("two_way", "--mode", "episodes", "--encounters", "1", "--until", "valid", "--seed", "1")
    with serving(program, *arguments, "--attempts", "12", "--settings", settings) as server:
        server.client()
        code, out, _ = server.end()
        (outcome,) = server.outcomes()
        assert code == 0 and "Encounter 1" in out
        attempts = outcome["attempts"]
        assert outcome["ending"] == "critical" and outcome["outcome"]["valid"] and len(attempts) > 1
        assert outcome["best"] == len(attempts) - 1
        assert outcome["outcome"]["cause"]["sentence"]  # against the foreseen motion without the attack
        started = [e for e in server.events("simulation") if e["state"] == "started"]
        assert len(started) == len(attempts) and {e["seed"] for e in started} == {1}
        delays = {round(a["trigger_time"] - outcome["encounter"]["time"], 3) for a in attempts}
        assert delays <= {0.0, 1.5, 3.0}
        came = [e["again"] for e in server.events("client") if e["state"] == "connected"]
        assert came[0] is False and came[1 : len(attempts)] == [True] * (len(attempts) - 1)


@pytest.mark.parametrize(
    ("policy", "status"), [("sumo", 0), pytest.param("brake", 0, marks=pytest.mark.soak), ("end", 1)]
)
def test_a_client_that_is_killed_costs_one_encounter(program: Program, policy: str, status: int) -> None:
    with serving(program, "straight_3lane", "--encounters", "2", "--on-loss", policy) as server:
        first = server.client()
        server.wait("attack")
        first.kill()
        server.wait("client", after=lambda e: e["state"] == "lost")
        if policy != "end":
            server.client()
        code, _, err = server.end()
        outcomes = server.outcomes()
        assert code == status and outcomes[0]["ending"] == "ego_lost"
        assert outcomes[0]["attempts"][0]["ending"] == "ego_lost" and not outcomes[0]["learnt"]
        assert server.wait("released")["how"] == "driven on by SUMO"
        assert len(outcomes) == (1 if policy == "end" else 2)
        assert err == ("" if status == 0 else "sumo-adv: The ego's client was lost or late, and --on-loss is end.\n")
        assert server.simulators() == []


@pytest.mark.parametrize(
    "ask", [pytest.param("step(1e3)", marks=pytest.mark.soak), "step(0.0) * 3000"], ids=["to a time", "one by one"]
)
def test_a_client_that_asks_for_very_many_steps_and_vanishes_is_lost(program: Program, ask: str) -> None:
    """In the middle of an attack: it never ends with a contact without a driver of the ego."""
    flag, script = program.folder / "attack", program.folder / "vanishing.py"
    script.write_text(
        "import os, struct, sys, traci\n"
        "client = traci.connect(int(sys.argv[1]), host='127.0.0.1')\n"
        "step = lambda until: struct.pack('!BBd', 10, 2, until)\n"
        f"while not os.path.exists({str(flag)!r}): client.simulationStep()\n"
        f"steps = {ask}\n"
        "client._socket.sendall(struct.pack('!i', 4 + len(steps)) + steps)\nos._exit(1)\n"
    )
    with serving(program, "straight_3lane", "--encounters", "1") as server:
        server.client(script)
        server.wait("attack")
        flag.touch()
        server.wait("client", after=lambda e: e["state"] == "lost")
        assert server.end()[0] == 0
        (outcome,) = server.outcomes()
        assert outcome["ending"] == outcome["attempts"][0]["ending"] == "ego_lost" and not outcome["learnt"]


def test_a_client_that_hangs_is_late(program: Program) -> None:
    with serving(program, "straight_3lane", "--encounters", "1", "--deadline", "0.5") as server:
        flag = program.folder / "hang"
        server.client(CLIENT, "", str(flag))
        server.wait("attack")
        flag.touch()
        late = server.wait("client", after=lambda e: e["state"] == "late")
        assert "took more than 0.5 s" in late["sentence"]
        assert server.end()[0] == 0 and server.simulators() == []
        assert [o["ending"] for o in server.outcomes()] == ["ego_lost"]


def test_an_end_from_outside_leaves_whole_files_and_no_sumo(program: Program) -> None:
    with serving(program, "straight_3lane") as server:
        server.client()
        server.wait("attack", 2)
        server.process.send_signal(signal.SIGTERM)  # the next story has Ctrl-C
        code, out, err = server.end()
        assert (code, err) == (0, "") and "Encounters: 2" in out
        outcomes = server.outcomes()
        assert [o["ending"] for o in outcomes][1] == "interrupted"
        summary = json.loads((program.folder / "out" / "serve.json").read_text())["summary"]
        assert summary["ending"] == "interrupted" and summary["encounters"] == 2
        assert sorted(p.name for p in (program.folder / "out").iterdir() if p.name.startswith(".")) == []
        assert server.simulators() == [] and list(program.temporary.iterdir()) == []


def test_ctrl_c_before_anybody_came(program: Program) -> None:
    with serving(program, "straight_3lane", "--encounters", "1") as server:
        server.wait("simulation")
        server.interrupt()
        code, _, err = server.end()
        assert (code, err) == (1, "sumo-adv: Ctrl-C.\n") and server.outcomes() == [] and server.simulators() == []


def test_nobody_comes(program: Program) -> None:
    with serving(program, "straight_3lane", "--encounters", "1", "--patience", "0.3") as server:
        code, _, err = server.end()
        port = server.events("listening")[0]["port"]
        assert (code, err) == (1, f"sumo-adv: No client came to port {port} within 0.3 s.\n")


def test_an_ego_of_the_demand(program: Program) -> None:
    with serving(program, "motorway_cut_in_left", "--encounters", "1") as server:
        server.client()
        code, _, _ = server.end()
        (outcome,) = server.outcomes()
        assert code == 0 and outcome["encounter"]["time"] == 5.0 and len(outcome["attempts"]) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nowhere",), "There is no file nowhere, nor a shipped scenario or network of that name."),
        (("straight_3lane", "--host", "0.0.0.0"), "TraCI has no log-in"),
        (("straight_3lane", "--ego-id", "nobody", "--density", "5", "--end", "20"), "nobody"),
        (("straight_3lane", "--events", "none/at/all"), "events file none/at/all cannot be written"),
    ],
)
def test_wrong_use_is_one_sentence(program: Program, arguments: tuple[str, ...], sentence: str) -> None:
    start = program if "nobody" in arguments else program.here  # that one needs SUMO
    done = start("serve", *arguments, "--port", "0", "--out", "out", "--memory", "b.sqlite", "--patience", "0.2")
    assert done.status in (1, 2) and done.err.startswith("sumo-adv: ") and done.err.count("\n") == 1
    assert "Traceback" not in done.err
    if "nobody" not in arguments:
        assert done.status == 2 and sentence in done.err


def test_a_port_in_use(program: Program) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = program.here("serve", "straight_3lane", "--port", port, "--out", "out", "--memory", "bank.sqlite")
        assert done.status == 2 and port in done.err and done.err.count("\n") == 1
        assert not done.folder.exists()
        done = program.here("serve", "straight_3lane", "--port", "0", "--status-port", port, "--memory", "bank.sqlite")
        assert done.status == 2 and "status port" in done.err


def test_a_folder_is_not_overwritten(program: Program) -> None:
    arguments = ("serve", "straight_3lane", "--port", "0", "--out", "out", "--patience", "0.1", "--memory", "b.sqlite")
    assert program.here(*arguments).status == 1
    assert "already exists" in program.here(*arguments).err
    assert program.here(*arguments, "--force").status == 1
    (program.folder / "out" / "serve.json").unlink()
    (program.folder / "out" / "other").write_text("mine")
    done = program.here(*arguments, "--force")
    assert done.status == 2 and "not the folder of a server" in done.err


def test_a_bridge_that_adds_and_moves_its_own_ego(program: Program) -> None:
    with serving(program, "straight_3lane", "--ego-id", "carla0", "--encounters", "2") as server:
        assert server.wait("listening")["added"]
        server.client(TESTS / "serve_bridge.py")
        code, out, err = server.end()
        assert (code, err) == (0, "") and "'carla0': your program must add it" in out
        assert server.events("client")[0]["state"] == "connected" and not server.events("dropped")
        for outcome in server.outcomes():
            assert outcome["ego"]["id"] == "carla0" and outcome["attempts"][0]["ending"] != "ego_left"
        states = read_states(program.folder / "out" / "encounter-0001" / "states.csv.gz")["carla0"]
        speeds = [float(row["speed"]) for row in states.values()]
        assert sorted(speeds)[len(speeds) // 2] == pytest.approx(14.0, abs=0.1)  # SUMO itself says another one
        assert {row["length"] for row in states.values()} == {"4.70"}
        assert server.simulators() == []
