"""Find SUMO's library and programs.

The programs come from the ``eclipse-sumo`` wheel, otherwise from ``SUMO_HOME``, and otherwise from the path.
"""

from __future__ import annotations

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from sumo_adv.errors import SimulationError, UsageError


def find_sumo() -> Path:
    """Return the program ``sumo``.

    Raises:
        UsageError: The program is not installed.
    """
    if program := _find("sumo"):
        return program
    raise UsageError(
        "The program sumo was not found: install it with pip install 'sumo-adv[sumo]', or set SUMO_HOME to where it is."
    )


def find_netconvert() -> Path:
    """Return the program ``netconvert``.

    Raises:
        UsageError: The program is not installed.
    """
    if program := _find("netconvert"):
        return program
    raise UsageError("Converting needs netconvert, which is not installed: pip install 'sumo-adv[sumo]'.")


def find_type_maps(netconvert: Path) -> Path:
    """Return the folder of SUMO's type maps, which come with ``netconvert``.

    A type map gives the width and speed of each kind of road.

    Args:
        netconvert: The program.

    Returns:
        The folder.

    Raises:
        UsageError: There is no such folder.
    """
    homes = [netconvert.resolve().parent.parent, netconvert.resolve().parent.parent / "share" / "sumo"]
    if home := os.environ.get("SUMO_HOME"):
        homes.append(Path(home))
    for folder in homes:
        if (folder / "data" / "typemap").is_dir():
            return folder / "data" / "typemap"
    raise UsageError(f"SUMO's folder data/typemap was not found beside {netconvert}: set SUMO_HOME to where it is.")


def set_data_folders() -> None:
    """Set the variables by which SUMO finds its data (emission models, projections) to the installed wheel.

    Variables that the user has set are kept.
    """
    wheel = find_spec("sumo_data")
    for folder in (wheel.submodule_search_locations or ()) if wheel else ():
        os.environ.setdefault("SUMO_HOME", folder)
        if "PROJ_LIB" not in os.environ and "PROJ_DATA" not in os.environ:
            os.environ["PROJ_LIB"] = os.environ["PROJ_DATA"] = str(Path(folder) / "data" / "proj")


def _find(program: str) -> Path | None:
    """Return a program of SUMO, or None."""
    set_data_folders()
    name = f"{program}.exe" if sys.platform == "win32" else program
    wheel = find_spec("sumo")
    homes = [Path(folder) for folder in (wheel.submodule_search_locations or ())] if wheel else []
    if home := os.environ.get("SUMO_HOME"):
        homes.append(Path(home))
    for folder in homes:
        if (folder / "bin" / name).is_file():
            return folder / "bin" / name
    on_path = shutil.which(name)
    return None if on_path is None else Path(on_path)


SYSTEM_LIBRARIES = "libx11-6 libxext6 libxrender1 libgl1 libexpat1 libatomic1"


def load_libsumo() -> ModuleType:
    """Import ``libsumo``.

    Returns:
        The module.

    Raises:
        SimulationError: The module does not load; the message names what to install.
    """
    try:
        import libsumo
    except ImportError as error:
        fault = " ".join(str(error).split())
        remedy = (
            f"install its system libraries (Debian: apt-get install {SYSTEM_LIBRARIES})"
            if ".so" in fault
            else "install it again (pip install --force-reinstall libsumo)"
        )
        raise SimulationError(f"SUMO's library libsumo does not load ({fault}): {remedy}.") from error
    set_data_folders()  # the import sets them only once, and each episode begins with the variables of its front
    module: ModuleType = libsumo
    return module
