"""How a planner from outside becomes an ego: run it with ``--ego adapter:BroughtPlanner`` from this folder.

Each method translates one thing. Replace ``tiny_planner`` by your planner, and each method by what yours needs.
"""

import math

import numpy as np
import tiny_planner
from tiny_planner import Route, State

from sumo_adv import Observation, PlannedPose, Pose

AXLE = 1.4  # m from the rear axle to the centre of the box
BEHIND = 10.0  # m of the route that are kept
REPLAN = 0.5  # s
WIDE = 0.3  # m more than its width: a vehicle so near to the route is in the way


class BroughtPlanner:
    """Plans twice a second, and in between drives on along the plan."""

    name = "brought"
    forkable = True  # nothing but numbers inside

    def reset(self, seed: int) -> None:
        """A run begins: forget the route and the plan."""
        self.path, self.route, self.plan, self.begun = None, None, [], -math.inf

    def act(self, seen: Observation) -> Pose | None:
        """The pose after this step; None (SUMO drives) without a route, and where the ego leaves the network."""
        if seen.path is not None and seen.path is not self.path:
            self.path, self.route, self.plan = seen.path, Route(self.joined(np.array(seen.path))), []
        if self.route is None or seen.road is None or seen.road.leaves:
            return None
        if not self.plan or seen.time - self.begun > REPLAN - 1e-6:
            leaders = self.leaders(seen)
            self.plan = tiny_planner.plan(self.state(seen.ego), self.route, seen.road.limit, leaders)
            self.begun = seen.time
        after = self.pose(self.at(self.since_plan(seen.time) + seen.dt))
        ahead = [self.pose(state) for state in self.plan[::5]]  # for the replay page; the simulation does not need it
        notes = {"age of the plan [s]": self.since_plan(seen.time)}
        return PlannedPose(after.x, after.y, after.heading, after.speed, [(p.x, p.y) for p in ahead], notes)

    def joined(self, path: np.ndarray) -> np.ndarray:
        """The path, with the route behind it: it begins at the centre of the ego, and the rear axle is further back."""
        if self.route is None:
            return path
        begins = self.route.locate(*path[0])[0]
        behind = (self.route.station > begins - BEHIND) & (self.route.station < begins - 0.5)
        return np.vstack([self.route.points[behind], path])

    # -- time: ours is the simulation's, the plan's begins with the plan

    def since_plan(self, now: float) -> float:
        """Seconds since the plan was made. Without the subtraction the plan is read at the wrong place."""
        return now - self.begun

    def at(self, since: float) -> State:
        """The plan's state at one of its own times [s]."""
        return self.plan[min(round(since / tiny_planner.STEP), len(self.plan) - 1)]

    # -- frame: our point is the centre, and our angles are rad counter-clockwise from east

    def state(self, ego) -> State:
        """The ego as the planner wants it."""
        x, y = ego.x - AXLE * math.cos(ego.heading), ego.y - AXLE * math.sin(ego.heading)
        return State(x, y, 90.0 - math.degrees(ego.heading), ego.speed)

    def pose(self, state: State) -> Pose:
        """The planner's state as an answer."""
        heading = math.radians(90.0 - state.azimuth)
        return Pose(
            state.x + AXLE * math.cos(heading), state.y + AXLE * math.sin(heading),
            math.remainder(heading, math.tau), state.speed,
        )  # fmt: skip

    # -- what is in the way: other vehicles on the route, and a line at which the ego must wait

    def leaders(self, seen: Observation) -> list[tuple[float, float]]:
        """Station of the rear [m], less what the ego is longer than to its rear axle, and speed [m/s]."""
        front, leaders = AXLE + seen.ego.length / 2, []
        here = self.route.locate(self.state(seen.ego).x, self.state(seen.ego).y)[0]
        for vehicle in seen.others:
            station, offset = self.route.locate(vehicle.x, vehicle.y)
            turn = vehicle.heading - self.route.at(station, 0.0)[2]
            long = (vehicle.length * abs(math.cos(turn)) + vehicle.width * abs(math.sin(turn))) / 2
            wide = (vehicle.width * abs(math.cos(turn)) + vehicle.length * abs(math.sin(turn))) / 2
            if station > here + AXLE and abs(offset) < wide + seen.ego.width / 2 + WIDE:
                leaders.append((station - long - front, max(vehicle.speed * math.cos(turn), 0.0)))
        if seen.road.must_wait:
            ahead = seen.road.stop_lines[0].ahead - seen.ego.length / 2  # m from the front bumper
            leaders.append((here + ahead + tiny_planner.GAP - 1.0, 0.0))  # it stops 1 m before the line
        return leaders
