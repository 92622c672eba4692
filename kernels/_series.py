"""Elementary functions as Taylor series on small intervals, for many lanes at a time: text for the struct `Math`.

Each is reduced to a small interval first: exp by multiples of ln 2, log by powers of two, sin and cos by quarters of a turn;
constants are split so that the products of their leading parts are exact, with or without fused operations. What is added to SHIFT
is rounded to an integer, which its low bits then hold. Errors, in units in the last place:

| function | float32 | float64 |
| --- | --- | --- |
| exp, exp2, log | 1 | 1 |
| expm1, log1p | 2 | 2 |
| tanh | 3 | 3 |
| sin, cos, sinh, cosh, pow | 0.6, by way of double precision | 1.5 for sin and cos, the others by lanes |
| tan | 0.6, by way of double precision | 3 |
"""

import math
import re

from jfrnn.kernels._text import read_part


def fill(text: str, **names: str) -> str:
    """Return the text with names replaced: whole words, or what ends in a name that starts with an underscore."""
    pattern = "|".join(rf"{name}\b" if name[0] == "_" else rf"\b{name}\b" for name in names)
    return re.sub(pattern, lambda match: names[match[0]], text)


def for_each(types: tuple[dict[str, str], ...], *texts: str) -> str:
    """Return the texts once for each of some types."""
    return "".join(fill(text, **names) for names in types for text in texts)


def _polynomial(x: str, coefficients: list[float]) -> str:
    """Return an expression for a polynomial of REAL in Horner's form; its coefficients start at the lowest power."""
    text = f"of((NUMBER){coefficients[-1].hex()})"
    for c in reversed(coefficients[:-1]):
        text = f"mad({text}, {x}, of((NUMBER){c.hex()}))"
    return text


_FACTORS = [1 / math.factorial(k) for k in range(20)]
_LOG = [2 / (2 * k + 3) for k in range(11)]
_SINE = [(-1) ** k * _FACTORS[2 * k + 1] for k in range(1, 9)]
_COSINE = [(-1) ** k * _FACTORS[2 * k] for k in range(2, 10)]
_HALF_PI = ["0x1.921fb54400000p+0", "0x1.0b4611a600000p-34", "0x1.3198a2e037073p-69"]  # its sum; 33 bits in each of the first two

_FLOAT = {"REAL": "f32", "WHOLE": "i32", "NATURAL": "u32", "NUMBER": "float", "DIGITS": "23", "BIAS": "127"}
_FLOAT |= {"SHIFT": "0x1.8p+23f", "LN2_HIGH": "0x1.62e4p-1f", "LN2_LOW": "0x1.7f7d1cp-20f", "MANTISSA": "0x7fffff"}
_FLOAT |= {"EXP_LEAST": "-104.0f", "EXP_MOST": "89.0f", "EXP2_LEAST": "-151.0f", "EXP2_MOST": "129.0f", "EXPM1_LEAST": "-20.0f"}
_FLOAT |= {"NORMAL": "0x1p-126f", "UP": "25"}
_DOUBLE = {"REAL": "f64", "WHOLE": "i64", "NATURAL": "u64", "NUMBER": "double", "DIGITS": "52", "BIAS": "1023"}
_DOUBLE |= {"SHIFT": "0x1.8p+52", "LN2_HIGH": "0x1.62e42fee00000p-1", "LN2_LOW": "0x1.a39ef35793c76p-33"}
_DOUBLE |= {"MANTISSA": "0xfffffffffffffll", "EXP_LEAST": "-746.0", "EXP_MOST": "710.0", "EXP2_LEAST": "-1080.0"}
_DOUBLE |= {"EXP2_MOST": "1025.0", "EXPM1_LEAST": "-40.0", "NORMAL": "0x1p-1022", "UP": "54"}
_POLYNOMIALS = (
    {"EXP_SERIES": _polynomial("r", _FACTORS[2:8]), "LOG_SERIES": _polynomial("z", _LOG[:4])},
    {"EXP_SERIES": _polynomial("r", _FACTORS[2:14]), "LOG_SERIES": _polynomial("z", _LOG)},
)


_NUMBERS = {"LOG2_E": math.log2(math.e).hex(), "SQRT_HALF": math.sqrt(0.5).hex(), "LN_2": math.log(2).hex()}
_NUMBERS |= {"TWO_OVER_PI": (2 / math.pi).hex(), "SINE_SERIES": _polynomial("z", _SINE), "COSINE_SERIES": _polynomial("z", _COSINE)}
_NUMBERS |= dict(zip(("HALF_PI_HIGH", "HALF_PI_MIDDLE", "HALF_PI_LOW"), _HALF_PI, strict=True))


def _in_both(text: str) -> str:
    kinds = zip(_POLYNOMIALS, (_FLOAT, _DOUBLE), strict=True)
    return "".join(fill(fill(text, **series, **_NUMBERS), **names) for series, names in kinds)


SERIES = _in_both(read_part("series.h", "series"))
VECTOR_SERIES = _in_both(read_part("series.h", "vector_series")) + fill(
    fill(read_part("series.h", "double_series"), **_NUMBERS), **_DOUBLE
)
