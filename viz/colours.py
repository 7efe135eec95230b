"""Colours that stay apart for colour-blind eyes: Okabe and Ito's palette on a dark ground, and scales over it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.messages import ObjectClass

U8 = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

ORANGE: Colour = (230, 159, 0)
SKY: Colour = (86, 180, 233)
GREEN: Colour = (0, 190, 138)
YELLOW: Colour = (240, 228, 66)
BLUE: Colour = (0, 114, 178)
VERMILION: Colour = (213, 94, 0)
PURPLE: Colour = (204, 121, 167)
WHITE: Colour = (255, 255, 255)
GREY: Colour = (150, 150, 150)
GROUND: Colour = (12, 13, 18)
"""Background of the views."""
ROAD: Colour = (44, 47, 56)
EDGE: Colour = (110, 110, 125)
"""Outline of the grid."""

CLASS_COLOURS: dict[int, Colour] = {
    ObjectClass.UNKNOWN: GREY,
    ObjectClass.CAR: SKY,
    ObjectClass.TRUCK: YELLOW,
    ObjectClass.BUS: ORANGE,
    ObjectClass.MOTORCYCLE: GREEN,
    ObjectClass.BICYCLE: GREEN,
    ObjectClass.PEDESTRIAN: PURPLE,
}
CLASS_NAMES = {int(c): c.name.lower() for c in ObjectClass}
CLASS_HEIGHTS = {0: 1.5, 1: 1.5, 2: 3.4, 3: 3.2, 4: 1.5, 5: 1.6, 6: 1.75}
"""Height at which a box is drawn [m]; the messages know no heights."""

_CLASS = np.array([CLASS_COLOURS[i] for i in range(len(ObjectClass))], dtype=np.uint8)
_INFERNO = np.array(
    ((0, 0, 4), (31, 12, 72), (85, 15, 109), (136, 34, 106), (186, 54, 85), (227, 89, 51), (249, 140, 10),
     (249, 201, 50), (252, 255, 164)), dtype=np.float64,
)  # fmt: skip
_SLOW, _FAST = np.array((52, 78, 140.0)), np.array((150, 240, 255.0))


def of_class(cls: U8) -> U8:
    """Colour of each object, shape [n, 3]."""
    return np.asarray(_CLASS[cls])


def faded(colour: npt.ArrayLike, share: npt.ArrayLike) -> U8:
    """Colours [..., 3] brought towards the ground: 1 keeps them, 0 lets them vanish; lines know no transparency."""
    s = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0)[..., None]
    return np.asarray(np.asarray(colour) * s + np.array(GROUND) * (1 - s)).astype(np.uint8)


def of_speed(speed: npt.ArrayLike, top: float) -> U8:
    """Colour of desired speeds [m/s], dark blue at 0 to bright cyan at `top`; shape [..., 3]."""
    share = np.clip(np.asarray(speed, dtype=np.float64) / max(top, 1e-6), 0.0, 1.0)[..., None]
    return np.asarray(_SLOW + (_FAST - _SLOW) * share).astype(np.uint8)


def of_slice(n: int) -> U8:
    """Colour of n slices: near ones bright yellow, far ones blue; shape [n, 3]."""
    share = np.linspace(0.0, 1.0, max(n, 1))[:, None]
    return np.asarray(np.array(YELLOW) * (1 - share) + np.array(BLUE) * share).astype(np.uint8)


def see_through(n: int, faintest: float) -> npt.NDArray[np.uint32]:
    """The heatmaps' scale in n steps as RGBA in memory order, clear below `faintest`, opaque at the top; [n]."""
    share = np.linspace(0.0, 1.0, n)
    at = np.linspace(0.0, 1.0, len(_INFERNO))
    rgba = np.zeros((n, 4))
    for k in range(3):
        rgba[:, k] = np.interp(share, at, _INFERNO[:, k])
    rgba[:, 3] = 255 * np.clip(0.25 + 0.75 * share, 0.0, 1.0)
    rgba[share < faintest] = 0
    return rgba.astype(np.uint8).view(np.uint32)[:, 0]
