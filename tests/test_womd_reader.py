"""The reader of Waymo records: framing, choosing, what a record becomes, and every sentence about a bad one."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from womd_samples import (
    WITH_MAP,
    empty,
    four_way,
    frame,
    merge,
    no_map,
    overpass,
    straight,
    write,
)  # fmt: skip

from sumo_adv.errors import UsageError
from sumo_adv.womd import scenario_pb2
from sumo_adv.womd.framing import crc32c, masked_crc, read_frames
from sumo_adv.womd.reader import ALL_RECORDS, RecordChoice, read_records
from sumo_adv.womd.record import Record

SHARED = Path(__file__).parents[2] / "shared" / "womd"
PROTO = Path(scenario_pb2.__file__).with_name("scenario.proto")


def one(path: Path) -> Record:
    (record,) = read_records(path)
    return record


def test_crc32c_of_the_standard_check_string() -> None:
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(b"") == 0
    assert crc32c(bytes(32)) == 0x8A9136AA  # RFC 3720, B.4
    assert crc32c(bytes(range(32))) == 0x46DD794E


@settings(deadline=None, max_examples=30)
@given(st.binary(max_size=64), st.integers(1, 12_000))
def test_long_data_have_the_checksum_of_the_plain_loop(seed: bytes, size: int) -> None:
    data = (seed + b"waymo") * (size // (len(seed) + 5) + 1)
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register >> 1) ^ (0x82F63B78 if register & 1 else 0)
    assert crc32c(data) == register ^ 0xFFFFFFFF


def test_the_proto_and_the_compiled_module_agree() -> None:
    """Every message, field, number, label and enum value of the text is in the descriptor, and nothing else."""
    text = re.sub(r"//.*", "", PROTO.read_text(encoding="utf-8"))
    fields = set(re.findall(r"([A-Za-z0-9_.]+) ([a-z_]+) = (\d+)(?: \[packed = true\])?;", text))
    values = set(re.findall(r"\b([A-Z][A-Z0-9_]+) = (\d+);", text))
    kinds = {1: "double", 2: "float", 3: "int64", 5: "int32", 8: "bool", 9: "string"}
    compiled, enums = set(), set()
    for message in scenario_pb2.DESCRIPTOR.message_types_by_name.values():
        for field in message.fields:
            named = field.message_type or field.enum_type
            compiled.add((named.name if named else kinds[field.type], field.name, str(field.number)))
        enums |= {(v.name, str(v.number)) for e in message.enum_types for v in e.values}
    assert {(kind.rpartition(".")[2], *rest) for kind, *rest in fields} == compiled
    assert values == enums


def test_a_record_becomes_arrays(tmp_path: Path) -> None:
    record = one(write(tmp_path / "a.tfrecord", straight()))
    assert (record.scenario_id, record.current, record.sdc, len(record.time)) == ("straight", 10, 0, 91)
    assert record.lanes[11].points.shape == (601, 3)
    assert record.lanes[12].speed_limit == pytest.approx(13.4112)
    assert record.lanes[12].left[0].lane == 11
    assert record.lines[21].edge and not record.lines[23].edge
    assert record.objects_of_interest == (1, 3) and record.to_predict == (2,)
    late = record.tracks[2]
    assert list(np.flatnonzero(late.valid)[:1]) == [15]
    assert late.x[15] == pytest.approx(5.0 + 14.0 * 1.5)  # from station 5 m at 14 m/s


def test_signals_signs_and_areas(tmp_path: Path) -> None:
    record = one(write(tmp_path / "a.tfrecord", four_way()))
    assert len(record.signals) == 91 and len(record.signals[0]) == 12
    states = [{s.lane: s.state for s in step} for step in record.signals]
    assert (states[0][331], states[45][331], states[60][331], states[60][302]) == (6, 5, 4, 6)
    stop = next(s.stop for s in record.signals[0] if s.lane == 331)
    assert stop is not None and stop == pytest.approx([1.75, -14.0, 0.0])
    assert record.stop_signs[0].lanes == (101,)
    assert [(a.kind, len(a.points)) for a in record.areas] == [("crosswalk", 4)]


def test_choosing_by_id_index_and_number(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tfrecord", straight(), four_way(), overpass(), merge())
    ids = [[r.scenario_id for r in read_records(path, choice)] for choice in (
        ALL_RECORDS, RecordChoice(id="overpass"), RecordChoice(index=3), RecordChoice(first=2),
    )]  # fmt: skip
    assert ids == [
        ["straight", "four_way", "overpass", "merge"], ["overpass"], ["merge"], ["straight", "four_way"],
    ]  # fmt: skip


def test_records_are_read_as_they_are_asked_for(tmp_path: Path) -> None:
    """The second record is broken, which matters only when it is its turn."""
    path = write(tmp_path / "a.tfrecord", straight())
    path.write_bytes(path.read_bytes() + b"broken")
    records = read_records(path)
    assert next(records).scenario_id == "straight"
    with pytest.raises(UsageError, match=r"Record 1 of .*a\.tfrecord is cut short"):
        next(records)


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        (RecordChoice(id="nowhere"), "has no record 'nowhere' among its 1"),
        (RecordChoice(index=4), "has no record 4: it has 1"),
    ],
)
def test_a_record_that_is_not_there(tmp_path: Path, choice: RecordChoice, sentence: str) -> None:
    path = write(tmp_path / "a.tfrecord", straight())
    with pytest.raises(UsageError, match=sentence):
        list(read_records(path, choice))


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "empty.tfrecord").touch()
    with pytest.raises(UsageError, match="holds no record: it is empty"):
        list(read_records(tmp_path / "empty.tfrecord"))
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        list(read_records(tmp_path / "none.tfrecord"))
    (tmp_path / "text.tfrecord").write_text("this is a text of more than twelve bytes")
    with pytest.raises(UsageError, match=r"Record 0 of .*text\.tfrecord has a damaged length"):
        list(read_records(tmp_path / "text.tfrecord"))


def bad(change: str) -> bytes:
    message = straight()
    if change == "no id":
        message.ClearField("scenario_id")
    elif change == "folder id":
        message.scenario_id = "../up"
    elif change == "no time":
        message.ClearField("timestamps_seconds")
    elif change == "time runs back":
        message.timestamps_seconds[5] = 0.0
    elif change == "no current":
        message.ClearField("current_time_index")
    elif change == "current beyond":
        message.current_time_index = 91
    elif change == "no ego":
        message.sdc_track_index = 99
    elif change == "no map":
        message = no_map()
    elif change == "few states":
        del message.tracks[1].states[50:]
    elif change == "two of one id":
        message.tracks[1].id = 1
    elif change == "nan":
        message.map_features[0].lane.polyline[3].x = float("nan")
    elif change == "a point at 1e8 m":
        message.map_features[0].lane.polyline[3].x = 1e8
    elif change == "a point 30 km off":
        message.map_features[0].lane.polyline[3].x = 30_000.0
    elif change == "an object 30 km off":
        message.tracks[1].states[7].center_y = -30_000.0
    elif change == "to and fro":
        for k, place in enumerate(message.map_features[0].lane.polyline):
            place.x = 9_000.0 * (-1) ** k
    elif change == "20,000 tracks":
        message.tracks.extend([message.tracks[0]] * 20_000)
    elif change == "a year":
        message.timestamps_seconds[90] = 3.2e7
    return message.SerializeToString()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("no id", "is not a scenario: it has no id or no time stamps"),
        ("no time", "is not a scenario"),
        ("folder id", "cannot be the name of a folder"),
        ("time runs back", "time stamps that do not increase"),
        ("no current", "has no current step"),
        ("current beyond", "has no current step"),
        ("no ego", "has no ego"),
        ("no map", "has no map"),
        ("few states", r"has 50 states for its track 2, not one a step \(91\)"),
        ("20,000 tracks", "tracks, more than the 5,000 that are read"),
        ("two of one id", "two tracks of the same id"),
        ("nan", "a map point that is not a finite number"),
        ("a point at 1e8 m", r"a map point 1e\+08 m from the origin"),
        ("a point 30 km off", "a map point 30.* km from another place"),
        ("an object 30 km off", "a position of an object 30.* km from another place"),
        ("to and fro", "km of lines, more than the 500 that are read"),
        ("a year", r"spans 3.2e\+07 s, more than the 3600 s that are read"),
    ],
)
def test_a_bad_record_is_one_sentence_and_can_be_passed_over(tmp_path: Path, change: str, sentence: str) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(frame(four_way().SerializeToString()) + frame(bad(change)) + frame(merge().SerializeToString()))
    with pytest.raises(UsageError, match=rf"Record 1 of .*a\.tfrecord.*{sentence}") as raised:
        list(read_records(path))
    errors: list[UsageError] = []
    assert [r.scenario_id for r in read_records(path, told=errors.append)] == ["four_way", "merge"]
    assert [str(error) for error in errors] == [str(raised.value)]


def test_a_wrong_checksum_spoils_its_record_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tfrecord", straight(), four_way())
    data = bytearray(path.read_bytes())
    data[5000] ^= 1
    path.write_bytes(bytes(data))
    errors: list[UsageError] = []
    assert [r.scenario_id for r in read_records(path, told=errors.append)] == ["four_way"]
    assert "Record 0 of" in str(errors[0]) and "its checksum is wrong" in str(errors[0])


def test_another_message_is_no_scenario(tmp_path: Path) -> None:
    """A tf.Example begins with a message where a Scenario has its time stamps."""
    path = tmp_path / "a.tfrecord"
    path.write_bytes(frame(b"\x0a\x0d\x0a\x0b\x0a\x03key\x12\x04\x1a\x02\x0a\x00"))
    with pytest.raises(UsageError, match=r"Record 0 of .* is not a Scenario message"):
        list(read_records(path))
    path.write_bytes(frame(b""))
    with pytest.raises(UsageError, match=r"Record 0 of .* is not a scenario"):
        list(read_records(path))


def test_a_length_beyond_reason_is_not_read() -> None:
    length = (1 << 40).to_bytes(8, "little")
    data = io.BytesIO(length + masked_crc(length).to_bytes(4, "little") + b"x")
    with pytest.raises(UsageError, match="would be 1099511627776 bytes long"):
        list(read_frames(data, "a.tfrecord"))


def test_states_that_make_no_sense_are_not_valid(tmp_path: Path) -> None:
    message = straight()
    message.tracks[1].states[20].center_x = float("inf")
    message.tracks[1].states[21].length = 0.0
    record = one(write(tmp_path / "a.tfrecord", message))
    assert list(np.flatnonzero(~record.tracks[1].valid)) == [20, 21]


def test_a_speed_limit_of_nothing_is_zero(tmp_path: Path) -> None:
    message = straight()
    message.map_features[0].lane.speed_limit_mph = float("nan")
    assert one(write(tmp_path / "a.tfrecord", message)).lanes[11].speed_limit == 0.0


def outcome(path: Path) -> object:
    """What reading comes to: records, or the sentences."""
    errors: list[UsageError] = []
    records = list(read_records(path, told=errors.append))
    assert all(isinstance(r, Record) for r in records)
    assert all(str(error).endswith(".") for error in errors)
    return records, errors


SMALL = empty("small")
SMALL.tracks.add(id=1, object_type=1).states.add(valid=True, length=4.0, width=2.0)
del SMALL.timestamps_seconds[1:], SMALL.dynamic_map_states[1:]
SMALL.current_time_index = 0
SMALL.map_features.add(id=1).lane.polyline.add(x=1.0)
SMALL_BYTES = SMALL.SerializeToString()


@settings(deadline=None, max_examples=150)
@given(data=st.binary(max_size=400), framed=st.booleans())
def test_any_bytes_are_a_value_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, framed: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.tfrecord"
    path.write_bytes(frame(data) if framed else data)
    outcome(path)


@settings(deadline=None, max_examples=250)
@given(st.lists(st.tuples(st.integers(0, len(SMALL_BYTES) - 1), st.integers(0, 255)), min_size=1, max_size=6))
def test_a_changed_record_is_a_value_or_a_named_error(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(SMALL_BYTES)
    for at, value in changes:
        data[at] = value
    path = tmp_path_factory.getbasetemp() / "changed.tfrecord"
    path.write_bytes(frame(bytes(data)))
    outcome(path)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, len(SMALL_BYTES) + 16))
def test_a_file_cut_anywhere_is_told(tmp_path_factory: pytest.TempPathFactory, end: int) -> None:
    whole = frame(SMALL_BYTES)
    path = tmp_path_factory.getbasetemp() / "cut.tfrecord"
    path.write_bytes(whole + whole[:end])
    errors: list[UsageError] = []
    records = list(read_records(path, told=errors.append))
    assert len(records) + len(errors) == (1 if end == 0 else 2)


@pytest.mark.parametrize("build", WITH_MAP, ids=lambda build: build.__name__)
def test_the_samples_are_records(tmp_path: Path, build: object) -> None:
    record = one(write(tmp_path / "a.tfrecord", build()))  # type: ignore[operator]
    assert record.lanes and record.tracks[record.sdc].valid[record.current]


def test_without_protobuf_the_extra_is_named(tmp_path: Path) -> None:
    """In a process of its own, where importing google.protobuf fails."""
    (tmp_path / "google").mkdir()
    (tmp_path / "google" / "__init__.py").write_text("raise ImportError('gone')\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from pathlib import Path\nfrom sumo_adv.womd.reader import read_records\n"
        "try:\n    list(read_records(Path('a.tfrecord')))\nexcept Exception as e:\n    print(type(e).__name__, e)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == (
        "UsageError Waymo records need protobuf, which is not installed: pip install 'sumo-adv[womd]'.\n"
    )


@pytest.mark.skipif(not SHARED.is_dir(), reason="the Waymo records (shared/womd) are not here")
def test_real_records_are_read() -> None:
    paths = sorted(SHARED.glob("*.tfrecord"))[:3]
    for path in paths:
        record = one(path)
        assert record.scenario_id == path.stem and len(record.lanes) > 50
