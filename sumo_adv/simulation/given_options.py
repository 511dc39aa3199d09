"""List SUMO's options that users may give, with the type of each value. Others belong to the program or are refused.

This one list serves every way to give options: a .sumocfg, ``--option``, settings, a case, a manifest. It holds only
long names. None of these options reads or writes a file, opens a port or loads a state. An option that is missing here
must be reviewed before it is added.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

from sumo_adv.errors import UsageError, nearest

Kind = Literal["switch", "number", "whole number", "time", "text"]
MAX_OPTION_NUMBER = 1e9  # maximum absolute value of a number or time
MAX_OPTION_INTEGER = 1_000_000  # SUMO allocates memory in proportion to some of them
MAX_OPTION_CHARACTERS = 10_000
VARIABLE, HOME = "${", "~"  # SUMO replaces an environment variable, and the home at a start, even on its command line

_BY_KIND: Mapping[Kind, str] = {
    "switch": """
        collision.check-junctions eager-insert emergency-insert emissions.volumetric-fuel extrapolate-departpos
        ignore-accidents ignore-route-errors junction-taz lanechange.overtake-right mapmatch.junctions mapmatch.taz
        overhead-wire.recuperation overhead-wire.solver overhead-wire.substation-current-limits parking.maneuver
        pedestrian.striping.legacy-departposlat persontrip.ride-public-line railsignal-moving-block replay-rerouting
        slope-centered sloppy-insert step-method.ballistic time-to-teleport.remove time-to-teleport.remove-constraint
        tls.all-off use-stop-ended use-stop-started weights.random-factor.dynamic
        device.battery.deterministic device.battery.track-fuel device.bluelight.deterministic
        device.btreceiver.all-recognitions device.btreceiver.deterministic device.btsender.deterministic
        device.driverstate.deterministic device.elechybrid.deterministic device.emissions.deterministic
        device.friction.deterministic device.glosa.deterministic device.glosa.ignore-cfmodel
        device.glosa.override-safety device.glosa.use-queue device.rerouting.bike-speeds device.rerouting.deterministic
        device.rerouting.init-with-loaded-weights device.rerouting.invalidation device.rerouting.railsignal
        device.rerouting.synchronize device.rerouting.with-taz device.stationfinder.checkEnergyForRoute
        device.stationfinder.deterministic device.taxi.deterministic device.toc.deterministic device.toc.mrmKeepRight
        device.toc.useColorScheme person-device.btreceiver.deterministic person-device.btsender.deterministic
        person-device.rerouting.deterministic
    """,
    "number": """
        collision.check-junctions.mingap collision.mingap-factor default.action-step-length default.speeddev
        emergencydecel.warning-threshold lateral-resolution mapmatch.distance phemlight-temperature
        pedestrian.jupedsim.exit-tolerance pedestrian.jupedsim.range-geometry-repulsion
        pedestrian.jupedsim.range-neighbor-repulsion pedestrian.jupedsim.strength-geometry-repulsion
        pedestrian.jupedsim.strength-neighbor-repulsion pedestrian.striping.dawdling pedestrian.striping.jamfactor
        pedestrian.striping.mingap-to-vehicle pedestrian.striping.reserve-oncoming
        pedestrian.striping.reserve-oncoming.junctions pedestrian.striping.reserve-oncoming.max
        pedestrian.striping.stripe-width pedestrian.timegap-crossing persontrip.walk-opposite-factor
        persontrip.walkfactor railsignal.max-block-length railsignal.moving-block.max-dist railway.max-train-length
        ride.stop-tolerance scale time-to-teleport.highways.min-speed tls.actuated.detector-length
        tls.actuated.jam-threshold tls.delay_based.detector-range tls.yellow.min-decel weights.minor-penalty
        weights.priority-factor weights.random-factor weights.reversal-penalty weights.separate-turns
        weights.tls-penalty weights.turnaround-penalty
        device.battery.probability device.bluelight.mingapfactor device.bluelight.probability
        device.bluelight.reactiondist device.btreceiver.offtime device.btreceiver.probability device.btreceiver.range
        device.btsender.probability device.driverstate.errorNoiseIntensityCoefficient
        device.driverstate.errorTimeScaleCoefficient device.driverstate.freeSpeedErrorCoefficient
        device.driverstate.headwayChangePerceptionThreshold device.driverstate.headwayErrorCoefficient
        device.driverstate.initialAwareness device.driverstate.maximalReactionTime device.driverstate.minAwareness
        device.driverstate.probability device.driverstate.speedDifferenceChangePerceptionThreshold
        device.driverstate.speedDifferenceErrorCoefficient device.elechybrid.probability device.emissions.probability
        device.friction.offset device.friction.probability device.friction.stdDev device.glosa.add-switchtime
        device.glosa.max-speedfactor device.glosa.min-speed device.glosa.probability device.glosa.range
        device.rerouting.adaptation-weight device.rerouting.cch-update-threshold.factor device.rerouting.probability
        device.rerouting.threshold.factor device.stationfinder.emptyThreshold
        device.stationfinder.maxDistanceToReplacedStop device.stationfinder.maxEuclideanDistance
        device.stationfinder.needToChargeLevel device.stationfinder.opportunisticChargeLevel
        device.stationfinder.probability device.stationfinder.replacePlannedStop device.stationfinder.reserveFactor
        device.stationfinder.saturatedChargeLevel device.taxi.probability device.toc.dynamicMRMProbability
        device.toc.dynamicToCThreshold device.toc.initialAwareness device.toc.lcAbstinence
        device.toc.maxPreparationAccel device.toc.mrmDecel device.toc.mrmSafeSpotDuration device.toc.ogChangeRate
        device.toc.ogMaxDecel device.toc.ogNewSpaceHeadway device.toc.ogNewTimeHeadway device.toc.probability
        device.toc.recoveryRate device.toc.responseTime person-device.btreceiver.probability
        person-device.btsender.probability person-device.rerouting.probability
    """,
    "whole number": """
        device.rerouting.adaptation-steps device.rerouting.cch-ensemble max-num-persons max-num-teleports
        max-num-vehicles pedestrian.striping.walkingarea-detail phemlight-year
    """,
    "time": """
        collision.stoptime end ignore-junction-blocker intermodal-collision.stoptime keep-after-arrival
        lanechange.duration
        max-depart-delay pedestrian.jupedsim.step-length pedestrian.striping.jamtime
        pedestrian.striping.jamtime.crossing pedestrian.striping.jamtime.narrow persontrip.taxi.waiting-time
        random-depart-offset route-steps startup-wait-threshold time-to-impatience time-to-teleport
        time-to-teleport.bidi time-to-teleport.disconnected time-to-teleport.highways
        time-to-teleport.railsignal-deadlock time-to-teleport.ride waiting-time-memory
        device.emissions.begin device.emissions.period device.rerouting.adaptation-interval
        device.rerouting.cch-update-threshold.constant device.rerouting.period device.rerouting.pre-period
        device.rerouting.threshold.constant device.stationfinder.minOpportunityDuration device.stationfinder.radius
        device.stationfinder.repeat device.stationfinder.rescueTime device.stationfinder.waitForCharge
        device.taxi.dispatch-keep-unreachable device.taxi.dispatch-period person-device.rerouting.period
    """,
    "text": """
        collision.action default.carfollowmodel default.departlane default.departspeed default.emergencydecel
        insertion-checks intermodal-collision.action pedestrian.jupedsim.model pedestrian.model
        persontrip.default.group persontrip.transfer.car-walk persontrip.transfer.taxi-walk
        persontrip.transfer.walk-taxi railsignal.default-classes railsignal.moving-block.default-classes
        routing-algorithm scale-suffix weight-attribute
        device.battery.explicit device.bluelight.explicit device.btreceiver.explicit device.btsender.explicit
        device.driverstate.explicit device.elechybrid.explicit device.emissions.explicit device.friction.explicit
        device.glosa.explicit device.rerouting.explicit device.rerouting.mode device.stationfinder.chargeType
        device.stationfinder.chargingStrategy device.stationfinder.explicit device.stationfinder.rescueAction
        device.taxi.dispatch-algorithm device.taxi.explicit device.taxi.idle-algorithm device.taxi.vclasses
        device.toc.automatedType device.toc.explicit device.toc.manualType device.toc.mrmSafeSpot
        person-device.btreceiver.explicit person-device.btsender.explicit person-device.rerouting.explicit
        person-device.rerouting.mode person-device.rerouting.scope
    """,
}
OPTION_TYPES: Mapping[str, Kind] = {name: kind for kind, names in _BY_KIND.items() for name in names.split()}
"""The long name of each option that may be given, with the type of its value."""
_SWITCH = re.compile(r"1|0|yes|no|true|false|on|off|x|t|f", re.IGNORECASE | re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d{1,40}\.?\d{0,40}|\.\d{1,40})([eE][+-]?\d{1,3})?", re.ASCII)
_CLOCK = re.compile(r"(\d{1,9}:)?\d{1,9}:\d{1,9}:\d{1,9}(\.\d{1,9})?", re.ASCII)


def check(options: Mapping[str, str]) -> None:
    """Refuse options that may not be given, or whose value has the wrong type.

    Args:
        options: The values by long name.

    Raises:
        UsageError: An option is refused.
    """
    for name, value in options.items():
        if name not in OPTION_TYPES:
            raise UsageError(
                f"SUMO's option '{name[:80]}' is not one that can be given{nearest(name, OPTION_TYPES)}: leave it out."
            )
        if not isinstance(value, str) or not _fits(OPTION_TYPES[name], value):
            kind = {"time": "time [s]", "switch": "switch (true or false)"}.get(OPTION_TYPES[name], OPTION_TYPES[name])
            raise UsageError(f"SUMO's option '{name}' takes a {kind}, and not {str(value)[:80]!r}.")


def _fits(kind: Kind, value: str) -> bool:
    """Return whether a value has the type of an option."""
    if kind == "switch":
        return _SWITCH.fullmatch(value) is not None
    if kind == "text":
        plain = value.isprintable() and VARIABLE not in value
        return 0 < len(value) <= MAX_OPTION_CHARACTERS and plain and not value.startswith(("-", "+", HOME))
    if kind == "time" and _CLOCK.fullmatch(value):
        return True
    if _NUMBER.fullmatch(value) is None:
        return False
    if kind == "whole number":
        return value.lstrip("+-").isdecimal() and abs(int(value)) <= MAX_OPTION_INTEGER
    return abs(float(value)) <= MAX_OPTION_NUMBER
