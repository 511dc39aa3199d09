"""``attempts.csv.gz`` has a row for each attempt of a run."""

from pathlib import Path

import pandas as pd

import sumo_adv


def test_each_attempt_is_a_row(tmp_path: Path) -> None:
    """Three attempts by a follower come to no serious collision; all three are there, as in ``outcome.json``."""
    result = sumo_adv.run(
        "follower_closes_up", until="serious", learn="off", attempts=3, total_seconds=0, out=tmp_path / "run"
    )
    table, listed = pd.read_csv(tmp_path / "run" / "attempts.csv.gz"), result.outcome.document["attempts"]
    assert table["attempt"].tolist() == [1, 2, 3]
    assert set(table["encounter"]) == {result.outcome.document["encounter"]["time"]}
    assert table["level"].tolist() == [a["level"] for a in listed]
    assert table["intent"].tolist() == [a["intent"] for a in listed]
