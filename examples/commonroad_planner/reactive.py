"""CommonRoad's reactive planner as an ego: run it with ``--ego reactive:Reactive`` from this folder.

The package is ``commonroad-reactive-planner``. It samples trajectories along the reference path, for the rear axle, and
takes the cheapest trajectory that the car can drive and that hits nothing.
"""

from itertools import pairwise

from commonroad_clcs.config import CLCSParams
from commonroad_clcs.pycrccosy import CartesianProjectionDomainError
from commonroad_rp.reactive_planner import ReactivePlanner
from commonroad_rp.state import ReactivePlannerState
from commonroad_rp.utility.config import ReactivePlannerConfiguration
from commonroad_rp.utility.utils_coordinate_system import CoordinateSystem

from sumo_adv.commonroad import PlannerEgo

STEPS = 30  # of a plan, each of 0.1 s
BRAKING = 0.7  # of the planner's greatest acceleration (11.5 m/s2) that it may brake with

STANDING = 0.1  # m/s
LEVELS = 3  # each samples more densely than the one before; a fourth takes seconds


def planner_for(scenario, problem, reference_path, length, width):
    """The planner at the initial state of a problem, for a car of a length and a width [m]."""
    config = ReactivePlannerConfiguration()
    config.vehicle.length, config.vehicle.width = length, width
    config.planning.time_steps_computation = STEPS
    config.sampling.max_deceleration_ratio, config.sampling.num_sampling_levels = BRAKING, LEVELS
    config.debug.multiproc, config.debug.logging_level = False, "ERROR"
    config.update(scenario=scenario, planning_problem=problem)
    planner = ReactivePlanner(config)
    planner.set_reference_path(coordinate_system=CoordinateSystem(reference_path, clcs_params=CLCSParams()))
    return planner


def centred(states, axle):
    """The planner's states, moved from its rear axle to the centre of the box. Where it stands they do not turn."""
    centres = [ReactivePlannerState.shift_state_to_center(state, axle) for state in states]
    for before, state in pairwise(centres):
        if state.velocity < STANDING:
            state.position, state.orientation = before.position, before.orientation
    return centres


class Reactive(PlannerEgo):
    """Plans twice a second, for the next three seconds."""

    forkable = True  # one process, and nothing but numbers inside
    horizon = STEPS * PlannerEgo.time_step

    def plan(self, scene):
        """Plan with the lanelets that lead the ego's way."""
        ego, road = scene.observation.ego, scene.observation.road
        planner = planner_for(scene.scenario, scene.problem, scene.reference_path, ego.length, ego.width)
        # Without this, the planner may also use the lanelets of oncoming traffic.
        ours = [lane.id for lane in road.lanes if lane.junction or lane.relation != "oncoming"]
        planner.set_permitted_lanelet_ids([scene.lanelets[name] for name in ours])
        # With a present speed of 0, the planner would want to stay at rest.
        planner.set_desired_velocity(scene.speed_limit, max(ego.speed, 0.01))
        try:
            found = planner.plan()
        except TypeError:  # version 2025.1 fails in its own log if the ego stands and every sample hits something
            return None
        except CartesianProjectionDomainError:  # the ego is beside the reference path, or past its end
            return None
        return None if found is None else centred(found[0].state_list, planner.vehicle_params.wb_rear_axle)
