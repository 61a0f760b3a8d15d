"""casest: declare a sensor once, calibrate it, and know whether to believe the answer."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# The one list of public names. A type checker reads it as it stands; at run time a name's module
# is imported when the name is first used, and which one that is, is read from these same lines:
# CasADi and NumPy are slow to start, and `casest --help` needs neither.
if TYPE_CHECKING:
    from casest.correction.inverse import Correction as Correction
    from casest.data import load_runs as load_runs
    from casest.data import read_table as read_table
    from casest.data.run import Run as Run
    from casest.declaration.dimensions import check_units as check_units
    from casest.declaration.effect import Effect as Effect
    from casest.declaration.effect import effect as effect
    from casest.declaration.flow import integrate as integrate
    from casest.declaration.model import Model as Model
    from casest.declaration.model import model as model
    from casest.declaration.physics import Residual as Residual
    from casest.declaration.physics import acos as acos
    from casest.declaration.physics import asin as asin
    from casest.declaration.physics import atan as atan
    from casest.declaration.physics import atan2 as atan2
    from casest.declaration.physics import before as before
    from casest.declaration.physics import carried as carried
    from casest.declaration.physics import constraint as constraint
    from casest.declaration.physics import cos as cos
    from casest.declaration.physics import cosh as cosh
    from casest.declaration.physics import cross as cross
    from casest.declaration.physics import der as der
    from casest.declaration.physics import diag as diag
    from casest.declaration.physics import dot as dot
    from casest.declaration.physics import exp as exp
    from casest.declaration.physics import fabs as fabs
    from casest.declaration.physics import fmax as fmax
    from casest.declaration.physics import fmin as fmin
    from casest.declaration.physics import horzcat as horzcat
    from casest.declaration.physics import if_else as if_else
    from casest.declaration.physics import inf as inf
    from casest.declaration.physics import integral as integral
    from casest.declaration.physics import inverse as inverse
    from casest.declaration.physics import log as log
    from casest.declaration.physics import norm_2 as norm_2
    from casest.declaration.physics import pi as pi
    from casest.declaration.physics import polynomial as polynomial
    from casest.declaration.physics import quantity as quantity
    from casest.declaration.physics import rotation as rotation
    from casest.declaration.physics import sign as sign
    from casest.declaration.physics import sin as sin
    from casest.declaration.physics import sinh as sinh
    from casest.declaration.physics import skew as skew
    from casest.declaration.physics import sqrt as sqrt
    from casest.declaration.physics import sum1 as sum1
    from casest.declaration.physics import tan as tan
    from casest.declaration.physics import tanh as tanh
    from casest.declaration.physics import turned as turned
    from casest.declaration.physics import vertcat as vertcat
    from casest.declaration.shapes import diagonal as diagonal
    from casest.declaration.shapes import each as each
    from casest.declaration.shapes import full as full
    from casest.declaration.shapes import lower as lower
    from casest.declaration.shapes import rotation_matrix as rotation_matrix
    from casest.declaration.shapes import unit_vector as unit_vector
    from casest.declaration.symbols import attitude as attitude
    from casest.declaration.symbols import constant as constant
    from casest.declaration.symbols import param as param
    from casest.declaration.symbols import signal as signal
    from casest.diagnose.motion.loop import MotionClosing as MotionClosing
    from casest.diagnose.motion.loop import close_motion as close_motion
    from casest.errors import CasestError as CasestError
    from casest.errors import DataError as DataError
    from casest.errors import DeclarationError as DeclarationError
    from casest.errors import NotTrusted as NotTrusted
    from casest.errors import UnitError as UnitError
    from casest.errors import UsageError as UsageError
    from casest.fleet.calibrate_many import Batch as Batch
    from casest.fleet.calibrate_many import calibrate_many as calibrate_many
    from casest.fleet.population import Population as Population
    from casest.fleet.population import calibrate_with as calibrate_with
    from casest.fleet.population import population as population
    from casest.interface.calibrate import attempt as attempt
    from casest.interface.calibrate import calibrate as calibrate
    from casest.interface.calibrate import close as close
    from casest.interface.estimate import Closing as Closing
    from casest.interface.estimate import Estimate as Estimate
    from casest.interface.saved import Saved as Saved
    from casest.interface.saved import load as load
    from casest.tasks.arrow import calibrate_arrow as calibrate_arrow


def _homes() -> dict[str, str]:
    """The module of each public name, from the imports above as the loader has their source."""
    import ast

    source = getattr(__spec__.loader, "get_source", lambda name: None)(__name__)
    if source is None:
        raise ImportError(
            "casest/__init__.py was installed without its source, which says where casest's names "
            "are: install casest with its .py files"
        )
    block = next(node for node in ast.parse(source).body if isinstance(node, ast.If))
    return {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


_HOMES: dict[str, str] = {}


def _public(name: str) -> Any:
    """What a public name stands for; its module is imported now."""
    if not _HOMES:
        _HOMES.update(_homes())
    if name == "__all__":
        return ["__version__", *sorted(_HOMES)]
    if name not in _HOMES:
        raise AttributeError(f"casest has no {name!r}")
    return getattr(import_module(_HOMES[name]), name)


if not TYPE_CHECKING:  # a type checker would take any name for one that is there

    def __getattr__(name):
        return _public(name)

    def __dir__():
        return _public("__all__")
