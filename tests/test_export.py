"""Exported C, Python and JSON give what `casest apply` gives, and refuse what it refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.resources import files

import bodies
import numpy as np
import pytest
import simulators as sim

from casest import Correction, Run
from casest.cli import run as command
from casest.correction.inverse import LEFT, invertible
from casest.demo import RECORD, WHEEL
from casest.effects import CATALOGUE
from casest.results.find import find_model
from casest.saved.export import is_exported
from casest.saved.model import saved_model

HANDHELD = [str(RECORD), "--columns", "v=ax,ay,az", "--rate", "50", "--at-rest"]
G = ["--set", "norm=9.80665 m/s^2"]
CELL = '''
from casest import Residual, effect, exp, model, param, quantity, signal


@model
def ntc(T=signal("K"), r=signal("ohm"), *, a=param("ohm", start=9e3), b=param("K", start=3e3)):
    """Two-parameter equation of a thermistor: no closed form is declared, and it is not linear."""
    temperature = quantity("temperature", T, "K")
    reading = quantity("reading", a * exp(b * (1 / temperature - 1 / 298.15)), "ohm")
    return Residual(measured=r, predicted=reading, corrected=temperature)
'''


def pair_record(path):
    """Both sensors of one body in 40 poses; no code of the model."""
    rng = np.random.default_rng(11)
    run = bodies.Body(rng).record(bodies.attitudes(40, rng), rng)
    header = ",".join([f"a{x} [m/s^2]" for x in "xyz"] + [f"m{x} [uT]" for x in "xyz"])
    columns = np.hstack([run.signals["a"], run.signals["m"]])
    np.savetxt(path, columns, delimiter=",", header=header, comments="")
    return path


def table_record(path):
    rng = np.random.default_rng(3)
    t, R = sim.table_steps(24, rng, sampled=0.2)
    F = np.eye(3) * 1.02
    down = np.array([0.0, 0.0, 1.0])
    a, _ = sim.table_readings(R, down, F, np.array([2e-4, -1e-4, 1e-4]), np.full(3, 0.1), 5e-3, rng)
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(R).as_quat()
    columns = np.column_stack([t, a, q[:, 3], q[:, 0], q[:, 1], q[:, 2]])
    header = "t [s],ax [m/s^2],ay [m/s^2],az [m/s^2],qw,qx,qy,qz"
    np.savetxt(path, columns, delimiter=",", header=header, comments="")
    return path


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folders of results of all kinds: implicit, linear, closed form, Newton, with an effect."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "thermistor.py").write_text(CELL, encoding="utf-8")
    kelvin = np.linspace(270.0, 345.0, 30)
    ohm = 1e4 * np.exp(3950 * (1 / kelvin - 1 / 298.15))
    ohm *= 1 + 1e-4 * np.random.default_rng(0).standard_normal(30)
    np.savetxt(
        folder / "bath.csv",
        np.column_stack([kelvin, ohm]),
        delimiter=",",
        header="T [K],r [ohm]",
        comments="",
    )
    made = {
        "norm-diagonal": ["calibrate", "norm-diagonal", *HANDHELD, *G],
        "norm-triangular": ["calibrate", "norm-triangular", *HANDHELD, *G],
        "closed": ["close", "norm-diagonal", *HANDHELD, *G],
        "wheel": ["calibrate", "wheel", str(WHEEL)],
        "rate-table": ["calibrate", "rate-table", str(table_record(folder / "table.csv"))],
        "norm-pair": ["calibrate", "norm-pair", str(pair_record(folder / "pair.csv"))],
        "thermistor": ["calibrate", str(folder / "thermistor.py"), str(folder / "bath.csv")],
    }
    for name, arguments in made.items():
        assert command([*arguments, "-o", str(folder / name)]) == 0, name
    return folder


NAMES = [
    "norm-diagonal",
    "norm-triangular",
    "closed",
    "wheel",
    "rate-table",
    "thermistor",
    "norm-pair",
]


def by_apply(folder, inputs):
    """What the model itself makes of inputs (N, width) in the order of the JSON's inputs."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    model, values = saved_model(result)
    correction = Correction(model)
    signals, place = {}, 0
    for s in correction.signals:
        signals[s.name] = inputs[:, place : place + s.size]
        place += s.size
    run = Run.raw("new", signals, units={})
    found = result["corrected"]
    return correction(replace(run, file="new"), values, (found["low"], found["high"]))


def readings(folder, program, count=200):
    """Readings within the range of the fit: predicted by the model, or at random (implicit)."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    model, values = saved_model(result)
    rng = np.random.default_rng(5)
    low, high = result["corrected"]["low"], result["corrected"]["high"]
    if model.implicit:
        return rng.uniform(low, high, (count, sum(i["size"] for i in program["inputs"])))
    wanted = rng.uniform(low, high, (count, program["output"]["size"]))
    return Correction(model).readings(values, wanted)


def exported(folder, to, path, *more):
    assert command(["export", str(folder), "--to", to, "-o", str(path), *more]) == 0
    return path


def compiled(source, folder, *flags):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler on this machine: the exported source is not compiled")
    program = folder / "a.out"
    strict = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2"]
    subprocess.run([compiler, *strict, *flags, str(source), "-o", str(program), "-lm"], check=True)
    return program


@pytest.mark.parametrize("name", NAMES)
def test_c_python_and_json_give_what_apply_gives(results, tmp_path, name):
    folder = results / name
    content = json.loads(exported(folder, "json", tmp_path / "c.json").read_text(encoding="utf-8"))
    x = readings(folder, content["program"])
    truth = by_apply(folder, x)
    module = exported(folder, "python", tmp_path / "correction.py")
    np.save(tmp_path / "x.npy", x)
    code = (
        "import numpy as np, correction; "
        "np.save('c.npy', correction.correct(np.load('x.npy'))); "
        "import sys; assert not any(m.startswith(('casest', 'casadi')) for m in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "c.npy"), truth, rtol=1e-9, atol=1e-12)
    assert module.exists()
    source = exported(folder, "c", tmp_path / "c.c")
    function = source.read_text(encoding="utf-8").split("int correct_")[1].split("(")[0]
    main = tmp_path / "main.c"
    main.write_text(
        f'#include <stdio.h>\n#include "c.c"\n'
        f"int main(void) {{ double x[{x.shape[1]}], c[{truth.shape[1]}]; for (;;) {{\n"
        f'for (int i = 0; i < {x.shape[1]}; ++i) if (scanf("%lf", x + i) != 1) return 0;\n'
        f"if (correct_{function}(x, c)) return 1;\n"
        f'for (int i = 0; i < {truth.shape[1]}; ++i) printf("%.17g ", c[i]); }} }}\n',
        encoding="utf-8",
    )
    text = " ".join(f"{v:.17g}" for v in x.ravel())
    done = subprocess.run(
        [compiled(main, tmp_path)], input=text, capture_output=True, text=True, check=True
    )
    found = np.array(done.stdout.split(), dtype=float).reshape(truth.shape)
    np.testing.assert_allclose(found, truth, rtol=1e-9, atol=1e-12)


COMPASS = """
from casest import Residual, model, param, quantity, signal


@model
def compass(b=signal(3, "uT"), m=signal(3, "uT"), *, hard=param(3, "uT")):
    field = quantity("field", b, "uT")
    return Residual(measured=m, predicted=quantity("reading", field + hard, "uT"), corrected=field)
"""
TURNED = np.radians(np.arange(300) * 7.3)
BENT = {
    "axis_gain": lambda b: b * np.array([1.02, 0.97, 1.01]),
    "soft_iron": lambda b: b @ np.array([[1.02, 0.03, 0], [-0.02, 0.98, 0.01], [0.04, 0, 1]]).T,
    "gain_by_sign": lambda b: np.where(b > 0, 1.01 * b, 0.99 * b),
    "harmonic(heading)": lambda b: b + np.outer(np.sin(TURNED), [1, -2, 0.5]),
    "second_harmonic(heading)": lambda b: b + np.outer(np.sin(TURNED) ** 2, [1, -2, 0.5]),
    "temperature_curve(temp)": lambda b: b + np.outer(0.01 * (np.arange(300) % 40) ** 2, [1, 2, 3]),
}


@pytest.mark.parametrize(
    "asked",
    [
        pytest.param(a, marks=[pytest.mark.long] * (a in ("axis_gain", "second_harmonic(heading)")))
        for a in BENT
    ],
)
def test_what_bends_a_reading_is_undone_by_every_form(tmp_path, capsys, monkeypatch, asked):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "compass.py").write_text(COMPASS, encoding="utf-8")
    rng = np.random.default_rng(6)
    field = 48 * sim.sphere(300, rng)
    m = BENT[asked](field) + [5.0, -8.0, 2.0] + 1e-3 * rng.standard_normal((300, 3))
    columns = np.column_stack([field, m, np.degrees(TURNED), np.arange(300) % 40])
    names = [f"{s}{a} [uT]" for s in "bm" for a in "xyz"]
    header = ",".join([*names, "heading [deg]", "temp [degC]"])
    np.savetxt("r.csv", columns, delimiter=",", header=header, comments="")
    assert command(["calibrate", "compass.py", "r.csv", "--effects", asked, "-o", "out"]) == 0
    exported(tmp_path / "out", "json", tmp_path / "c.json")
    for result in ("out", "c.json"):
        capsys.readouterr()
        assert command(["apply", result, "r.csv"]) == 0
        rows = capsys.readouterr().out.splitlines()[1:]
        found = np.array([row.split(",")[-3:] for row in rows], dtype=float)
        assert np.abs(found - field).max() < 6e-3  # 5 standard deviations of the noise
    source = exported(tmp_path / "out", "c", tmp_path / "c.c")
    program = compiled(source, tmp_path, "-DCASEST_SELF_TEST")
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    module = exported(tmp_path / "out", "python", tmp_path / "c.py")
    subprocess.run([sys.executable, str(module)], check=True)


@pytest.mark.parametrize("flag", [(), ("--float",)])
@pytest.mark.parametrize("name", ["closed", "wheel", "rate-table", "thermistor", "norm-pair"])
def test_the_self_test_of_the_source_passes(results, tmp_path, name, flag):
    source = exported(results / name, "c", tmp_path / "c.c", *flag)
    program = compiled(source, tmp_path, "-DCASEST_SELF_TEST")
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_json_is_applied_without_the_model(results, tmp_path, capsys):
    path = exported(results / "thermistor", "json", tmp_path / "c.json")
    assert is_exported(path)
    assert not is_exported(results / "thermistor" / "result.json")
    capsys.readouterr()
    assert command(["apply", str(path), str(results / "bath.csv")]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert rows[0] == "row,r [ohm],temperature [K]"
    table = np.array([row.split(",") for row in rows[1:]], dtype=float)
    np.testing.assert_allclose(table[:, 2], np.linspace(270.0, 345.0, 30), atol=0.05)


def test_the_json_takes_the_options_of_the_fit_and_prints_what_apply_prints(results, capsys):
    """T is a signal of the fit that the correction does not need."""
    path = exported(results / "thermistor", "json", results / "options.json")
    told = ["--columns", "T=T", "--unit", "T=K", "--columns", "r=r"]
    printed = []
    for result in (path, results / "thermistor"):
        capsys.readouterr()
        assert command(["apply", str(result), str(results / "bath.csv"), *told]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert command(["apply", str(path), str(results / "bath.csv"), "--columns", "S=r"]) == 1
    assert "no signal or column S" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["closed", "thermistor"])
def test_the_self_test_of_the_module_passes_and_can_fail(results, tmp_path, name):
    module = exported(results / name, "python", tmp_path / "correction.py")
    done = subprocess.run([sys.executable, module], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("largest error ")
    text = module.read_text(encoding="utf-8")
    module.write_text(text.replace('"add": np.add', '"add": np.subtract'), encoding="utf-8")
    done = subprocess.run([sys.executable, module], capture_output=True, text=True, check=False)
    assert done.returncode == 1


def test_outside_the_domain_every_form_says_so(results, tmp_path, capsys):
    """No temperature gives a negative resistance."""
    exported(results / "thermistor", "python", tmp_path / "correction.py")
    code = "import numpy as np, correction; correction.correct(np.array([[1e4], [-5.0]]))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "row 1: outside what the model can produce" in done.stderr
    path = exported(results / "thermistor", "json", tmp_path / "c.json")
    bad = tmp_path / "bad.csv"
    bad.write_text("r [ohm]\n10000\n-5\n", encoding="utf-8")
    capsys.readouterr()
    assert command(["apply", str(path), str(bad)]) == 1
    assert "row 1" in capsys.readouterr().err


def test_the_json_follows_its_published_schema(results, tmp_path):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(
        files("casest.correction").joinpath("correction.schema.json").read_text("utf-8")
    )
    for name in NAMES:
        path = exported(results / name, "json", tmp_path / "c.json")
        jsonschema.validate(json.loads(path.read_text(encoding="utf-8")), schema)


def test_every_result_follows_its_published_schema(results, tmp_path):
    """Of fits, of a loop closed, and of a fit that is refused; one that grew: in test_report."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(files("casest.results").joinpath("result.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    assert command(["calibrate", "norm-full", *HANDHELD, *G, "-o", str(tmp_path)]) == 2
    published = jsonschema.Draft202012Validator(schema)
    for folder in (*(results / name for name in NAMES), tmp_path):
        found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        published.validate(found)
        with pytest.raises(jsonschema.ValidationError):
            published.validate(found | {"verdict": "fine"})


def test_a_refused_result_is_not_exported(tmp_path, capsys):
    assert command(["calibrate", "norm-full", *HANDHELD, *G, "-o", str(tmp_path)]) == 2
    capsys.readouterr()
    assert command(["export", str(tmp_path), "--to", "c"]) == 1
    assert "this estimate was refused; --force" in capsys.readouterr().err


def test_an_estimator_in_motion_has_no_correction(tmp_path, capsys):
    found = {
        "model": "bias-gravity",
        "trusted": True,
        "after": {"parameters": {}},
        "innovations": {},
    }
    (tmp_path / "result.json").write_text(json.dumps(found), encoding="utf-8")
    for words in (["export", str(tmp_path), "--to", "c"], ["apply", str(tmp_path), "flight.csv"]):
        assert command(words) == 1
        said = capsys.readouterr().err
        assert "it has states over time (casest filter bias-gravity DATA) and no correction" in said


def test_float_is_for_c_alone(results, capsys):
    assert command(["export", str(results / "wheel"), "--to", "json", "--float"]) == 1
    assert "--float is for --to c" in capsys.readouterr().err


LAG = """
from casest import der, effect, param, signal, vertcat


@effect(on="reading")
def lag(y, t=signal("s"), *, tau=param("s")):
    return y - vertcat(tau, 0, 0) * der(y, t)
"""


def test_a_lag_stays_in_and_every_form_says_so(tmp_path, capsys):
    """Solved for one sample, the force has no rate: the lag cannot be undone, only named."""
    (tmp_path / "lag.py").write_text(LAG, encoding="utf-8")
    fit = ["calibrate", "wheel", str(WHEEL), "--effects", str(tmp_path / "lag.py")]
    assert command([*fit, "-o", str(tmp_path / "out")]) == 0
    said = LEFT.rpartition(":")[0]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{said.capitalize()}: <code>lag</code>" in page
    capsys.readouterr()
    assert command(["apply", str(tmp_path / "out"), str(WHEEL)]) == 0
    printed = capsys.readouterr()
    assert f"{said}: lag" in printed.err
    path = exported(tmp_path / "out", "json", tmp_path / "c.json")
    assert json.loads(path.read_text(encoding="utf-8"))["not_undone"] == ["lag"]
    capsys.readouterr()
    assert command(["apply", str(path), str(WHEEL)]) == 0
    again = capsys.readouterr()
    assert f"{said}: lag" in again.err
    found, expected = (
        np.array([r.split(",")[-3:] for r in text.splitlines()[1:]], dtype=float)
        for text in (again.out, printed.out)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    values = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    p = {n: np.array(v["value"]) for n, v in values["estimate"]["parameters"].items()}
    v = np.loadtxt(WHEEL, delimiter=",", skiprows=1)[:, 1:4]
    np.testing.assert_allclose(expected, (v - p["offset"]) / p["gain"], rtol=1e-7, atol=1e-7)
    for to in ("c", "python"):
        source = exported(tmp_path / "out", to, tmp_path / f"c.{to}").read_text(encoding="utf-8")
        assert said in source
        assert "lag." in source


@pytest.mark.parametrize(
    ("name", "left"),
    [("axis_delay", True), ("low_pass", True), ("hysteresis", True), ("imbalance", False),
     ("temperature_bias", False), ("bias_drift", False), ("quadratic", False),
     ("saturation", False), ("soft_iron", False), ("gain_matrix", False), ("gain_by_sign", False),
     ("warm_up", False), ("pulse", False), ("reference_wander", True), ("bias_course", True),
     ("bias_ramp", True)],
)  # fmt: skip
def test_what_acts_on_a_rate_or_describes_a_record_is_left_and_nothing_else(name, left):
    found = next(e for e in CATALOGUE if e.name == name)
    place = {"input": "specific_force", "output": "reading"}.get(found.on, found.on)
    columns = {"channel": "temp"} if name == "temperature_bias" else {}
    model = find_model("wheel").with_effect(found, on=place, columns=columns)
    assert bool(invertible(model)[1]) is left
