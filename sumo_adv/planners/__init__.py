"""Planners: their text, the sandbox that runs it, their observations, and the trajectories to their endpoints."""
