"""Numbers as the firmware reads and writes them: eight digits in, single precision inside, rounded decimals out."""

from __future__ import annotations

import math
import struct
from functools import lru_cache

MAX_DIGITS = 8  # further digits only shift the decimal point
MM_PER_INCH = 25.4
FACTORS = ((), (10.0,), (100.0,), (100.0, 10.0), (100.0, 100.0))  # to so many decimals


def f32(value: float) -> float:
    """Return `value` rounded to single precision, which is all the board has; infinite where that ends."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


TENTH, HUNDREDTH = f32(0.1), f32(0.01)
INCH_PER_MM = f32(0.0393701)


@lru_cache(maxsize=8192)
def scaled(digits: int, exponent: int) -> float:
    """Return digits · 10^exponent by the single-precision steps the board takes: hundredths first, then a tenth."""
    value = f32(float(digits))
    while exponent <= -2 and value:
        value, exponent = f32(value * HUNDREDTH), exponent + 2
    if exponent < 0:
        value = f32(value * TENTH)
    while exponent > 0 and value:
        value, exponent = f32(value * 10.0), exponent - 1
    return value


def read_number(text: str, at: int) -> tuple[float, int] | None:
    """Return the number that begins at `at` and where it ends, or None where there is no digit.

    No exponent: `E` is a letter to the firmware.
    """
    negative = text[at : at + 1] == "-"
    if text[at : at + 1] in ("-", "+"):
        at += 1
    digits, exponent, count, decimal = 0, 0, 0, False
    while at < len(text):
        sign = text[at]
        if "0" <= sign <= "9":
            count += 1
            if count <= MAX_DIGITS:
                digits = digits * 10 + int(sign)
                exponent -= decimal
            elif not decimal:
                exponent += 1
        elif sign == "." and not decimal:
            decimal = True
        else:
            break
        at += 1
    if not count:
        return None
    value = scaled(digits, exponent)
    return (-value if negative else value), at


def decimals(value: float, places: int) -> str:
    """Return `value` with `places` decimals, half rounded away from zero."""
    if not math.isfinite(value):
        return "inf"  # no job comes here; the board prints whatever its registers hold
    scaled_up = f32(abs(value))
    for factor in FACTORS[places]:
        scaled_up = f32(scaled_up * factor)
    count = int(f32(scaled_up + 0.5))
    sign = "-" if value < 0 else ""
    if places == 0:
        return f"{sign}{count}"
    whole, part = divmod(count, 10**places)
    return f"{sign}{whole}.{part:0{places}d}"


def coordinate(value_mm: float, inches: bool) -> str:
    """Return a length as reports show it: three decimals in mm, four in inches."""
    return decimals(f32(f32(value_mm) * INCH_PER_MM), 4) if inches else decimals(value_mm, 3)


def rate(value_mm_min: float, inches: bool) -> str:
    """Return a speed as reports show it: whole mm/min, or inches/min with one decimal."""
    return decimals(f32(f32(value_mm_min) * INCH_PER_MM), 1) if inches else decimals(value_mm_min, 0)
