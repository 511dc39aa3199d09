"""Planners: their text, the sandbox that runs it, what they are told, and the trajectories to their endpoints."""
