"""Check whether a driver is ready to be tested.

The driver drives unattacked, and the check names faults of the driver or of its adapter. ``check_driver`` drives it
through scenarios and returns the findings. ``sumo-adv doctor --ego NAME`` prints them.
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
