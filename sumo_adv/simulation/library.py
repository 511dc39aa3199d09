"""SUMO as a library, and the Debian packages that it is linked with (for its drawing code, though nothing is drawn)."""

from __future__ import annotations

from types import ModuleType

from sumo_adv.errors import SimulationError

SYSTEM_LIBRARIES = "libx11-6 libxext6 libxrender1 libgl1 libexpat1 libatomic1"


def load_libsumo() -> ModuleType:
    """The module ``libsumo``.

    Raises:
        SimulationError: it does not load; the sentence names what to install.
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
    module: ModuleType = libsumo
    return module
