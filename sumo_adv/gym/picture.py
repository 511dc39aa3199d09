"""A picture of an episode: the lanes and the vehicles around the ego, from above, north up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.simulation.layers import covers
from sumo_adv.simulation.network import RoadMap

PICTURE_SIZE_PX = 480
PICTURE_RADIUS_M = 60.0  # from the centre to each side
GROUND_RGB, ASPHALT_RGB, PAINT_RGB = (236, 238, 232), (150, 152, 156), (214, 216, 218)
EMPTY_PICTURE: NDArray[np.uint8] = np.full((PICTURE_SIZE_PX, PICTURE_SIZE_PX, 3), GROUND_RGB, np.uint8)
VEHICLE_RGB = {"ego": (31, 102, 184), "adversary": (200, 48, 40), "other": (245, 245, 245)}


def draw_picture(
    road: RoadMap, drive: Drive, ego: str, adversary: str | None, middle: VehicleState
) -> NDArray[np.uint8]:
    """Draw the scene.

    Args:
        road: The road network.
        drive: The simulation.
        ego: The id of the ego.
        adversary: The id of the adversary; None without one.
        middle: The state at the centre of the picture.

    Returns:
        The image, ``(PICTURE_SIZE_PX, PICTURE_SIZE_PX, 3)``.
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (PICTURE_SIZE_PX, PICTURE_SIZE_PX), GROUND_RGB)
    pen, scale = ImageDraw.Draw(image), PICTURE_SIZE_PX / (2 * PICTURE_RADIUS_M)

    def pixel(x: float, y: float) -> tuple[float, float]:
        return PICTURE_SIZE_PX / 2 + (x - middle.x) * scale, PICTURE_SIZE_PX / 2 - (y - middle.y) * scale

    strips = road.strips(middle.x, middle.y, 2 * PICTURE_RADIUS_M)
    for strip in strips:
        line = [pixel(x, y) for x, y in strip.shape[:, :2].tolist()]
        pen.line(line, fill=ASPHALT_RGB, width=math.ceil(strip.width * scale) + 1, joint="curve")
    for strip in strips:
        for side in () if strip.internal else (-strip.width / 2, strip.width / 2):
            pen.line([pixel(x, y) for x, y in beside(strip.shape[:, :2], side)], fill=PAINT_RGB)
    for name in drive.snapshot.raw:
        v = drive.state(name)
        if math.hypot(v.x - middle.x, v.y - middle.y) > 2 * PICTURE_RADIUS_M:
            continue
        if name not in (ego, adversary) and any(bool(covers(s.shape, s.width, v.x, v.y, v.z)) for s in strips):
            continue
        kind = "ego" if name == ego else "adversary" if name == adversary else "other"
        c, s, ahead, left = math.cos(v.heading), math.sin(v.heading), v.length / 2, v.width / 2
        corners = [(ahead, left), (ahead, -left), (-ahead, -left), (-ahead, left)]
        outline = [pixel(v.x + c * a - s * b, v.y + s * a + c * b) for a, b in corners]
        pen.polygon(outline, fill=VEHICLE_RGB[kind], outline=(40, 40, 40))
    return np.asarray(image)


def beside(line: Floats, offset: float) -> list[list[float]]:
    """Move the points of a line to the left of its direction.

    Args:
        line: The points, ``(n, 2)`` [m].
        offset: The distance [m].
    """
    along = np.gradient(line, axis=0)
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)
    left = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None]
    moved: list[list[float]] = (line + offset * left).tolist()
    return moved
