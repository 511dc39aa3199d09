"""From a driver's name to its controller.

Built-in drivers stand in ``DRIVERS``. Drivers of other packages are found by their entry point in the group
``sumo_adv.drivers``; any other class is named ``module:Class``, or given as a class or an object.

A driver of a user has ``reset(seed)`` and ``act(observation)``. Its constructor gets the scenario's parameters by name.
It may have these attributes and this method:

- ``name``; ``forkable`` (default False); ``sumo_type`` (default IDM's); ``needs_observation`` (default True);
- ``needs_road``, ``visible_only``, ``sees_buildings`` and the numbers of its bicycle (``protocol.py``);
- ``model_of(numbers)``: how it is predicted (default: as an unknown driver).

Drivers that are given as a class or an object (``GivenEgo``) travel to the engine's process by value. A class of a
script or a notebook cannot be imported in another process. cloudpickle sends its code along.
"""

from __future__ import annotations

import importlib
import math
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from traceback import extract_tb, walk_tb
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from sumo_adv.datatypes import DriverModel
from sumo_adv.drivers.blind import BlindEgo
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.lattice_ego import LatticeEgo
from sumo_adv.drivers.protocol import (
    Action,
    EgoController,
    LaneSpeed,
    Observation,
    PlannedPose,
    Points,
    Pose,
    Steer,
    model_of,
    read_wishes,
)
from sumo_adv.drivers.sumo_driven import FOLLOWING_MODELS, DriverType, ReplayEgo, SumoEgo, sumo_type
from sumo_adv.errors import DriverError, SimulationError, UsageError, nearest, ran_out_of_memory
from sumo_adv.simulation.watch import OutOfTimeError

T = TypeVar("T")
MAX_ACTION_NUMBER = 1e9  # of a number in an action: SUMO takes whole numbers of 32 bits
MAX_PLAN_POINTS = 1000  # of an answer
MAX_NOTES = 20  # of an answer
MAX_NOTE_NAME_CHARACTERS = 40
METHODS = {"reset": "reset(seed)", "act": "act(observation)"}  # of a driver


class UserEgo:
    """A user's driver: each of its errors becomes one sentence that names it."""

    def __init__(self, spec: str, driver: Any) -> None:
        """``spec``: what messages call the driver. Raises UsageError: its bicycle cannot be used."""
        self._driver, self._spec = driver, spec
        self.name = str(getattr(driver, "name", spec))
        self.forkable = bool(getattr(driver, "forkable", False))
        self.needs_observation = bool(getattr(driver, "needs_observation", True))
        self.wishes = read_wishes(driver, spec)
        attributes = getattr(driver, "sumo_type", None)
        given = sumo_type("idm", {}) if attributes is None else attributes
        self.sumo_type: Mapping[str, str] = given if isinstance(given, DriverType) else dict(given)

    def reset(self, seed: int) -> None:
        """Raises DriverError if the user's code fails."""
        self._call("failed in reset", lambda: self._driver.reset(seed))

    def act(self, observation: Observation) -> Action:
        """Raises DriverError if the user's code fails, or returns something other than a valid action."""
        at = f"at {observation.time:.1f} s"
        action = self._call(f"failed in act at {observation.time:.1f} s", lambda: self._driver.act(observation))
        if action is None:
            return None
        if not isinstance(action, Steer | LaneSpeed | Pose):
            raise DriverError(
                f"The ego {self._spec!r} returned {type(action).__name__}; "
                "act must return Steer, LaneSpeed, Pose or None."
            )
        names = _number_names(action)
        if not all(getattr(action, name) is None or type(getattr(action, name)) in (int, float) for name in names):
            action = replace(action, **{name: _plain(getattr(action, name)) for name in names})
        for value in (getattr(action, name) for name in names):
            if value is None and isinstance(action, LaneSpeed):
                continue
            if not isinstance(value, int | float):
                wrong = f"a number of it is of the type {type(value).__name__}: say float(...)"
                raise DriverError(f"The ego {self._spec!r} returned {action!r} {at}; {wrong}.")
            if not math.isfinite(value) or abs(value) > MAX_ACTION_NUMBER:
                raise DriverError(
                    f"The ego {self._spec!r} returned {str(action)[:200]} {at}; its numbers must be finite, "
                    f"and at most {MAX_ACTION_NUMBER:g}."
                )
        if isinstance(action, Steer | LaneSpeed | PlannedPose) and (action.plan is not None or action.notes):
            try:
                return replace(action, plan=_plan(action.plan), notes=_notes(action.notes))
            except (TypeError, ValueError) as error:
                raise DriverError(f"The ego {self._spec!r} returned {type(action).__name__} {at}; {error}.") from error
        return action

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Raises SimulationError if the user's code fails, or returns something other than a DriverModel."""
        model = self._call("failed in model_of", lambda: model_of(self._driver, numbers))
        if not isinstance(model, DriverModel):
            raise SimulationError(f"The ego {self._spec!r} returned {model!r}; model_of must return a DriverModel.")
        return model

    def _call(self, failure: str, call: Callable[[], T]) -> T:
        try:
            return call()
        except (OutOfTimeError, SystemExit):
            raise
        except BaseException as error:  # user code, which may raise anything; Ctrl-C does not reach this process
            if ran_out_of_memory(error):
                raise
            raise DriverError(f"The ego {self._spec!r} {failure}: {in_one_line(error)}{_place(error)}.") from error


def _number_names(action: Steer | LaneSpeed | Pose) -> tuple[str, ...]:
    """The names of the numbers that move the ego."""
    if isinstance(action, Steer):
        return "acceleration", "steering"
    return ("lane", "speed") if isinstance(action, LaneSpeed) else ("x", "y", "heading", "speed")


def _plan(given: Any) -> Points | None:
    """A plan as pairs of plain numbers. Raises ValueError or TypeError for what is none."""
    if given is None:
        return None
    points = np.asarray(given, dtype=np.float64)
    if points.size == 0:
        return ()
    if points.ndim != 2 or points.shape[1] < 2 or not np.isfinite(points).all():
        raise ValueError("its plan must be finite points (x, y)")
    if len(points) > MAX_PLAN_POINTS:
        raise ValueError(f"its plan has {len(points)} points; {MAX_PLAN_POINTS} are the most")
    return tuple(zip(points[:, 0].tolist(), points[:, 1].tolist(), strict=True))


def _notes(given: Any) -> dict[str, float]:
    """Notes as plain numbers by name. Raises ValueError or TypeError for what is none."""
    if not isinstance(given, Mapping) or len(given) > MAX_NOTES:
        raise ValueError(f"its notes must be a mapping of at most {MAX_NOTES} names to numbers")
    notes = {str(name)[:MAX_NOTE_NAME_CHARACTERS]: float(value) for name, value in given.items()}
    if not all(math.isfinite(value) for value in notes.values()):
        raise ValueError("its notes must be finite numbers")
    return notes


def _plain(value: Any) -> Any:
    """A number of numpy as one of Python."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and np.ndim(value) == 0 else value


def _place(error: BaseException) -> str:
    """The file and line of an error in a user's code: the deepest call in the file that was called first. A base class
    of ours, such as ``PlannerEgo``, is no code of the user."""
    ours = f"{Path(__file__).parents[1]}{os.sep}"
    frames = [f for f in extract_tb(error.__traceback__) if not f.filename.startswith(ours)]
    if not frames:
        return ""
    deepest = [f for f in frames if f.filename == frames[0].filename][-1]
    return f" ({Path(deepest.filename).name}, line {deepest.lineno})"


def find_class(kind: str, spec: str) -> type:
    """The class ``module:Class``, found on ``sys.path`` or in the current folder. Error messages call it ``kind``.

    Classes of Python's standard library are refused before anything is imported. None of them is a driver, and making
    an object of one can have effects: ``subprocess:Popen`` starts a program.

    Raises UsageError: another form, a class of the standard library, a module that cannot be imported, no such class.
    """
    module_name, _, class_name = spec.partition(":")
    if not module_name or not class_name:
        raise UsageError(f"The {kind} {spec!r} is not of the form 'module:Class'.")
    if module_name.endswith(".py"):
        raise UsageError(f"The {kind} {spec!r} names a file; name its module: {module_name[:-3]}:{class_name}.")
    if _in_standard_library(module_name):
        raise _not_yours(kind, spec)
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # last, so that no file of the user hides an installed package
    module = _import(kind, spec, module_name, here)
    user_class = getattr(module, class_name, None)
    if not isinstance(user_class, type):
        own = [name for name, each in vars(module).items() if isinstance(each, type) and each.__module__ == module_name]
        has = f"; it has {', '.join(own[:10])}" if own else ""
        raise UsageError(f"The module {module_name!r} has no class {class_name!r} for the {kind} {spec!r}{has}.")
    if _in_standard_library(user_class.__module__):  # the user's module may have imported it
        raise _not_yours(kind, spec)
    return user_class


def spec_of(user_class: type) -> str:
    """Return the name ``module:Class`` by which other processes import a driver; a script's module is its file's name.

    Raises:
        UsageError: The class lacks a method that a driver needs, or other processes cannot import it because it lies
            in a notebook or in a function.
    """
    _check_methods("ego", user_class.__name__, user_class, METHODS)
    main = sys.modules.get("__main__")
    file = getattr(main, "__file__", None)
    module = Path(file).stem if user_class.__module__ == "__main__" and file else user_class.__module__
    if module == "__main__" or "." in user_class.__qualname__:
        raise UsageError(
            f"Other processes cannot import the class {user_class.__name__!r}: put it at the top of a module beside "
            "your script or notebook, and import it from there."
        )
    return f"{module}:{user_class.__qualname__}"


def make_object(kind: str, spec: str, parameters: Mapping[str, Any], methods: Mapping[str, str]) -> Any:
    """An object of the class ``module:Class``; ``methods``: name -> signature, for the error message.

    The class is checked for its methods before an object is made, so that no code of an unsuitable class runs.

    Raises UsageError: as ``find_class``, or the class lacks a method, or the object cannot be made.
    """
    user_class = find_class(kind, spec)
    _check_methods(kind, spec, user_class, methods)
    try:
        return user_class(**parameters)
    except (Exception, SystemExit) as error:  # user code
        raise UsageError(f"The {kind} {spec!r} could not be made: {in_one_line(error)}.") from error


COMMAND_LINE_READERS = ("absl", "argparse", "click", "docopt", "fire", "getopt", "optparse", "typer")
"""Packages that read the command line of the process, and end it."""
MAX_MODULE_OUTPUT_CHARACTERS = 200  # of what a module wrote, in a sentence


class _Words:
    """Stands for ``sys.stdout`` and ``sys.stderr`` while a module is imported: keeps what is written. ``pass_on`` gives
    it to ``to``, and from then on all that comes."""

    def __init__(self, to: Any) -> None:
        self._to, self._kept, self._passes = to, "", False

    def write(self, text: str) -> int:
        if self._passes:
            return int(self._to.write(text))
        self._kept += text
        return len(text)

    def pass_on(self) -> None:
        self._passes = True
        if self._kept:
            self._to.write(self._kept)

    @property
    def last_line(self) -> str:
        lines = [line.strip() for line in self._kept.splitlines() if line.strip()]
        return lines[-1][-MAX_MODULE_OUTPUT_CHARACTERS:].rstrip(".") if lines else ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._to, name)


def _import(kind: str, spec: str, module_name: str, here: str) -> ModuleType:
    """The user's module. What it prints goes to stderr, because stdout may be one JSON object.

    Raises UsageError: its code fails, ends the process or reads its command line; the sentence has its last line.
    """
    words = _Words(sys.stderr)
    try:
        with redirect_stdout(words), redirect_stderr(words):
            module = importlib.import_module(module_name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # user code runs on import, and may end the process
        if ran_out_of_memory(error):
            raise
        reason = in_one_line(error) + (f"; it wrote {words.last_line!r}" if words.last_line else "")
        readers = {str(f.f_globals.get("__name__")).partition(".")[0] for f, _ in walk_tb(error.__traceback__)}
        if readers.intersection(COMMAND_LINE_READERS) or isinstance(error, SystemExit):
            does = "reads the command line" if readers.intersection(COMMAND_LINE_READERS) else "ends the program"
            raise UsageError(
                f"The module of the {kind} {spec!r} {does} when it is imported ({reason}): put that code below "
                "if __name__ == '__main__'."
            ) from error
        raise UsageError(
            f"The module of the {kind} {spec!r} could not be imported from {here} or Python's path: {reason}."
        ) from error
    words.pass_on()
    return module


def _check_methods(kind: str, spec: str, thing: Any, methods: Mapping[str, str]) -> None:
    """Raises UsageError if a class or an object lacks one of ``methods`` (name -> signature)."""
    for name in methods:
        if not callable(getattr(thing, name, None)):
            raise UsageError(f"The {kind} {spec!r} has no method {name!r}; it needs {' and '.join(methods.values())}.")


def in_one_line(error: BaseException) -> str:
    """Exception type and message on one line, without a full stop at the end."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def _in_standard_library(module_name: str) -> bool:
    """Whether the module belongs to Python's standard library; a script that runs as ``__main__`` does not."""
    top = module_name.partition(".")[0]
    return top != "__main__" and (top in sys.stdlib_module_names or top in sys.builtin_module_names)


def _not_yours(kind: str, spec: str) -> UsageError:
    return UsageError(f"The {kind} {spec!r} is a class of Python's standard library: name a class of your own.")


OBJECT_PREFIX = "object:"  # of the names of such drivers; no module can be called so, because a colon follows


@dataclass(frozen=True, slots=True)
class GivenEgo:
    """A driver as bytes. name: ``object:`` and its class; made: it is an object, else a class to make one of."""

    name: str
    made: bool
    content: bytes


def pack_driver(ego: Any) -> GivenEgo:
    """A class or an object as bytes.

    Raises UsageError: it lacks a method that a driver needs, or cannot be turned into bytes.
    """
    import cloudpickle

    made = not isinstance(ego, type)
    name = OBJECT_PREFIX + (type(ego) if made else ego).__name__
    _check_methods("ego", name, ego, METHODS)
    try:
        return GivenEgo(name, made, cloudpickle.dumps(ego))
    except Exception as error:  # whatever the user's object raises
        raise UsageError(
            f"The ego {name!r} cannot be sent to the engine's process ({in_one_line(error)}): make in reset what "
            "cannot be copied, or give the class instead of an object."
        ) from error


def unpack_driver(given: GivenEgo, parameters: Mapping[str, Any]) -> Any:
    """The driver; ``parameters`` are those of its constructor, if it is still to be made.

    Raises UsageError: it cannot be made.
    """
    import cloudpickle

    try:
        ego = cloudpickle.loads(given.content)
        return ego if given.made else ego(**parameters)
    except (Exception, SystemExit) as error:  # user code
        raise UsageError(f"The ego {given.name!r} could not be made: {in_one_line(error)}.") from error


def lost(name: str, path: str) -> UsageError:
    """That a driver was given as an object, and ``path`` does not hold it."""
    return UsageError(
        f"{path} was driven by an object from Python, {name.removeprefix(OBJECT_PREFIX)!r}, which no file holds: "
        "give it again with sumo_adv.run(ego=...)."
    )


ENTRY_POINTS = "sumo_adv.drivers"


def _fiss_plus(parameters: Mapping[str, Any]) -> EgoController:
    """FISS+. Its package is an extra and is imported only for this driver."""
    try:
        from sumo_adv.drivers.fiss_plus import FissPlusEgo
    except ImportError as error:
        if error.name != "fiss_planner":
            raise
        raise UsageError(
            "The ego 'fiss_plus' needs the package fiss-planner, which is not installed: "
            "pip install 'sumo-adv[planners]'."
        ) from error
    return FissPlusEgo(parameters)


DRIVERS: Mapping[str, Callable[[Mapping[str, Any]], EgoController]] = {
    **{name: partial(SumoEgo, name) for name in FOLLOWING_MODELS},
    "blind": BlindEgo,
    "careful": CarefulEgo,
    "fiss_plus": _fiss_plus,
    "lattice": LatticeEgo,
    "replay": ReplayEgo,
}
"""Name -> what makes the driver from its parameters."""


def make_ego(name: str, parameters: Mapping[str, Any], given: GivenEgo | None = None) -> EgoController:
    """The controller called ``name``: a key of ``DRIVERS``, an entry point's name, ``module:Class``, or the name of the
    driver that is ``given``.

    Raises UsageError for an unknown name, an unknown parameter, or a class that cannot be used.
    """
    if given is not None:
        return UserEgo(given.name, unpack_driver(given, parameters))
    if name.startswith(OBJECT_PREFIX):
        raise lost(name, "The run")
    if ":" in name:
        return UserEgo(name, make_object("ego", name, parameters, METHODS))
    if name in DRIVERS:
        return DRIVERS[name](parameters)
    if name == ExternalEgo.name:
        raise UsageError("The ego 'external' is driven by a program of yours over TraCI: use sumo-adv serve.")
    check_name(name)
    installed = _installed()[name]
    return UserEgo(installed, make_object("ego", installed, parameters, METHODS))


def check_name(name: str) -> None:
    """Raises UsageError if no driver has that name. A ``module:Class`` is not imported."""
    names = (*DRIVERS, *_installed())
    if ":" not in name and name not in names:
        raise UsageError(f"There is no ego {name!r}{nearest(name, names)}; choose {', '.join(names)} or module:Class.")


def is_foreign(name: str) -> bool:
    """Whether the driver ``name`` is a class of another package, which runs with the user's rights."""
    return ":" in name or (name not in DRIVERS and name in _installed())


def trusted_driver(named: str | None, recorded: str | None, path: Path) -> str | None:
    """The driver ``named`` by the user, else the driver that the file or folder ``path`` records; None if neither
    names one.

    Raises UsageError: only ``path`` names the driver, and it is a class of another package or was given as an object.
    """
    if named is None and recorded is not None and recorded.startswith(OBJECT_PREFIX):
        raise lost(recorded, f"The run in {path}")
    if named is None and recorded is not None and is_foreign(recorded):
        raise UsageError(
            f"{path} wants the class {recorded!r} to drive the ego, and a class runs with your rights: "
            f"if you trust it, name it yourself with --ego {recorded}."
        )
    return named or recorded


def _installed() -> dict[str, str]:
    """Drivers of other packages: name -> ``module:Class``."""
    return {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}


class ExternalEgo:
    """The ego of ``serve``: a client of the same SUMO drives it over TraCI. Its vType stays as the demand gives it."""

    name = "external"
    forkable = False
    needs_observation = False
    sumo_type: Mapping[str, str] = {}

    def reset(self, seed: int) -> None:
        """Nothing to forget: the client holds the state."""

    def act(self, observation: Observation) -> Action:
        """Never called."""
        return None
