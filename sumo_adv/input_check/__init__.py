"""Whether an input is run as SUMO runs it, and what was read of it."""

from sumo_adv.input_check.check import InputCheck, check_input
from sumo_adv.input_check.motions import MotionComparison
from sumo_adv.input_check.worker import WatchWorker

__all__ = ["InputCheck", "MotionComparison", "WatchWorker", "check_input"]
