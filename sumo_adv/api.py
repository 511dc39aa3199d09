"""The program from Python: ``import sumo_adv; result = sumo_adv.run("priority_crossing", until="valid")``.

What ``sumo-adv run`` does, with settings of the same names and in the same processes, from a script or a notebook.
"""

from __future__ import annotations

import html
import tempfile
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.config import load_settings
from sumo_adv.datatypes import Ending, Role, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.report.staging import scratch_folder, staged

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sumo_adv.report.export import Format, Variant
    from sumo_adv.report.run_outcome import Outcome

NOTEBOOK_PAGE_HEIGHT_PX = 720  # pixels of a page inside a notebook
TEXT_COLUMNS = ("id", "role", "lane")  # columns of tables that are text; all others are numbers
Table = dict[str, NDArray[Any]]
"""Columns by name, all of one length: what ``pandas.DataFrame`` takes."""


class Result:
    """A run that has ended, as its folder tells it."""

    def __init__(self, folder: Path, keep: tempfile.TemporaryDirectory[str] | None = None) -> None:
        self.folder = folder
        self._keep = keep  # a temporary folder lives as long as this object

    @cached_property
    def outcome(self) -> Outcome:
        """The outcome of the run: ``outcome.ending``, ``.level``, ``.verdict.min_ttc``, ``.attempts`` and so on.

        Raises UsageError: ``outcome.json`` is missing or damaged.
        """
        from sumo_adv.report.read import OUTCOME_FILE, read_run
        from sumo_adv.report.run_outcome import outcome_of

        return outcome_of(read_run(self.folder).outcome, self.folder / OUTCOME_FILE)

    @cached_property
    def states(self) -> Table:
        """The attempt that counts (the unattacked run if there was none), from the start of the simulation.

        time [s]; id; role; x, y of the box's centre [m]; heading [rad]; speed [m/s]; acceleration [m/s2]; length, width
        [m]; lane; where roads have heights z, that of the road [m]. A row a vehicle and step, by time; no rows where no
        encounter was met.
        """
        return _table(self.folder / "states.csv.gz")

    @cached_property
    def raw(self) -> Table:
        """The same without the attack."""
        return _table(self.folder / "raw.csv.gz")

    @cached_property
    def criticality(self) -> Table:
        """Measures between the ego and each vehicle near it over time, in the attempt that counts.

        time [s]; id; ttc [s]; gap [m] between the boxes; drac [m/s2]; btn, the brake threat number; headway [s];
        required_lateral [m/s2]; centre_distance [m]. Never, or no danger of that kind, is nan. No rows without an
        attempt.
        """
        from sumo_adv.report.tables import SERIES_HEADER

        return _table(self.folder / "criticality.csv.gz", SERIES_HEADER)

    def plot(self) -> Figure:
        """A figure of the encounter without and with the attack. Raises UsageError: no attempt was made."""
        from sumo_adv.report.figures import draw_paper, read_story

        return draw_paper(read_story(self.folder))

    def show(self, height: int = NOTEBOOK_PAGE_HEIGHT_PX) -> Shown:
        """The replay page, inline where a notebook shows the last value of a cell. Raises UsageError."""
        from sumo_adv.report.page import make_page

        return Shown(make_page(self.folder), height)

    def export(self, out: str | Path, format: Format | str = "openscenario", variant: Variant | str = "replay") -> Path:
        """Write the run for other tools; formats and files are those of ``sumo-adv export`` (docs/exports.md).

        ``all`` makes ``out`` a folder with each format that has its packages installed.

        Raises UsageError: an unknown format, ``out`` is there already, or nothing to export.
        """
        from sumo_adv.report.export import Format, Variant
        from sumo_adv.report.export.formats import FORMATS, chosen, write_export
        from sumo_adv.report.export.piece import read_piece

        try:
            kind, driven = Format(format), Variant(variant)
        except ValueError as error:
            raise UsageError(f"{str(error)[:1].upper()}{str(error)[1:]} of an export.") from error
        piece = read_piece(self.folder)
        for each in chosen(kind):
            target = Path(out) / f"{self.folder.name}{FORMATS[each].ending}" if kind is Format.ALL else Path(out)
            write_export(target, piece, each, driven, force=False)
        return Path(out)

    def __repr__(self) -> str:
        level = self.outcome.level
        came_to = f"{level}" if self.outcome.ending is Ending.GOAL_MET else self.outcome.ending
        return f"<sumo_adv.Result {came_to}, {len(self.outcome.attempts)} attempts: {self.folder}>"


class Shown:
    """A page that notebooks display, in a frame that may do nothing but run its own script."""

    def __init__(self, page: str, height: int) -> None:
        self.page, self.height = page, height

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="{self.height}" sandbox="allow-scripts" '
            'style="border:0" title="Replay"></iframe>'
        )


def run(
    source: str | Path,
    *,
    ego: str | type | object | None = None,
    out: str | Path | None = None,
    force: bool = False,
    record: str | None = None,
    settings_file: str | Path | None = None,
    tell: Callable[[str, Any], None] | None = None,
    **settings: Any,
) -> Result:
    """Find the dangerous case in ``source`` and return the result, whether critical or not.

    source: what ``sumo-adv run`` takes: a net.xml, a .sumocfg, a scenario, a record file or a shipped name.
    out: the folder to write; else a temporary folder, removed with the result.
    ego: the driver under test: a name as on the command line, or a class or an object of yours, which may be
    defined in a script or a notebook. An object is copied: what it remembers stays in the engine's process. A run with
    a class or an object given so cannot be replayed from its folder.
    settings: those of ``sumo_adv.config.Settings``, options of ``sumo-adv run`` with ``_`` for ``-``: ``until``,
    ``attempts``, ``intents``, ``exclude``, ``kind``, ``ttc`` (LOW, HIGH), ``min_delta_v``, ``seed`` ... None is not
    given.
    tell: called with what happens (``encounter``, ``intents``, ``attempt``) and its value.
    The user's memory bank is used and, unless ``learn="off"``, added to, as on the command line.

    Raises:
        UsageError: bad input or settings, or ``out`` is taken and ``force`` is not given.
        BankError: the bank cannot be opened.
    """
    from sumo_adv.app import load, play
    from sumo_adv.drivers.registry import pack_driver, trusted_driver
    from sumo_adv.simulation.inputs import own_simulation

    run_input = load(Path(source), record)
    options = {name: value for name, value in settings.items() if value is not None}
    packed = None if ego is None or isinstance(ego, str) else pack_driver(ego)
    named = packed.name if packed is not None else str(ego) if ego is not None else None
    driver = trusted_driver(named, run_input.ego_controller, run_input.path)
    options = {**own_simulation(run_input), **run_input.settings(options), **options, "ego": driver}
    chosen = load_settings(None if settings_file is None else Path(settings_file), **options)
    keep = tempfile.TemporaryDirectory(prefix=scratch_prefix()) if out is None else None
    target = Path(out) if out is not None else Path(keep.name if keep else "") / f"{run_input.name}-{chosen.seed}"
    try:
        with staged(target, force=force) as folder, scratch_folder() as scratch:
            played = play(run_input, chosen, folder.stage, scratch, tell or (lambda *_: None), ego=packed)
            from sumo_adv.report.folder import write_run  # here, since loading it would keep the engine waiting

            write_run(folder, played)
            folder.keep(force=force)
    except BaseException:
        if keep is not None:
            keep.cleanup()
        raise
    return Result(target, keep)


def load(folder: str | Path) -> Result:
    """The result in a run's folder. Raises UsageError: it is none."""
    result = Result(Path(folder))
    _ = result.outcome
    return result


def judge(
    ego: str | Mapping[str, Any],
    adversary: str | Mapping[str, Any],
    others: Any = (),
    *,
    trigger_time: float | None = None,
    ttc: float = 1.0,
    lane_width: float = 3.2,
    on_road: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]] | None = None,
) -> Verdict:
    """The verdict on tracks of your own.

    ego, adversary: columns by name (arrays, a dict of lists, a pandas table): time [s], x, y of the box's centre [m],
    heading [rad], speed [m/s], optional length, width [m], lane and z, the height of the road [m]; or ids, and then
    ``others`` is one table with the column ``id`` that holds all vehicles. others: further vehicles, a table each. All
    on one regular grid; let the adversary's track go on past the contact as it planned, or the verdict is inconclusive
    (``no_plan``). Reference drivers are asked in the kinematic check only.
    trigger_time: from when on the adversary attacks [s]; the third state by default.
    on_road: tells whether points (x, y) are drivable; without it no motion counts as off the road.

    Raises UsageError: a column is missing or bad, an id is not in the table, or the tracks do not overlap.
    """
    from sumo_adv.metrics.case import Case
    from sumo_adv.metrics.own_data import columns_by_vehicle, track_of
    from sumo_adv.metrics.verdict import judge_attempt

    if isinstance(ego, str) or isinstance(adversary, str):
        if not (isinstance(ego, str) and isinstance(adversary, str)) or not hasattr(others, "__getitem__"):
            raise UsageError("Give ego and adversary both as ids, with one table of all vehicles, or both as tables.")
        table = columns_by_vehicle(others)
        missing = [name for name in (ego, adversary) if name not in table]
        if missing:
            raise UsageError(f"The table has no vehicle {missing[0]!r}; it has {', '.join(list(table)[:10])}.")
        given = {name: columns for name, columns in table.items() if name not in (ego, adversary)}
        ego_columns, adversary_columns = table[ego], table[adversary]
    else:
        ego_columns, adversary_columns = dict(ego.items()), dict(adversary.items())
        given = {f"other {k}": dict(columns.items()) for k, columns in enumerate(others)}
    first, second = track_of("ego", ego_columns, Role.EGO), track_of("adversary", adversary_columns, Role.ADVERSARY)
    third = tuple(track_of(name, columns, Role.BACKGROUND) for name, columns in given.items())
    start = float(first.time[2]) if trigger_time is None else trigger_time
    ground = None if on_road is None else lambda x, y, z=None: on_road(x, y)
    return judge_attempt(
        Case(first, second, third, start, on_road=ground, lane_half_width=lane_width / 2), ttc_threshold=ttc
    )


def _table(file: Path, header: str | None = None) -> Table:
    """The columns of a table of states, or of one with another ``header``, in its order."""
    from sumo_adv.report.read import columns_of

    columns = columns_of(file) if header is None else columns_of(file, header)
    return {
        name: np.array(values, object) if name in TEXT_COLUMNS else np.array([v or "nan" for v in values], np.float64)
        for name, values in columns.items()
    }
