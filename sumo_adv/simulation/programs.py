"""Finds SUMO: its library, and its programs (those of the ``eclipse-sumo`` wheel, else below ``SUMO_HOME``, else on the
path).
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
    """The program ``sumo``. Raises UsageError if it is not installed."""
    if program := _find("sumo"):
        return program
    raise UsageError(
        "The program sumo was not found: install it with pip install 'sumo-adv[sumo]', or set SUMO_HOME to where it is."
    )


def find_netconvert() -> Path:
    """The program ``netconvert``. Raises UsageError if it is not installed."""
    if program := _find("netconvert"):
        return program
    raise UsageError("Converting needs netconvert, which is not installed: pip install 'sumo-adv[sumo]'.")


def find_type_maps(netconvert: Path) -> Path:
    """The folder of SUMO's type maps (how wide and fast a kind of road is), which come with ``netconvert``. Raises
    UsageError if there is none."""
    homes = [netconvert.resolve().parent.parent, netconvert.resolve().parent.parent / "share" / "sumo"]
    if home := os.environ.get("SUMO_HOME"):
        homes.append(Path(home))
    for folder in homes:
        if (folder / "data" / "typemap").is_dir():
            return folder / "data" / "typemap"
    raise UsageError(f"SUMO's folder data/typemap was not found beside {netconvert}: set SUMO_HOME to where it is.")


def set_data_folders() -> None:
    """Set the variables by which SUMO's library and programs find their data (emission models, projections), where the
    user has not: to those of the installed wheel."""
    wheel = find_spec("sumo_data")
    for folder in (wheel.submodule_search_locations or ()) if wheel else ():
        os.environ.setdefault("SUMO_HOME", folder)
        if "PROJ_LIB" not in os.environ and "PROJ_DATA" not in os.environ:
            os.environ["PROJ_LIB"] = os.environ["PROJ_DATA"] = str(Path(folder) / "data" / "proj")


def _find(program: str) -> Path | None:
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
    """The module ``libsumo``. Raises SimulationError: it does not load; the sentence names what to install."""
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
    set_data_folders()  # importing it does so once, and an episode begins with the variables of its front
    module: ModuleType = libsumo
    return module
