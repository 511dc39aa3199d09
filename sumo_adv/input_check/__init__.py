"""Check whether this program runs an input as SUMO does, and count what was read from it."""

from sumo_adv.input_check.check import InputCheck, check_input
from sumo_adv.input_check.motions import MotionComparison
from sumo_adv.input_check.worker import WatchWorker

__all__ = ["InputCheck", "MotionComparison", "WatchWorker", "check_input"]
