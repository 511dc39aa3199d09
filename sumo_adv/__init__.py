"""Online, retrieval-augmented generation of safety-critical scenarios inside SUMO."""

__version__ = "0.1.0"
