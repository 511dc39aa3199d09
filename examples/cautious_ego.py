"""A driver of your own: it keeps three seconds of distance to whatever is in front of it, and swerves if it must."""

import math

from sumo_adv import LaneSpeed, Observation, Steer


class CautiousEgo:
    """Run it with ``--ego cautious_ego:CautiousEgo`` from this folder."""

    name = "cautious"
    forkable = True  # nothing but numbers inside: attempts may fork it

    def __init__(self, headway: float = 3.0, cruise: float = 12.0) -> None:
        self.headway, self.cruise = headway, cruise  # s, m/s

    def reset(self, seed: int) -> None:
        """Called before every run; there is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | Steer:
        """Slow down for the nearest vehicle ahead; brake hard and steer away when it is almost here."""
        ego, gap, side = seen.ego, math.inf, 0.0
        for neighbour in seen.others:
            dx, dy = neighbour.x - ego.x, neighbour.y - ego.y
            ahead = dx * math.cos(ego.heading) + dy * math.sin(ego.heading) - (ego.length + neighbour.length) / 2
            left = dy * math.cos(ego.heading) - dx * math.sin(ego.heading)
            if -1.0 < ahead < gap and abs(left) < 2.5:
                gap, side = ahead, left
        if gap < 0.3 * ego.speed:
            return Steer(acceleration=-8.0, steering=math.copysign(0.05, -side))
        desired = min(self.cruise, gap / self.headway)
        return LaneSpeed(lane=None, speed=max(desired, ego.speed - 4.0 * seen.dt))
