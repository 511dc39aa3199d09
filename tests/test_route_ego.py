"""An ego that the scenario inserts by its route, by fork and by load-and-repeat."""

from pathlib import Path

from cli_samples import Program

SCENARIO = """
schema = 1
network = "{network}"
[demand]
files = ["{demand}"]
[ego]
route = ["eastbound"]
depart = 0.5
lane = 1
position = 60.0
speed = 14.0
[window]
trigger = 5.0
"""
ROOT = Path(__file__).resolve().parent.parent


def test_both_ways_give_the_same_states(program: Program) -> None:
    network, demand = ROOT / "networks" / "straight_3lane.net.xml", program.folder / "cars.rou.xml"
    cars = [(f"c{k}", 20 + 45 * k, k % 3) for k in range(5)]
    vehicles = "".join(
        f'<vehicle id="{n}" type="car" depart="0" departPos="{x}" departLane="{lane}" departSpeed="13" route="r"/>'
        for n, x, lane in cars
    )
    kind = '<vType id="car" sigma="0.5" speedDev="0" maxSpeed="14"/>'
    demand.write_text(f'<routes>{kind}<route id="r" edges="eastbound"/>{vehicles}</routes>')
    scenario = program.folder / "routed.toml"
    scenario.write_text(SCENARIO.format(network=network, demand=demand))
    for name, options in (("forked", ()), ("loaded", ("--no-fork",))):
        done = program.here(
            "run", "routed.toml", "--attempts", "3", "--learn", "off", "--out", name, "--json", *options
        )
        assert done.status == 0, done.err
    for file in ("states.csv.gz", "raw.csv.gz", "criticality.csv.gz"):
        assert (program.folder / "forked" / file).read_bytes() == (program.folder / "loaded" / file).read_bytes()
