"""Find a model by its shipped name, or in any Python file."""

from __future__ import annotations

import ast
import difflib
import importlib
import linecache
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from casest.declaration.dimensions import check_units
from casest.declaration.effect import RECORDED, Effect
from casest.declaration.model import Model
from casest.dynamics import Dynamics
from casest.dynamics import check_units as check_units_in_motion
from casest.effects import ASKED, CATALOGUE
from casest.errors import CasestError, DeclarationError, UsageError

#: Values of effects that a fit finds from where they start, without a grid.
STARTED = ("timescale", "memory", "threshold", "band", "share", "lag")
#: Shipped models: name on the command line -> module and attribute in `casest_problems`.
SHIPPED = {
    "wheel": ("wheel", "wheel"),
    "wheel-motion": ("wheel_motion", "wheel_motion"),
    "rate-table": ("rate_table", "rate_table"),
    "norm-diagonal": ("norm", "norm_diagonal"),
    "norm-triangular": ("norm", "norm_triangular"),
    "norm-full": ("norm", "norm_full"),
    "norm-pair": ("pair", "norm_pair"),
    "linear": ("one_channel", "linear"),
    "polynomial": ("one_channel", "polynomial"),
    "thermistor-beta": ("thermistor", "thermistor_beta"),
    "steinhart-hart": ("thermistor", "steinhart_hart"),
    "load-cell": ("one_channel", "load_cell"),
    "pressure": ("one_channel", "pressure"),
    "gyro-rests": ("imu", "gyro_rests"),
    "imu": ("imu", "imu"),
}


#: Shipped estimators in motion.
MOVING = {
    "bias-gravity": ("bias_gravity", "bias_gravity"),
    "bias-gravity-magnitude": ("bias_gravity", "bias_gravity_magnitude"),
    "bias-gravity-position": ("bias_gravity", "bias_gravity_position"),
    "mag-gyro": ("mag_gyro", "mag_gyro"),
}


def find_any(name: str) -> Model | Dynamics:
    """The model or the estimator in motion of that name, shipped or in a `.py` file."""
    if name in MOVING:
        module, attribute = MOVING[name]
        found: Dynamics = getattr(importlib.import_module(f"casest_problems.{module}"), attribute)
        return found
    path, _, wanted = name.partition(":")
    if path.endswith(".py"):
        declared = vars(load_file(Path(path)))
        moving = {n: v for n, v in declared.items() if isinstance(v, Dynamics)}
        chosen = moving.get(wanted.replace("-", "_")) if wanted else None
        if chosen is None and not wanted and len(moving) == 1:
            still = [v for v in declared.values() if isinstance(v, Model)]
            chosen = None if still else next(iter(moving.values()))
        if chosen is not None:
            check_units_in_motion(chosen)
            return chosen
    return find_model(name)


def find_model(name: str) -> Model:
    """The shipped model of that name, or the one in `file.py` (`file.py:name` out of several)."""
    if name in SHIPPED:
        module, attribute = SHIPPED[name]
        found: Model = getattr(importlib.import_module(f"casest_problems.{module}"), attribute)
        return found
    path, _, wanted = name.partition(":")
    if path.endswith(".py"):
        declared: Model | Dynamics = _one(
            load_file(Path(path)), (Model, Dynamics), "model", path, wanted
        )
        if isinstance(declared, Dynamics):
            check_units_in_motion(declared)
            declared = declared.calibration
        check_units(declared)
        return declared
    if name in MOVING:
        raise UsageError(f"{name} is an estimator in motion: casest observe, filter or close it")
    hint = _meant(name, [*SHIPPED, *MOVING])
    raise UsageError(
        f"no model {name!r}{hint} (shipped: {', '.join([*SHIPPED, *MOVING])}; or give the path "
        "of a .py file)"
    )


def _meant(name: str, shipped: Sequence[str]) -> str:
    """A file of that name, or a shipped name that is written alike."""
    near = difflib.get_close_matches(name, shipped, 1)
    if Path(f"{name}.py").is_file():
        near = [f"{name}.py"]
    return f"; did you mean {near[0]!r}?" if near else ""


def find_effects(name: str) -> tuple[Effect, ...]:
    """All effects declared in `file.py`, the one of `file.py:name`, or a shipped one's name."""
    shipped = {e.name: e for e in (*CATALOGUE, *ASKED)}
    if name in shipped:
        return (_whole(shipped[name]),)
    if not Path(name).suffix and ":" not in name:
        hint = _meant(name, list(shipped))
        raise UsageError(
            f"--effects {name}: no shipped effect{hint} (`casest list` has them; or give the path "
            f"of a .py file; a constant of the model is freed by --free {name})"
        )
    path, _, wanted = name.partition(":")
    module = load_file(Path(path))
    if wanted:
        return (_one(module, Effect, "effect", path, wanted),)
    found = tuple(v for v in vars(module).values() if isinstance(v, Effect))
    if not found:
        raise UsageError(f"{path} declares no @effect")
    return found


def find_asked(text: str) -> tuple[tuple[Effect, str], ...]:
    """Effects as --effects names them, with the column that they are to follow, else empty.

    `NAME(COLUMN)` of a shipped one, `FILE(COLUMN)` or `FILE:NAME(COLUMN)` of one's own.
    """
    found = re.fullmatch(r"(.+?)\(([^()]+)\)", text)
    if found is None:
        return tuple((effect, "") for effect in find_effects(text))
    name, column = found[1], found[2].strip()
    shipped = {e.name: e for e in (*CATALOGUE, *ASKED)}
    if name not in shipped:
        several = find_effects(name)
        if len(several) > 1:
            raise UsageError(
                f"--effects {text}: {name} declares {', '.join(e.name for e in several)}: say "
                f"which, as {name}:{several[0].name}({column})"
            )
    effect = shipped[name] if name in shipped else several[0]
    if effect.kind == "time":
        return ((replace(effect, on=column), ""),)
    if len(effect.columns) != 1:
        raise UsageError(f"--effects {text}: {effect.name} follows no column; leave ({column}) out")
    return ((effect, column),)


def _whole(effect: Effect) -> Effect:
    """A shipped effect that needs neither a column nor a value that must be looked for."""
    if effect.on == RECORDED:
        raise UsageError(
            f"--effects {effect.name}: this effect needs the signal that it delays: "
            f"--effects '{effect.name}(SIGNAL)'"
        )
    if effect.columns:
        raise UsageError(
            f"--effects {effect.name}: this effect needs the column it follows: "
            f"--effects '{effect.name}(COLUMN)'"
        )
    return without_grid(effect)


def without_grid(effect: Effect) -> Effect:
    """The effect, unless it has a value that must be looked for."""
    missing = ", ".join(name for name, what in effect.profile if what not in STARTED)
    if missing:
        raise UsageError(
            f"--effects {effect.name}: this effect needs its {missing}, which only `casest close` "
            "finds. Declare it in a file of your own, with the value in it"
        )
    return effect


def _one(module: ModuleType, kind: Any, word: str, path: str, wanted: str) -> Any:
    own: dict[str, Any] = {n: v for n, v in vars(module).items() if isinstance(v, kind)}
    names = {n: v for n, v in own.items() if v.function.__module__ == module.__name__}
    names = names or own
    if wanted:
        for label in (wanted, wanted.replace("-", "_")):
            if label in names:
                return names[label]
        near = difflib.get_close_matches(wanted, names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise UsageError(
            f"{path} has no {word} {wanted!r}{hint} (it has {', '.join(names) or 'none'})"
        )
    if not names:
        raise UsageError(f"{path} declares no @{word}")
    if len(names) > 1:
        raise UsageError(
            f"{path} declares {', '.join(names)}: say which, as {path}:{next(iter(names))}"
        )
    return next(iter(names.values()))


def load_file(path: Path) -> ModuleType:
    """Run a Python file of declarations; whatever is wrong in it becomes one line with place."""
    if not path.exists():
        raise UsageError(f"{path}: no such file")
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; give the .py file in it")
    spec = spec_from_file_location(f"casest_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{path}: not a Python file")
    _refuse_duplicates(path)
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        where = f"{error.filename or path}" + (f", line {error.lineno}" if error.lineno else "")
        text = f": {error.text.strip()!r}" if error.text else ""
        raise DeclarationError(f"{where}: {error.msg}{text}") from None
    except CasestError as error:
        raise type(error)(f"{_place(error, path)}: {error}") from None
    except (Exception, SystemExit) as error:
        raise DeclarationError(f"{_place(error, path)}: {type(error).__name__}: {error}") from None
    finally:
        sys.path.remove(str(path.parent))
    return module


def _refuse_duplicates(path: Path) -> None:
    """A second function of one name would silently replace the first."""
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, UnicodeDecodeError, ValueError):
        return  # running the file says where
    except RecursionError:
        raise DeclarationError(
            f"{path}: an expression is too long for Python; build it up in several lines or a loop"
        ) from None
    seen: dict[str, int] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            decorated = [ast.unparse(d) for d in node.decorator_list]
            again = node.name in seen and not any(d.startswith(f"{node.name}.") for d in decorated)
            if again:
                raise DeclarationError(
                    f"{path}, line {node.lineno}: {node.name!r} is declared twice (first in line "
                    f"{seen[node.name]}); give one of them another name"
                )
            seen[node.name] = node.lineno


def _place(error: BaseException, path: Path) -> str:
    """File, line and text of the last line of the user's file in the error's traceback."""
    line, traceback = 0, error.__traceback__
    while traceback is not None:
        if Path(traceback.tb_frame.f_code.co_filename).resolve() == path.resolve():
            line = traceback.tb_lineno
        traceback = traceback.tb_next
    linecache.checkcache(str(path))
    text = linecache.getline(str(path), line).strip().rstrip(",")
    return f"{path}, line {line}" + (f", {text!r}" if text else "")
