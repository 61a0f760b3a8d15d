"""casest: declare a sensor once, calibrate it, and know whether to believe the answer."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

#: Where each public name lives. Modules are imported when first used: CasADi and NumPy are slow
#: to start, and `casest --help` needs neither.
_HOME = {
    "casest.declaration.shapes": "diagonal each full lower rotation_matrix unit_vector",
    "casest.declaration.symbols": "attitude constant param signal",
    "casest.declaration.physics": (
        "Residual acos asin atan atan2 cos cosh cross der diag dot exp fabs fmax fmin horzcat "
        "if_else inf integral inverse log norm_2 pi polynomial quantity rotation sign sin sinh "
        "skew sqrt sum1 tan tanh vertcat"
    ),
    "casest.declaration.dimensions": "check_units",
    "casest.declaration.effect": "Effect effect",
    "casest.declaration.model": "Model model",
    "casest.data.run": "Run",
    "casest.data": "load_runs read_table",
    "casest.errors": ("CasestError DataError DeclarationError NotTrusted UnitError UsageError"),
    "casest.estimate.calibrate": "Estimate attempt calibrate",
    "casest.fleet.calibrate_many": "Batch calibrate_many",
    "casest.diagnose.closing": "Closing",
    "casest.diagnose.loop": "close",
    "casest.diagnose.motion.loop": "MotionClosing close_motion",
    "casest.correction.inverse": "Correction",
}
_WHERE = {name: module for module, names in _HOME.items() for name in names.split()}

__all__ = ["__version__", *sorted(_WHERE)]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"casest has no {name!r}")
    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return __all__
