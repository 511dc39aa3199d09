"""A hunt: the worst distinct failures of a driver that a time is enough for, over many inputs."""
