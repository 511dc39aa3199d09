"""The former address of the names that a driver needs; it goes with version 0.3. Import them from ``sumo_adv``."""

import warnings

from sumo_adv.drivers import *  # noqa: F403 - the same names
from sumo_adv.drivers import __all__ as __all__

warnings.warn("sumo_adv.world.egos is now sumo_adv.drivers; import from there or from sumo_adv.", FutureWarning, 2)
