"""Make a controller from a driver's name.

Built-in drivers are listed in ``DRIVERS``. Drivers of other packages are found by their entry point in the group
``sumo_adv.drivers``. Any other class is named ``module:Class``, or given as a class or an object.

A user's driver has ``reset(seed)`` and ``act(observation)``. Its constructor gets the scenario's parameters by name.
It may have these attributes and this method:

- ``name``; ``forkable`` (default False); ``sumo_type`` (default IDM's); ``needs_observation`` (default True);
- ``needs_road``, ``visible_only``, ``sees_buildings``, ``path_ahead`` and the numbers of its bicycle (``protocol.py``);
- ``model_of(numbers)``: returns the model that predicts it (default: an unknown driver).

Drivers that are given as a class or an object (``GivenEgo``) travel to the engine's process by value. A class of a
script or a notebook cannot be imported in another process, so cloudpickle sends its code along.
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
from sumo_adv.errors import DriverError, SimulationError, SumoError, UsageError, nearest, ran_out_of_memory
from sumo_adv.simulation.watch import OutOfTimeError

T = TypeVar("T")
MAX_ACTION_NUMBER = 1e9  # largest number in an action: SUMO takes whole numbers of 32 bits
MAX_PLAN_POINTS = 1000  # per answer
MAX_NOTES = 20  # per answer
MAX_NOTE_NAME_CHARACTERS = 40
METHODS = {"reset": "reset(seed)", "act": "act(observation)"}  # every driver has these


class UserEgo:
    """A user's driver as a controller. Each error of the user's code becomes one sentence that names the driver."""

    def __init__(self, spec: str, driver: Any) -> None:
        """Read the attributes of the user's driver.

        Args:
            spec: What messages call the driver.
            driver: The user's driver.

        Raises:
            UsageError: The driver's bicycle cannot be used, or its ``path_ahead`` is out of range.
        """
        self._driver, self._spec = driver, spec
        self.name = str(getattr(driver, "name", spec))
        self.forkable = bool(getattr(driver, "forkable", False))
        self.needs_observation = bool(getattr(driver, "needs_observation", True))
        self.wishes = read_wishes(driver, spec)
        attributes = getattr(driver, "sumo_type", None)
        given = sumo_type("idm", {}) if attributes is None else attributes
        if not isinstance(given, Mapping):
            raise UsageError(f"The ego {spec!r} has a sumo_type of type {type(given).__name__}; give a dictionary.")
        texts = given if isinstance(given, DriverType) else {str(name): str(value) for name, value in given.items()}
        self.sumo_type: Mapping[str, str] = texts

    def reset(self, seed: int) -> None:
        """Reset the user's driver.

        Raises:
            DriverError: The user's code fails.
        """
        self._call("failed in reset", lambda: self._driver.reset(seed))

    def act(self, observation: Observation) -> Action:
        """Ask the user's driver for an action.

        Returns:
            The action, with plain numbers.

        Raises:
            DriverError: The user's code fails, or returns something other than a valid action.
            SumoError: SUMO fails while the driver reads the observation.
        """
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
        numbers = {name: getattr(action, name) for name in names}
        if isinstance(action, LaneSpeed) and action.lane is None:
            del numbers["lane"]
        for value in numbers.values():
            if not isinstance(value, int | float):
                wrong = f"one of its numbers has the type {type(value).__name__}: use float(...)"
                raise DriverError(f"The ego {self._spec!r} returned {action!r} {at}; {wrong}.")
            if not math.isfinite(value) or abs(value) > MAX_ACTION_NUMBER:
                raise DriverError(
                    f"The ego {self._spec!r} returned {str(action)[:200]} {at}; its numbers must be finite, "
                    f"and at most {MAX_ACTION_NUMBER:g}."
                )
        if isinstance(action, LaneSpeed) and isinstance(action.lane, float):
            if not action.lane.is_integer():
                raise DriverError(f"The ego {self._spec!r} returned the lane {action.lane:g} {at}; give its index.")
            action = replace(action, lane=int(action.lane))
        if isinstance(action, Steer | LaneSpeed | PlannedPose) and (action.plan is not None or action.notes):
            try:
                return replace(action, plan=_plan(action.plan), notes=_notes(action.notes))
            except (TypeError, ValueError) as error:
                raise DriverError(f"The ego {self._spec!r} returned {type(action).__name__} {at}; {error}.") from error
        return action

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Ask the user's driver for its model; see the function ``model_of``.

        Raises:
            DriverError: The user's code fails.
            SimulationError: The user's code returns something other than a DriverModel.
        """
        model = self._call("failed in model_of", lambda: model_of(self._driver, numbers))
        if not isinstance(model, DriverModel):
            raise SimulationError(f"The ego {self._spec!r} returned {model!r}; model_of must return a DriverModel.")
        return model

    def _call(self, failure: str, call: Callable[[], T]) -> T:
        try:
            return call()
        except (OutOfTimeError, SystemExit, SumoError):
            raise
        except BaseException as error:  # user code, which may raise anything; Ctrl-C does not reach this process
            if ran_out_of_memory(error):
                raise
            raise DriverError(f"The ego {self._spec!r} {failure}: {in_one_line(error)}{_place(error)}.") from error


def _number_names(action: Steer | LaneSpeed | Pose) -> tuple[str, ...]:
    """Return the names of the numbers that move the ego."""
    if isinstance(action, Steer):
        return "acceleration", "steering"
    return ("lane", "speed") if isinstance(action, LaneSpeed) else ("x", "y", "heading", "speed")


def _plan(given: Any) -> Points | None:
    """Convert a plan to pairs of plain numbers; raise ValueError or TypeError if it is none."""
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
    """Convert notes to plain numbers by name; raise ValueError or TypeError if they are none."""
    if not isinstance(given, Mapping) or len(given) > MAX_NOTES:
        raise ValueError(f"its notes must be a mapping of at most {MAX_NOTES} names to numbers")
    notes = {str(name)[:MAX_NOTE_NAME_CHARACTERS]: float(value) for name, value in given.items()}
    if not all(math.isfinite(value) for value in notes.values()):
        raise ValueError("its notes must be finite numbers")
    return notes


def _plain(value: Any) -> Any:
    """Convert a number of numpy to one of Python."""
    return value.item() if isinstance(value, np.generic | np.ndarray) and np.ndim(value) == 0 else value


def _place(error: BaseException) -> str:
    """Return the file and line of an error in the user's code.

    It is the deepest call in the file that was called first. A base class of this package, such as ``PlannerEgo``, is
    not the user's code.
    """
    ours = f"{Path(__file__).parents[1]}{os.sep}"
    frames = [f for f in extract_tb(error.__traceback__) if not f.filename.startswith(ours)]
    if not frames:
        return ""
    deepest = [f for f in frames if f.filename == frames[0].filename][-1]
    return f" ({Path(deepest.filename).name}, line {deepest.lineno})"


def find_class(kind: str, spec: str) -> type:
    """Import a user's class.

    The module is searched on ``sys.path`` and then in the current folder. Classes of Python's standard library are
    refused before anything is imported. None of them is a driver, and making an object of one can have effects:
    ``subprocess:Popen`` starts a program.

    Args:
        kind: What error messages call the class.
        spec: The class as ``module:Class``.

    Raises:
        UsageError: The name has another form, the class belongs to the standard library, its module cannot be imported,
            or the module has no such class.
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
    """Return the name ``module:Class`` by which other processes import a driver.

    A script's module is the name of its file.

    Args:
        user_class: The driver's class.

    Raises:
        UsageError: The class lacks a method that a driver needs, or other processes cannot import it because it lies in
            a notebook or in a function.
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
    """Make an object of a user's class.

    The class is checked for its methods before an object is made, so that no code of an unsuitable class runs.

    Args:
        kind: What error messages call the class.
        spec: The class as ``module:Class``.
        parameters: Arguments of its constructor.
        methods: The signatures of the methods that it must have, by name.

    Raises:
        UsageError: The class cannot be found (see ``find_class``), lacks a method, or the object cannot be made.
    """
    user_class = find_class(kind, spec)
    _check_methods(kind, spec, user_class, methods)
    try:
        return user_class(**parameters)
    except (Exception, SystemExit) as error:  # user code
        raise UsageError(f"The {kind} {spec!r} could not be made: {in_one_line(error)}.") from error


COMMAND_LINE_READERS = ("absl", "argparse", "click", "docopt", "fire", "getopt", "optparse", "typer")
"""Packages that read the command line of the process, and end it."""
MAX_MODULE_OUTPUT_CHARACTERS = 200  # quoted from the output of a module in a message


class _Words:
    """Replaces ``sys.stdout`` and ``sys.stderr`` while a module is imported, and keeps what is written.

    ``pass_on`` writes the kept text to ``to``; from then on, all text goes there.
    """

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
    """Import the user's module. Its output goes to stderr, because stdout may be one JSON object.

    Raises:
        UsageError: Its code fails, ends the process or reads its command line; the message has its last line of output.
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
    """Raise UsageError if a class or an object lacks one of ``methods`` (name -> signature)."""
    for name in methods:
        if not callable(getattr(thing, name, None)):
            raise UsageError(f"The {kind} {spec!r} has no method {name!r}; it needs {' and '.join(methods.values())}.")


def in_one_line(error: BaseException) -> str:
    """Return the type and message of an exception on one line, without a full stop at the end."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def _in_standard_library(module_name: str) -> bool:
    """Return whether the module belongs to Python's standard library; a script that runs as ``__main__`` does not."""
    top = module_name.partition(".")[0]
    return top != "__main__" and (top in sys.stdlib_module_names or top in sys.builtin_module_names)


def _not_yours(kind: str, spec: str) -> UsageError:
    return UsageError(f"The {kind} {spec!r} is a class of Python's standard library: name a class of your own.")


OBJECT_PREFIX = "object:"  # begins the names of given drivers; a user's module cannot be called ``object``


@dataclass(frozen=True, slots=True)
class GivenEgo:
    """A driver as bytes.

    Attributes:
        name: ``object:`` and the name of the class.
        made: Whether it is an object. Otherwise, it is a class, and the object is still to be made.
        content: The bytes.
    """

    name: str
    made: bool
    content: bytes


def pack_driver(ego: Any) -> GivenEgo:
    """Convert a class or an object to bytes.

    Args:
        ego: The user's class or object.

    Raises:
        UsageError: It lacks a method that a driver needs, or cannot be converted to bytes.
    """
    import cloudpickle

    made = not isinstance(ego, type)
    name = OBJECT_PREFIX + (type(ego) if made else ego).__name__
    _check_methods("ego", name, ego, METHODS)
    try:
        return GivenEgo(name, made, cloudpickle.dumps(ego))
    except Exception as error:  # whatever the user's object raises
        raise UsageError(
            f"The ego {name!r} cannot be sent to the engine's process ({in_one_line(error)}): make what cannot be "
            "copied in reset, or give the class instead of an object."
        ) from error


def unpack_driver(given: GivenEgo, parameters: Mapping[str, Any]) -> Any:
    """Convert bytes back to a driver.

    Args:
        given: The driver as bytes.
        parameters: Arguments of the constructor, if the object is still to be made.

    Raises:
        UsageError: The driver cannot be made.
    """
    import cloudpickle

    try:
        ego = cloudpickle.loads(given.content)
        return ego if given.made else ego(**parameters)
    except (Exception, SystemExit) as error:  # user code
        raise UsageError(f"The ego {given.name!r} could not be made: {in_one_line(error)}.") from error


def lost(name: str, path: str) -> UsageError:
    """Return the error that a driver was given as an object, which ``path`` does not contain.

    Args:
        name: The name of the driver.
        path: What does not contain it.
    """
    return UsageError(
        f"{path} was driven by an object from Python, {name.removeprefix(OBJECT_PREFIX)!r}, which no file holds: "
        "give it again with sumo_adv.run(ego=...)."
    )


ENTRY_POINTS = "sumo_adv.drivers"


def _fiss_plus(parameters: Mapping[str, Any]) -> EgoController:
    """Make FISS+. Its package is an extra and is imported only for this driver."""
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
"""Built-in drivers by name; each value makes the driver from its parameters."""


def make_ego(name: str, parameters: Mapping[str, Any], given: GivenEgo | None = None) -> EgoController:
    """Make a controller.

    Args:
        name: A key of ``DRIVERS``, the name of an entry point, ``module:Class``, or the name of the driver in
            ``given``.
        parameters: The driver's parameters.
        given: The driver as bytes, if it was given as a class or an object.

    Raises:
        UsageError: The name or a parameter is unknown, or the class cannot be used.
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
    """Check that a driver has this name. A ``module:Class`` is not imported.

    Raises:
        UsageError: No driver has that name.
    """
    names = (*DRIVERS, *_installed())
    if ":" not in name and name not in names:
        raise UsageError(f"There is no ego {name!r}{nearest(name, names)}; choose {', '.join(names)} or module:Class.")


def is_foreign(name: str) -> bool:
    """Return whether the driver is a class of another package, which runs with the user's rights."""
    return ":" in name or (name not in DRIVERS and name in _installed())


def trusted_driver(named: str | None, recorded: str | None, path: Path) -> str | None:
    """Choose the driver of a run that a file or folder records.

    Args:
        named: The driver that the user named, if any.
        recorded: The driver that ``path`` records, if any.
        path: The file or folder.

    Returns:
        The named driver or, without one, the recorded driver; None if there is neither.

    Raises:
        UsageError: Only ``path`` names the driver, and the driver is a class of another package or was given as an
            object.
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
    """Return the drivers of other packages: name -> ``module:Class``."""
    return {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}


class ExternalEgo:
    """The ego of ``serve``: a client of the same SUMO drives it over TraCI. Its vType stays as the demand gives it."""

    name = "external"
    forkable = False
    needs_observation = False
    sumo_type: Mapping[str, str] = {}

    def reset(self, seed: int) -> None:
        """Do nothing: the client holds the state."""

    def act(self, observation: Observation) -> Action:
        """Return None; this method is never called."""
        return None
