"""SUMO's options from any file: by long name, of their type, and none that writes; what SUMO reads writes nothing."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
from pathlib import Path

import pytest
from cli_samples import Program
from regression_samples import suite_in
from sumo_samples import make_spec, vehicle

from sumo_adv.errors import UsageError
from sumo_adv.simulation.given_options import OPTION_TYPES, check
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.scan import scan_demand, silent_copies
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_options import FORCED, OTHERS, only_shows, parse_options, refuse

SUMOS_TYPES = {"switch": "BOOL", "number": "FLOAT", "whole number": "INT", "time": "TIME", "text": "STR"}
NETWORK = data_folder("networks") / "signalised_crossing.net.xml"


def configured(folder: Path, options: str) -> Path:
    file = folder / "own.sumocfg"
    file.write_text(f'<configuration><net-file value="{NETWORK}"/>{options}</configuration>', encoding="utf-8")
    return file


def test_every_option_that_may_be_given_is_sumos_own_by_its_long_name_and_type(tmp_path: Path) -> None:
    """SUMO's template says of each option its type; that of a time that reads as a text there is a text's."""
    template = tmp_path / "template.xml"
    command = [str(find_sumo()), "--save-template", str(template), "--save-template.commented"]
    subprocess.run(command, check=True, capture_output=True)
    found = re.findall(r'<([\w.-]+) value="[^"]*"[^>]* type="(\w+)', template.read_text(encoding="utf-8"))
    types = dict(found)
    assert len(OPTION_TYPES) > 200
    texts = {"device.emissions.begin", "device.emissions.period"}
    assert {name for name, kind in OPTION_TYPES.items() if types.get(name) != SUMOS_TYPES[kind]} <= texts
    assert not {name for name in OPTION_TYPES if types[name] == "FILE"}
    assert {
        n for n in types if n not in OPTION_TYPES and n not in OTHERS and n not in FORCED and not only_shows(n)
    } == set()
    assert types.keys() >= OTHERS


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("ignore-route-errors", "--fcd-output=F", "takes a switch (true or false), and not '--fcd-output=F'"),
        ("scale", "--fcd-output=F", "takes a number, and not"),
        ("scale", "nan", "takes a number"),
        ("scale", "1e99", "takes a number"),
        ("max-num-vehicles", "2000000000", "takes a whole number"),
        ("time-to-teleport", "300 --log F", "takes a time"),
        ("pedestrian.model", "-l", "takes a text"),
        ("device.rerouting.explicit", "a\nb", "takes a text"),
        ("l", "F", "'l' is not one that can be given"),
        ("fcd-output", "F", "'fcd-output' is not one that can be given"),
        ("route", "F", "is not one that can be given"),
        ("pedestrian.jupedsim.wkt", "F", "is not one that can be given"),
        ("pedestrian.jupedsim.py", "F", "is not one that can be given"),
        ("device.rerouting.output", "F", "is not one that can be given"),
        ("device.rerouting.explicit", "${SUMO_ADV_LLM_API_KEY}", "takes a text"),
        ("device.rerouting.explicit", "~", "takes a text"),
        ("timetoteleport", "3", "the nearest is 'time-to-teleport'"),
    ],
)
def test_no_option_writes_or_has_another_option_as_its_value(name: str, value: str, says: str) -> None:
    with pytest.raises(UsageError, match=re.escape(says)):
        refuse({name: value})
    with pytest.raises(UsageError, match=re.escape(says)):
        SimulationSpec(NETWORK, (), (), 0.0, 1, options={name: value})


def test_values_of_their_type_are_passed_on() -> None:
    given = ["time-to-teleport=-1", "scale=2.5e-1", "step-method.ballistic=1", "time-to-impatience=0:03:00"]
    check(parse_options([*given, "pedestrian.model=striping", "max-num-vehicles=-1"]))
    spec = SimulationSpec(NETWORK, (), (), 0.0, 1, options=parse_options(given))
    assert "--time-to-teleport=-1" in spec.arguments()
    simulation = Simulation(spec)
    try:
        assert simulation.api.simulation.getOption("time-to-teleport") == "-1"
        assert simulation.api.simulation.getOption("step-method.ballistic") == "1"
    finally:
        simulation.close()


@pytest.mark.parametrize("option", ['<l value="w.xml"/>', '<pedestrian.jupedsim.py value="w.py"/>'])
def test_a_sumocfg_does_not_have_sumo_write(program: Program, option: str) -> None:
    configured(program.folder, option)
    done = program.here("run", "own.sumocfg", "--end", "2", "--out", "out")
    assert "is not kept" in done.out or "Not kept of own.sumocfg" in done.out
    assert not list(program.folder.rglob("w.*"))


def test_a_sumocfg_with_an_option_for_a_value_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="takes a switch"):
        load_input(configured(tmp_path, '<ignore-route-errors value="--fcd-output=F"/>'))


SPY = """<vType id="spy">
  <param key="has.ssm.device" value="true"/><param key="device.ssm.file" value="{log}"/>
</vType>"""
"""A type whose vehicles have SUMO write."""


def test_doctor_does_not_have_sumo_write(program: Program) -> None:
    """It starts the program ``sumo`` with options that a run does not keep: a switch whose value is another option, and
    a state whose vehicles would write."""
    trip = '<trip id="{name}" type="{kind}" depart="0" from="west_in" to="east_out"/>'
    folder, log = program.folder, program.folder / "F"
    (folder / "spy.rou.xml").write_text(f"<routes>{SPY.format(log='G')}{trip.format(name='s', kind='spy')}</routes>")
    state = ("--save-state.times", "2", "--save-state.files", "state.xml", "--end", "3")
    subprocess.run([find_sumo(), "-n", NETWORK, "-r", "spy.rou.xml", *state], cwd=folder, check=True)
    file = folder / "state.xml"
    assert file.read_text().count('"G"') == 1 and (folder / "G").is_file()
    file.write_text(file.read_text().replace('"G"', f'"{log}"'))
    (folder / "r.rou.xml").write_text(f"<routes>{trip.format(name='v', kind='DEFAULT_VEHTYPE')}</routes>")
    routes = '<route-files value="r.rou.xml"/><step-length value="0.1"/>'
    for option in (f'<mesosim value="--tripinfo-output={log}"/>', '<load-state value="state.xml"/><begin value="2"/>'):
        program.here("doctor", str(configured(folder, routes + option)), "--seconds", "2")
        assert not log.exists()


def test_a_manifest_does_not_have_sumo_write(program: Program) -> None:
    done = program.here("run", "motorway_cut_in_left", "--attempts", "1", "--until", "critical", "--out", "out")
    assert done.outcome["attempts"]
    file = program.folder / "out" / "manifest.json"
    manifest = json.loads(file.read_text(encoding="utf-8"))
    manifest["sumo_options"]["ignore-route-errors"] = f"--fcd-output={program.folder / 'F'}"
    file.write_text(json.dumps(manifest), encoding="utf-8")
    for command in (("run", "--replay", "out", "--out", "again"), ("minimise", "out", "--out", "again")):
        done = program.here(*command)
        assert done.status == 2
        assert "'ignore-route-errors' takes a switch" in done.err
    assert not (program.folder / "F").exists()


@pytest.mark.parametrize("kind", ["network", "routes"])
def test_the_files_of_a_run_folder_do_not_have_sumo_write(program: Program, kind: str) -> None:
    """A stranger's folder: the types of its demand have a device that writes, its lights log, the hashes are right."""
    done = program.here("run", "signals_red_light", "--attempts", "1", "--until", "critical", "--out", "out")
    assert done.outcome["attempts"]
    log, file = program.folder / "F", program.folder / "out" / "manifest.json"
    manifest = json.loads(file.read_text(encoding="utf-8"))
    named = manifest[kind] if kind == "network" else manifest[kind][0]
    inputs = program.folder / "out" / "inputs"
    text = (inputs / named).read_text(encoding="utf-8")
    spying = SPY.format(log=log).partition("\n")[2].partition("\n")[0]
    changed = {
        "network": re.sub(r"<phase.*?(?=</tlLogic>)", SWARM.format(log=log), text, flags=re.DOTALL).replace(
            'type="static" programID', 'type="swarm" programID'
        ),
        "routes": re.sub(r"(<vType [^>]*?)/>", rf"\1>{spying}</vType>", text),
    }[kind]
    assert str(log) in changed
    (inputs / named).write_text(changed, encoding="utf-8")
    digest = hashlib.sha256(changed.encode()).hexdigest()[:12]
    renamed = (inputs / named).rename(inputs / f"{digest}{named[12:]}").name
    manifest[kind] = renamed if kind == "network" else [renamed]
    file.write_text(json.dumps(manifest), encoding="utf-8")
    program.here("run", "--replay", "out", "--out", "again")
    assert not log.exists()


@pytest.mark.parametrize("line", ['"ignore-route-errors" = "--fcd-output=F"', '"l" = "F"', '"fcd-output" = "F"'])
def test_a_case_does_not_have_sumo_write(program: Program, line: str) -> None:
    file = suite_in(program.folder, "a") / "a" / "case.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("[settings]", f"[settings.sumo_options]\n{line}\n[settings]"), encoding="utf-8")
    done = program.here("regress", "suite", "--ego", "idm", "--out", "out")
    assert done.status == 2
    assert "SUMO's option" in done.err
    assert not list(program.folder.rglob("F"))


SWARM = """<param key="SWARMLOG" value="{log}"/>
  <phase duration="9" minDur="5" maxDur="9" type="target;decisional" targetLanes="west_in_0" state="rrrrGGGgrrrrGGGg"/>
  <phase duration="4" type="commit" state="rrrryyyyrrrryyyy"/>
  <phase duration="2" type="transient" state="rrrrrrrrrrrrrrrr"/>
  <phase duration="9" minDur="5" maxDur="9" type="target;decisional" targetLanes="north_in_0" state="GGGgrrrrGGGgrrrr"/>
  <phase duration="4" type="transient" state="yyyyrrrryyyyrrrr"/>
  <phase duration="2" type="transient" state="rrrrrrrrrrrrrrrr"/>"""


def test_a_light_that_logs_writes_nothing(tmp_path: Path) -> None:
    """SUMO's swarm lights open the file that their parameter SWARMLOG names."""
    log = tmp_path / "swarm.log"
    text = NETWORK.read_text(encoding="utf-8").replace('type="static" programID', 'type="swarm" programID')
    own = tmp_path / "swarm.net.xml"
    own.write_text(re.sub(r"<phase.*?(?=</tlLogic>)", SWARM.format(log=log), text, flags=re.DOTALL), encoding="utf-8")
    command = [str(find_sumo()), "--end", "2", "--no-step-log", "-n"]
    subprocess.run([*command, str(own)], check=True, capture_output=True)
    assert log.exists()
    log.unlink()
    (copy,) = silent_copies([own], tmp_path)
    subprocess.run([*command, str(copy)], check=True, capture_output=True, cwd=tmp_path)
    assert not log.exists()


def test_elements_of_another_file_do_not_hide_behind_an_entity(tmp_path: Path) -> None:
    """SUMO's reader loads external entities; ours does not, so it would miss the detector."""
    hidden = tmp_path / "hidden.xml"
    hidden.write_text(f'<edgeData id="e" file="{tmp_path / "written.xml"}"/>', encoding="utf-8")
    file = tmp_path / "a.add.xml"
    declared = f'<!DOCTYPE additional [<!ENTITY x SYSTEM "{hidden}">]>'
    file.write_text(f"{declared}<additional>&x;</additional>", encoding="utf-8")
    with pytest.raises(UsageError, match="has a document type with declarations"):
        scan_demand(file)
    with pytest.raises(UsageError, match="has a document type with declarations"):
        silent_copies([file], tmp_path)


def test_a_file_that_sumo_cannot_be_told_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """SUMO parts a list of files at commas."""
    home = tmp_path / "a,b"
    home.mkdir()
    with pytest.raises(UsageError, match=r"SUMO cannot open a file with the name '.*a,b.*': rename it"):
        make_spec(home, "signalised_crossing", [vehicle("east", "west_in east_out", 1, 20.0, 8.0)])
    with pytest.raises(UsageError, match="SUMO cannot open a file with the name"):
        SimulationSpec(tmp_path / "\udce9.net.xml", (), (), 0.0, 1)


def test_sumo_reads_no_other_file_than_was_checked(program: Program) -> None:
    """SUMO puts in variables on its command line: it would read ``spy.rou.xml`` and write where that says."""
    trip = '<trip id="s" {of} depart="0" from="west_in" to="east_out"/>'
    log = program.folder / "F"
    for name, text in (("spy", SPY.format(log=log) + trip.format(of='type="spy"')), ("${NONE}spy", trip.format(of=""))):
        (program.folder / f"{name}.rou.xml").write_text(f"<routes>{text}</routes>", encoding="utf-8")
    named = f'schema = 1\nnetwork = "{NETWORK}"\n[demand]\nfiles = ["${{NONE}}spy.rou.xml"]\n'
    (program.folder / "s.toml").write_text(named, encoding="utf-8")
    done = program.here("run", "s.toml", "--end", "2", "--out", "out")
    assert (done.status, log.exists()) == (2, False)
    assert "SUMO cannot open a file with the name" in done.err
    for place in ("~/a.net.xml", "${HOME}.net.xml"):
        with pytest.raises(UsageError, match="SUMO cannot open a file with the name"):
            SimulationSpec(Path(place), (), (), 0.0, 1)
