"""Run ``sumo-adv run`` from a script or a notebook.

    result = sumo_adv.run("priority_crossing", until="valid")

The settings have the names that the options have, and the work is done in the same processes.
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

NOTEBOOK_PAGE_HEIGHT_PX = 720  # height of a page inside a notebook
TEXT_COLUMNS = ("id", "role", "lane")  # text columns of tables; all others are numbers
Table = dict[str, NDArray[Any]]
"""Columns by name, all of the same length. ``pandas.DataFrame`` accepts it."""


class Result:
    """A finished run, read from its folder.

    Attributes:
        folder: The folder of the run.
    """

    def __init__(self, folder: Path, keep: tempfile.TemporaryDirectory[str] | None = None) -> None:
        """Refer to a run's folder. Files are read when an attribute needs them.

        Args:
            folder: The folder of the run.
            keep: A temporary folder that is removed with this object; None if the run's folder stays.
        """
        self.folder = folder
        self._keep = keep  # keeps a temporary folder as long as this object exists

    @cached_property
    def outcome(self) -> Outcome:
        """The outcome of the run: ``outcome.ending``, ``.level``, ``.verdict.min_ttc``, ``.attempts`` and so on.

        Raises:
            UsageError: ``outcome.json`` is missing or damaged.
        """
        from sumo_adv.report.read import OUTCOME_FILE, read_run
        from sumo_adv.report.run_outcome import outcome_of

        return outcome_of(read_run(self.folder).outcome, self.folder / OUTCOME_FILE)

    @cached_property
    def states(self) -> Table:
        """The states of all vehicles in the attempt that counts, from the start of the simulation.

        If there was no attempt, these are the states of the unattacked run. The table has one row per vehicle and step,
        in order of time. It has no rows if no encounter was found. Its columns are time [s]; id; role; x, y of the
        box's centre [m]; heading [rad]; speed [m/s]; acceleration [m/s2]; length, width [m]; lane. If roads have
        heights, z is the height of the road [m].
        """
        return _table(self.folder / "states.csv.gz")

    @cached_property
    def raw(self) -> Table:
        """The states of all vehicles in the run without the attack, with the columns of ``states``."""
        return _table(self.folder / "raw.csv.gz")

    @cached_property
    def criticality(self) -> Table:
        """Measures between the ego and each vehicle near it over time, in the attempt that counts.

        The columns are time [s]; id; ttc [s]; gap between the boxes [m]; drac [m/s2]; btn, the brake threat number;
        headway [s]; required_lateral [m/s2]; centre_distance [m]. A value is nan if there is no danger of its kind. The
        table has no rows if there was no attempt.
        """
        from sumo_adv.report.tables import SERIES_HEADER

        return _table(self.folder / "criticality.csv.gz", SERIES_HEADER)

    def plot(self) -> Figure:
        """Draw the encounter without and with the attack.

        Returns:
            The figure.

        Raises:
            UsageError: No attempt was made.
        """
        from sumo_adv.report.figures import draw_paper, read_story

        return draw_paper(read_story(self.folder))

    def show(self, height: int = NOTEBOOK_PAGE_HEIGHT_PX) -> Shown:
        """Return the replay page, which a notebook shows inline as the last value of a cell.

        Args:
            height: The height of the page in the notebook [pixels].

        Raises:
            UsageError: The folder holds no run, or a file is damaged.
        """
        from sumo_adv.report.page import make_page

        return Shown(make_page(self.folder), height)

    def export(self, out: str | Path, format: Format | str = "openscenario", variant: Variant | str = "replay") -> Path:
        """Write the run for other tools, as ``sumo-adv export`` does (docs/exports.md).

        Args:
            out: The file or folder to write. With ``all``, a folder for the exports.
            format: The format; ``all`` writes each format whose packages are installed.
            variant: The vehicles that an OpenSCENARIO file drives.

        Returns:
            The path ``out``.

        Raises:
            UsageError: The format is unknown, ``out`` exists already, or there is nothing to export.
        """
        from sumo_adv.report.export import Format, Variant
        from sumo_adv.report.export.formats import FORMATS, chosen, write_export
        from sumo_adv.report.export.piece import read_piece

        try:
            kind, driven = Format(format), Variant(variant)
        except ValueError as error:
            raise UsageError(f"{str(error)[:1].upper()}{str(error)[1:]} for an export.") from error
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
    """A page that notebooks display. Its frame may only run its own script.

    Attributes:
        page: The HTML of the page.
        height: The height of the frame [pixels].
    """

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

    The user's memory bank is used and, unless ``learn="off"``, added to, as on the command line.

    Args:
        source: Any input of ``sumo-adv run``: a net.xml, a .sumocfg, a scenario, a record file or a shipped name.
        ego: The driver under test: a name as on the command line, or your own class or object. It may be defined in a
            script or a notebook. An object is copied, so what it remembers stays in the engine's process. A run with a
            class or an object cannot be replayed from its folder.
        out: The folder to write; None for a temporary folder that is removed with the result.
        force: Whether an existing folder ``out`` is replaced.
        record: The record to take from a file of several: its id, or its place from 0; None takes the first.
        settings_file: A TOML file of settings.
        tell: Called with each event (``encounter``, ``intents``, ``attempt``) and its value.
        **settings: Fields of ``sumo_adv.config.Settings``, which are the options of ``sumo-adv run`` with ``_`` for
            ``-``: ``until``, ``attempts``, ``intents``, ``exclude``, ``kind``, ``ttc`` (LOW, HIGH), ``min_delta_v``,
            ``seed`` and so on. None means that the setting is not given.

    Raises:
        UsageError: The input or a setting is bad, or ``out`` exists and ``force`` is not given.
        BankError: The bank cannot be opened.
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
            from sumo_adv.report.folder import write_run  # here, since loading it would delay the engine

            write_run(folder, played)
            folder.keep(force=force)
    except BaseException:
        if keep is not None:
            keep.cleanup()
        raise
    return Result(target, keep)


def load(folder: str | Path) -> Result:
    """Return the result in a run's folder.

    Raises:
        UsageError: The folder holds no result.
    """
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
    """Return the verdict on your own tracks.

    A track is a mapping of columns: arrays, a dict of lists or a pandas table. It needs time [s], x and y of the box's
    centre [m], heading [rad] and speed [m/s]. It may have length and width [m], lane, and z, the height of the road
    [m]. All tracks need one regular time grid. The adversary's track should continue past the contact as the adversary
    planned to move; otherwise the verdict is inconclusive (``no_plan``). Reference drivers are simulated only in the
    kinematic check.

    Args:
        ego: The track of the ego, or its id in the table ``others``.
        adversary: The track of the adversary; an id if ``ego`` is one.
        others: The tracks of further vehicles. With ids, one table of all vehicles that has the column ``id``.
        trigger_time: The time from which the adversary attacks [s]; None for the time of the ego's third state.
        ttc: The minimum TTC up to which the attempt is critical [s].
        lane_width: The width of a lane [m].
        on_road: Returns whether points (x, y) [m] are drivable. Without it, no motion counts as off the road.

    Raises:
        UsageError: A column is missing or bad, an id is not in the table, or the tracks do not overlap.
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
    """Read the columns of a table of states, or of a table with another ``header``, in its order."""
    from sumo_adv.report.read import columns_of

    columns = columns_of(file) if header is None else columns_of(file, header)
    return {
        name: np.array(values, object) if name in TEXT_COLUMNS else np.array([v or "nan" for v in values], np.float64)
        for name, values in columns.items()
    }
