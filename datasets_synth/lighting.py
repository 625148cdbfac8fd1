"""Conditions of light: day, dusk, night, and light that changes during a run.

All are factors on the light that a world has by day, so that day changes nothing, and none touches geometry.
"""

from dataclasses import dataclass, fields

import numpy as np

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Illumination:
    """Factors (RGB) on the ambient light, the sun, the lamps, and what glows with daylight: sky and windows.

    ``odd_lamps`` is a further factor on lamps with odd numbers, most of which are off at night.
    """

    ambient: Colour = (1.0, 1.0, 1.0)
    sun: Colour = (1.0, 1.0, 1.0)
    lamps: Colour = (1.0, 1.0, 1.0)
    sky: Colour = (1.0, 1.0, 1.0)
    odd_lamps: Colour = (1.0, 1.0, 1.0)


DAY = Illumination()
INDOORS = {
    "day": DAY,
    "dusk": Illumination((0.38, 0.34, 0.32), (0, 0, 0), (0.9, 0.72, 0.5), (0.42, 0.30, 0.26)),
    "night": Illumination((0.06, 0.06, 0.075), (0, 0, 0), (0.6, 0.4, 0.2), (0.012, 0.014, 0.025), (0.04, 0.04, 0.04)),
}
OUTDOORS = {
    "day": Illumination(lamps=(0, 0, 0)),
    "dusk": Illumination((0.34, 0.32, 0.40), (0.34, 0.19, 0.10), (0.5, 0.38, 0.22), (0.45, 0.33, 0.32)),
    "night": Illumination((0.045, 0.05, 0.075), (0, 0, 0), (1.0, 0.74, 0.42), (0.006, 0.007, 0.014)),
}
CONDITIONS = ("day", "dusk", "night", "changing")
DARKENING = (0.25, 0.65, 1.0)  # shares of a changing run: until here day, here dusk, here half way to night
SWITCHED_OFF = (0.40, 0.48)  # somebody turns the lamps off, and on again
CLOUDS = 4.0  # clouds in a changing run
CLOUD_DEPTH = 0.4


def _blend(a: Illumination, b: Illumination, share: float) -> Illumination:
    def mix(name: str) -> Colour:
        red, green, blue = (
            (1 - share) * x + share * y for x, y in zip(getattr(a, name), getattr(b, name), strict=True)
        )
        return red, green, blue

    return Illumination(*(mix(field.name) for field in fields(Illumination)))


def _scaled(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


def illumination(condition: str, outdoors: bool, share: float) -> Illumination:
    """Return the light at ``share`` (0..1) of a run under one of CONDITIONS."""
    table = OUTDOORS if outdoors else INDOORS
    if condition != "changing":
        return table[condition]
    day_ends, dusk, end = DARKENING
    if share < dusk:
        light = _blend(table["day"], table["dusk"], max(0.0, (share - day_ends) / (dusk - day_ends)))
    else:
        light = _blend(table["dusk"], table["night"], 0.5 * (share - dusk) / (end - dusk))
    cloud = 1 - CLOUD_DEPTH * float(0.5 - 0.5 * np.cos(2 * np.pi * CLOUDS * share))
    lamps = 0.1 if SWITCHED_OFF[0] <= share < SWITCHED_OFF[1] else 1.0
    ambient, sun = _scaled(light.ambient, 0.5 + 0.5 * cloud), _scaled(light.sun, cloud)
    return Illumination(ambient, sun, _scaled(light.lamps, lamps), light.sky, light.odd_lamps)
