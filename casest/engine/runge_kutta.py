"""One step of Dormand and Prince's eighth-order Runge-Kutta method, in symbols.

Coefficients: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, DOP853. Two
embedded solutions, of fifth and third order, tell the step's error together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from casest.engine.operations import Floats

#: Order of the error estimate in the step's length, to which steps are fitted.
ORDER = 8
_A: tuple[Mapping[int, float], ...] = (
    {},
    {0: 0.05260015195876773},
    {0: 0.0197250569845379, 1: 0.0591751709536137},
    {0: 0.02958758547680685, 2: 0.08876275643042054},
    {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    {
        0: 0.03709200011850479,
        3: 0.17038392571223998,
        4: 0.10726203044637328,
        5: -0.015319437748624402,
        6: 0.008273789163814023,
    },
    {
        0: 0.6241109587160757,
        3: -3.3608926294469414,
        4: -0.868219346841726,
        5: 27.59209969944671,
        6: 20.154067550477894,
        7: -43.48988418106996,
    },
    {
        0: 0.47766253643826434,
        3: -2.4881146199716677,
        4: -0.590290826836843,
        5: 21.230051448181193,
        6: 15.279233632882423,
        7: -33.28821096898486,
        8: -0.020331201708508627,
    },
    {
        0: -0.9371424300859873,
        3: 5.186372428844064,
        4: 1.0914373489967295,
        5: -8.149787010746927,
        6: -18.52006565999696,
        7: 22.739487099350505,
        8: 2.4936055526796523,
        9: -3.0467644718982196,
    },
    {
        0: 2.273310147516538,
        3: -10.53449546673725,
        4: -2.0008720582248625,
        5: -17.9589318631188,
        6: 27.94888452941996,
        7: -2.8589982771350235,
        8: -8.87285693353063,
        9: 12.360567175794303,
        10: 0.6433927460157636,
    },
)
_B = {
    0: 0.054293734116568765,
    5: 4.450312892752409,
    6: 1.8915178993145003,
    7: -5.801203960010585,
    8: 0.3111643669578199,
    9: -0.1521609496625161,
    10: 0.20136540080403034,
    11: 0.04471061572777259,
}
_C = (
    0.0,
    0.05260015195876773,
    0.0789002279381516,
    0.1183503419072274,
    0.2816496580927726,
    0.3333333333333333,
    0.25,
    0.3076923076923077,
    0.6512820512820513,
    0.6,
    0.8571428571428571,
    1.0,
)
_THIRD = {
    0: -0.18980075407240762,
    5: 4.450312892752409,
    6: 1.8915178993145003,
    7: -5.801203960010585,
    8: -0.4226823213237919,
    9: -0.1521609496625161,
    10: 0.20136540080403034,
    11: 0.02265179219836082,
}
_FIFTH = {
    0: 0.01312004499419488,
    5: -1.2251564463762044,
    6: -0.4957589496572502,
    7: 1.6643771824549864,
    8: -0.35032884874997366,
    9: 0.3341791187130175,
    10: 0.08192320648511571,
    11: -0.022355307863886294,
}


def step(rate: Callable[[Any, float], Any], y: Any, h: Any) -> tuple[Any, Any, Any]:
    """y after a step of length h, and how far the fifth and the third order are from it.

    `rate(y, c)` is ẏ at the share c of the step.
    """
    k: list[Any] = []
    for row, c in zip(_A, _C, strict=True):
        moved = _combined(row, k)
        k.append(rate(y if moved is None else y + h * moved, c))
    after, fifth, third = (_combined(weights, k) for weights in (_B, _FIFTH, _THIRD))
    return y + h * after, h * fifth, h * third


def _combined(weights: Mapping[int, float], k: list[Any]) -> Any:
    """Σ weight·k; None of nothing."""
    total = None
    for j, weight in weights.items():
        term = weight * k[j]
        total = term if total is None else total + term
    return total


def error(fifth: Floats, third: Floats, scale: Floats) -> Floats:
    """Error of each of N steps over what is allowed, (N,), of differences (N, n); scale (n,)."""
    five = ((fifth / scale) ** 2).sum(axis=1)
    whole = five + 0.01 * ((third / scale) ** 2).sum(axis=1)
    return np.where(whole > 0, five / np.sqrt(np.where(whole > 0, whole, 1) * fifth.shape[1]), 0.0)
