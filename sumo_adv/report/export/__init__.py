"""A run in other tools' formats: OpenSCENARIO with OpenDRIVE, SUMO's FCD, a SUMO replay, one CSV table."""
