"""The replay page of a run: one HTML file that needs nothing else."""

from sumo_adv.report.page.make import make_page

__all__ = ["make_page"]
