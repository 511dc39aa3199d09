"""Your own generator in the benchmark: the most dangerous vehicle drifts to where the ego will be."""

import numpy as np

from sumo_adv.benchmark.nouns import course_proposal
from sumo_adv.datatypes import PrescribedMotion


class StraightAtIt:
    def begin(self, encounter):
        self.delay, self.situation = min(encounter.situations.items())

    def propose(self, tried):
        if len(tried) == 6:
            return None
        ego, path, bv = self.situation.ego, self.situation.baseline.path, self.situation.target_list()[0].state
        s, d = path.project(bv.x, bv.y)
        time = self.situation.dt * np.arange(1, 101)
        u = np.minimum(time / (5.0 + len(tried)), 1.0)  # slower with every attempt
        share = u**3 * (10 - 15 * u + 6 * u**2)
        station = (1 - share) * (s + bv.speed * time) + share * (ego.speed * time + 3.0)
        x, y, heading = path.at(station, d * (1 - share))
        speed = np.maximum(np.gradient(station, self.situation.dt), 0.0)
        return course_proposal("mine", bv.id, self.delay, PrescribedMotion(x, y, heading, speed))
