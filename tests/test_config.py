"""Settings: where they come from, and what does not fit together."""

from pathlib import Path

import pytest

from sumo_adv.config import load_settings
from sumo_adv.errors import UsageError


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("attempts = 7\ncritical_ttc = 2.0\n[limits]\njerk = 10.0\n")
    settings = load_settings(file, attempts=3, seed=None)
    assert (settings.attempts, settings.critical_ttc, settings.seed, settings.limits.jerk) == (3, 2.0, 0, 10.0)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"step_length": 0.5, "replan": 0.1}, "replan is shorter than a step of 0.5 s"),
        ({"delays": ()}, "delays needs at least one time"),
        ({"delays": (-3.0,)}, "no time may be negative"),
        ({"attempts": 0}, "attempts"),
        ({"trigger": -1.0}, "trigger"),
        ({"file": "x"}, "'file'"),
    ],
)
def test_what_does_not_fit_is_one_sentence(given: dict[str, object], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        load_settings(None, **given)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        load_settings(tmp_path / "none.toml")
