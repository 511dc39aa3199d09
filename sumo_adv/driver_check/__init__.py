"""Whether a driver is ready to be tested: it drives unattacked, and faults of the driver or of its adapter are named.

``check_driver`` drives it through scenarios and returns what it found; ``sumo-adv doctor --ego NAME`` prints that.
"""

from sumo_adv.driver_check.check import (
    DRIVE_DURATION_S,
    Checked,
    DriverCheck,
    by_name,
    check_driver,
    shipped_drive,
    twelve,
)
from sumo_adv.driver_check.findings import FINDING_MEANINGS, DriverFinding, FindingKind

__all__ = [
    "DRIVE_DURATION_S",
    "FINDING_MEANINGS",
    "Checked",
    "DriverCheck",
    "DriverFinding",
    "FindingKind",
    "by_name",
    "check_driver",
    "shipped_drive",
    "twelve",
]
