"""How the sensors of the ego's driver err; ``drivers/sensing.py`` makes them err so."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class EgoSensing(BaseModel):
    """How the sensors of the ego's driver err; the default is a driver that sees all within 120 m as it is."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position_noise: float = Field(default=0.0, ge=0, le=20)  # standard deviation along x and along y [m]
    speed_noise: float = Field(default=0.0, ge=0, le=20)  # standard deviation [m/s]
    range: float | None = Field(default=None, gt=0, le=120)  # m, between centres; None: 120
    delay: float = Field(default=0.0, ge=0, le=5)  # s, since other vehicles were where they are seen
    missed: float = Field(default=0.0, ge=0, le=1)  # share of vehicles that are not reported in a step
    seed: int = Field(default=0, ge=0, le=2**31 - 1)  # of the errors, beside that of the run

    @property
    def is_on(self) -> bool:
        """Whether the driver sees anything other than what is there."""
        return bool(self.position_noise or self.speed_noise or self.delay or self.missed or self.range is not None)
