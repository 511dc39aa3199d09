"""Records of another rate, or of a clock that jitters, come onto an even 10 Hz grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import womd_samples as samples

from sumo_adv.womd.reader import parse_record
from sumo_adv.womd.record import Record, evenly_sampled


def straight_at(times: Any) -> Record:
    """The ego of ``straight``, 1.2 m further in each step, with these time stamps."""
    message = samples.straight()
    for i, time in enumerate(times):
        message.timestamps_seconds[i] = time
    return parse_record(message, "a test")


def test_an_even_record_is_taken_as_it_is() -> None:
    """Also with a clock that is slow by half a per cent: 90 steps of 0.0995 s end 0.045 s early."""
    for step in (0.1, 0.0995):
        record = straight_at(step * np.arange(91))
        even, sampling = evenly_sampled(record)
        assert even is record and not sampling.resampled and sampling.sentence == ""


def test_half_the_rate_is_filled_in() -> None:
    """91 steps of 0.2 s last 18.0 s: 181 steps. Between 20.0 m and 21.2 m lies 20.6 m; step 10 is at 2.0 s."""
    even, sampling = evenly_sampled(straight_at(0.2 * np.arange(91)))
    assert (len(even.time), even.current, sampling.resampled) == (181, 20, True)
    assert even.tracks[0].x[:3] == pytest.approx([20.0, 20.6, 21.2])
    assert even.tracks[0].valid[:3].all() and len(even.signals) == 181
    late = even.tracks[2]  # first seen in step 15, which is at 3.0 s
    assert late.valid[29:32].tolist() == [False, True, True]


def test_a_late_step_is_moved_back() -> None:
    """Step 5 comes at 0.56 s, not at 0.5 s. The ego goes from 24.8 m at 0.4 s to 26.0 m at 0.56 s: 25.55 m at 0.5 s."""
    times = 0.1 * np.arange(91)
    times[5] = 0.56
    even, sampling = evenly_sampled(straight_at(times))
    assert sampling.sentence == (
        "resampled to 10 Hz: steps 0.100 s apart, uneven by up to 0.060 s, time stamps up to 0.060 s off"
    )
    assert even.tracks[0].x[[4, 5, 6]] == pytest.approx([24.8, 25.55, 27.2])
    assert np.diff(even.time) == pytest.approx(np.full(90, 0.1))


def test_a_long_gap_stays_a_gap() -> None:
    """The clock stops for 1 s after step 10: what happened in between is unknown."""
    times = 0.1 * np.arange(91) + np.where(np.arange(91) > 10, 1.0, 0.0)
    even, _ = evenly_sampled(straight_at(times))
    assert even.tracks[0].valid[9:23].tolist() == [True] * 2 + [False] * 10 + [True] * 2
    assert len(even.time) == 101


def test_headings_go_the_shorter_way() -> None:
    """From 3.1 rad to -3.1 rad it is 0.083 rad through pi, not 6.2 rad through 0."""
    message = samples.straight()
    for i, state in enumerate(message.tracks[0].states):
        message.timestamps_seconds[i] = 0.2 * i
        state.heading = 3.1 if i % 2 == 0 else -3.1
    even, _ = evenly_sampled(parse_record(message, "a test"))
    assert abs(even.tracks[0].heading[1]) == pytest.approx(math.pi)
