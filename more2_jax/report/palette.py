"""A color for every object that people who see colors differently can tell apart."""

from __future__ import annotations

# Found by a search from the hues of Okabe & Ito and P. Tol: any two are at least 20 apart (CIE76) to normal,
# protanopic, deuteranopic and tritanopic eyes, and each has a contrast of 2 or more with a white and with a
# nearly black ground. Beyond ten objects that cannot be had; objects also carry their number in the scene.
BASE = (
    (0, 101, 183),
    (245, 159, 9),
    (57, 160, 99),
    (199, 63, 2),
    (49, 198, 245),
    (123, 35, 217),
    (167, 188, 96),
    (195, 157, 181),
    (98, 68, 51),
    (96, 94, 132),
)
ROUNDS = (0.0, -0.3, 0.35, -0.5, 0.55)  # later rounds of the same hues: darker below 0, lighter above


def rgb(number: int) -> tuple[int, int, int]:
    """The color of object `number`, 0 to 255 a channel; ten hues, repeated darker and lighter."""
    red, green, blue = (
        _shade(c, ROUNDS[number // len(BASE) % len(ROUNDS)]) for c in BASE[number % len(BASE)]
    )
    return red, green, blue


def _shade(channel: int, amount: float) -> int:
    return round(channel * (1 + amount) if amount < 0 else channel + (255 - channel) * amount)


def color(number: int) -> str:
    """The same for CSS."""
    return "#{:02x}{:02x}{:02x}".format(*rgb(number))


def ink(number: int) -> str:
    """Black or white, whichever reads better on the object's color (WCAG relative luminance)."""
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb(number))
    ]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#000" if luminance + 0.05 > (1.05 * 0.05) ** 0.5 else "#fff"
