"""Define the errors of the ego's sensors. ``drivers/sensing.py`` applies them."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class EgoSensing(BaseModel):
    """The errors of the ego's sensors. By default, the driver sees everything within 120 m as it is."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position_noise: float = Field(default=0.0, ge=0, le=20)  # standard deviation along x and along y [m]
    speed_noise: float = Field(default=0.0, ge=0, le=20)  # standard deviation [m/s]
    range: float | None = Field(default=None, gt=0, le=120)  # between centres [m]; None: 120
    delay: float = Field(default=0.0, ge=0, le=5)  # age of the states that are seen of other vehicles [s]
    missed: float = Field(default=0.0, ge=0, le=1)  # share of vehicles that a step does not report
    seed: int = Field(default=0, ge=0, le=2**31 - 1)  # of the errors, in addition to the run's seed

    @property
    def is_on(self) -> bool:
        """Whether the driver sees anything different from the truth."""
        return bool(self.position_noise or self.speed_noise or self.delay or self.missed or self.range is not None)
