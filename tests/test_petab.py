"""PEtab problems: tables in the published format 1, and what its test suite publishes of them.

The model of PEtab-dev/petab_test_suite is the reaction A <-> B; its cases come with chi² at the
nominal parameters (cases/v1.0.0/sbml/NNNN/_NNNN_solution.yaml), which is the truth here.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest import load_runs
from casest.cli import run
from casest.leastsquares.problem import Problem
from casest.results.find import find_model

pytest.importorskip("ruamel.yaml")

YAML = """format_version: 1
parameter_file: parameters.tsv
problems:
- condition_files: [conditions.tsv]
  measurement_files: [measurements.tsv]
  observable_files: [observables.tsv]
  sbml_files: [model.xml]
"""
LAW = """<kineticLaw><math xmlns="http://www.w3.org/1998/Math/MathML"><apply><times/>
<ci> compartment </ci><ci> {} </ci><ci> {} </ci></apply></math></kineticLaw>"""
REACTION = """<reaction id="{0}">
<listOfReactants><speciesReference species="{1}"/></listOfReactants>
<listOfProducts><speciesReference species="{2}" stoichiometry="1"/></listOfProducts>
{3}</reaction>"""
FIRST = """<initialAssignment symbol="{}"><math xmlns="http://www.w3.org/1998/Math/MathML">
<ci> {} </ci></math></initialAssignment>"""
SBML = f"""<?xml version="1.0" encoding="UTF-8"?>
<sbml xmlns="http://www.sbml.org/sbml/level2/version4" level="2" version="4">
<model id="conversion_reaction">
<listOfCompartments><compartment id="compartment" size="1"/></listOfCompartments>
<listOfSpecies>
<species id="A" compartment="compartment" initialConcentration="2"/>
<species id="B" compartment="compartment" initialConcentration="2"/>
</listOfSpecies>
<listOfParameters>
<parameter id="a0" value="1"/><parameter id="b0" value="1"/>
<parameter id="k1" value="0"/><parameter id="k2" value="0"/>
</listOfParameters>
<listOfInitialAssignments>{FIRST.format("A", "a0")}{FIRST.format("B", "b0")}
</listOfInitialAssignments>
<listOfReactions>
{REACTION.format("fwd", "A", "B", LAW.format("k1", "A"))}
{REACTION.format("rev", "B", "A", LAW.format("k2", "B"))}
</listOfReactions></model></sbml>
"""
EQUATIONS = """# by hand
A' = -k1*A + k2*B
B' = k1*A - k2*B
A(0) = a0
B(0) = b0
"""
RATES = "k1 lin 0 10 0.8 1\nk2 lin 0 10 0.6 1\n"
BEGINS = "a0 lin 0 10 1 1\nb0 lin 0 10 0 1\n"
HEADS = {
    "parameters": "parameterId parameterScale lowerBound upperBound nominalValue estimate\n",
    "observables": "observableId observableFormula noiseFormula\n",
    "measurements": "observableId simulationConditionId time measurement\n",
}
TWO = "obs_a c0 0 0.7\nobs_a c0 10 0.1\n"
SCALED = "observableId observableFormula observableTransformation noiseFormula\n"

#: Tables of the suite's cases (what differs from the first), and the chi² that it publishes.
CASES = {
    "0001": ({"observables": HEADS["observables"] + "obs_a A 0.5\n"}, 0.79183798368486),
    "0002": (
        {
            "conditions": "conditionId a0 b0\nc0 0.8 \nc1 0.9 \n",
            "parameters": HEADS["parameters"] + RATES,
            "measurements": HEADS["measurements"] + TWO + "obs_a c1 0 0.8\nobs_a c1 10 0.2\n",
        },
        0.84816338477474,
    ),
    "0003": (
        {
            "observables": HEADS["observables"]
            + "obs_a observableParameter1_obs_a*A+observableParameter2_obs_a 0.5\n",
            "measurements": HEADS["measurements"].strip() + " observableParameters\n"
            "obs_a c0 0 0.7 0.5;2\nobs_a c0 10 0.1 0.5;2\n",
        },
        30.84082034502065,
    ),
    "0006": (
        {
            "observables": HEADS["observables"] + "obs_a observableParameter1_obs_a*A 1\n",
            "measurements": HEADS["measurements"].strip() + " observableParameters\n"
            "obs_a c0 0 0.7 10\nobs_a c0 10 0.1 15\n",
        },
        126.54090653896247,
    ),
    "0007": (
        {
            "observables": SCALED + "obs_a A lin 0.5\nobs_b B log10 0.6\n",
            "measurements": HEADS["measurements"] + "obs_a c0 10 0.2\nobs_b c0 10 0.8\n",
        },
        0.2682957616817,
    ),
    "0008": (
        {
            "observables": HEADS["observables"] + "obs_a A 0.5\n",
            "measurements": HEADS["measurements"] + TWO + "obs_a c0 10 0.2\n",
        },
        1.00081844438516,
    ),
    "0011": (
        {
            "conditions": "conditionId B\nc0 2\n",
            "parameters": HEADS["parameters"] + RATES,
            "observables": HEADS["observables"] + "obs_a A 0.5\n",
        },
        5.98367121577545,
    ),
    "0014": (
        {
            "observables": HEADS["observables"]
            + "obs_a A noiseParameter1_obs_a+noiseParameter2_obs_a\n",
            "measurements": HEADS["measurements"].strip() + " noiseParameters\n"
            "obs_a c0 0 0.7 0.5;2\nobs_a c0 10 0.1 0.5;2\n",
        },
        0.03167351934739,
    ),
    "0015": (
        {
            "parameters": HEADS["parameters"] + BEGINS + RATES + "noise lin 0 10 5.0 1\n",
            "observables": HEADS["observables"] + "obs_a A noiseParameter1_obs_a\n",
            "measurements": HEADS["measurements"].strip() + " noiseParameters\n"
            "obs_a c0 0 0.7 noise\nobs_a c0 10 0.1 noise\n",
        },
        0.00791837983685,
    ),
}

#: Standard deviation of the readings of cases with one for all.
STD = {"0001": 0.5, "0003": 0.5, "0008": 0.5, "0011": 0.5, "0014": 2.5, "0015": 5.0}


def problem(folder, **tables):
    """A problem in a folder: words become cells; tables that are not given are the usual ones."""
    usual = {
        "conditions": "conditionId\nc0\n",
        "parameters": HEADS["parameters"] + BEGINS + RATES,
        "observables": HEADS["observables"] + "obs_a A 1\n",
        "measurements": HEADS["measurements"] + TWO,
        "yaml": YAML,
        "sbml": SBML,
    }
    whole = usual | tables
    for name in ("conditions", "parameters", "observables", "measurements"):
        (folder / f"{name}.tsv").write_text(whole[name].replace(" ", "\t"))
    (folder / "model.xml").write_text(whole["sbml"])
    path = folder / "conversion.yaml"
    path.write_text(whole["yaml"])
    return str(path)


def begun(path, folder, *words):
    """What `casest init` makes of it: the model, its runs."""
    assert run(["init", path, "-o", str(folder / "out/bench.toml"), *words]) == 0
    model = find_model(str(folder / "out/conversion.py"))
    records = sorted(str(p) for p in (folder / "out").glob("*.csv"))
    return model, load_runs(records, model.signals, **model.reading)


@pytest.mark.parametrize("case", CASES)
def test_chi_square_is_that_of_the_test_suite(case, tmp_path):
    tables, published = CASES[case]
    model, runs = begun(problem(tmp_path, **tables), tmp_path)
    found = Problem(model, runs)
    names = {p.name for p in model.parameters}
    nominal = {"a0": 1.0, "b0": 0.0, "k1": 0.8, "k2": 0.6}
    point = found.point({n: v for n, v in nominal.items() if n in names})
    # Of readings with one noise for all the cost is in their own unit. b0 is kept inside its bound.
    chi_square = 2 * found.cost(point) / STD.get(case, 1.0) ** 2
    assert chi_square == pytest.approx(published, rel=1e-7)


def test_parameters_of_each_condition_are_unknowns_of_their_own(tmp_path):
    """Case 0005, whose model in the suite has the offset as one parameter more."""
    model, runs = begun(
        problem(
            tmp_path,
            conditions="conditionId offset_A\nc0 offset_A_c0\nc1 offset_A_c1\n",
            parameters=HEADS["parameters"]
            + BEGINS
            + RATES
            + "offset_A_c0 lin 0 10 2 1\noffset_A_c1 lin 0 10 3 1\n",
            observables=HEADS["observables"] + "obs_a A+offset_A 1\n",
            measurements=HEADS["measurements"]
            + "obs_a c0 0 2\nobs_a c1 0 2\nobs_a c0 10 2.1\nobs_a c1 10 3.2\n",
        ),
        tmp_path,
    )
    found = Problem(model, runs)
    assert len(runs) == 2
    values = {"a0": 1.0, "b0": 0.0, "k1": 0.8, "k2": 0.6, "offset_A_c0": 2.0, "offset_A_c1": 3.0}
    chi_square = 2 * found.cost(found.point(values))
    assert chi_square == pytest.approx(5.16020461109629, rel=1e-7)


def test_a_problem_is_fitted_from_the_prompt(tmp_path, capsys):
    """Two conditions that begin at 0.8 and at 2, and equations written by hand; noise of 0.01."""
    rng, rows = np.random.default_rng(0), []
    for condition, a0 in (("c0", 0.8), ("c1", 2.0)):
        for t in np.linspace(0, 5, 11):
            settled = 0.3 * a0
            a = settled + (a0 - settled) * np.exp(-1.0 * t)  # k1 = 0.7, k2 = 0.3
            rows.append(f"obs_a {condition} {t} {a + 0.01 * rng.standard_normal():.6f}")
    path = problem(
        tmp_path,
        conditions="conditionId a0 b0\nc0 0.8 0\nc1 2 0\n",
        parameters=HEADS["parameters"] + "k1 log10 1e-3 1e3 5 1\nk2 log10 1e-3 1e3 0.01 1\n",
        observables=HEADS["observables"] + "obs_a A 0.01\n",
        measurements=HEADS["measurements"] + "\n".join(rows) + "\n",
        yaml=YAML.replace("  sbml_files: [model.xml]\n", ""),
    )
    (tmp_path / "conversion.txt").write_text(EQUATIONS)
    begun(path, tmp_path, "--equations", str(tmp_path / "conversion.txt"))
    capsys.readouterr()
    assert run(["calibrate", "--project", str(tmp_path / "out/bench.toml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["estimate"]["parameters"]
    for name, truth in (("k1", 0.7), ("k2", 0.3)):
        assert abs(found[name]["value"] - truth) < 4 * found[name]["std"]
        assert found[name]["std"] < 0.03


EVENT = SBML.replace("<listOfReactions>", "<listOfEvents><event/></listOfEvents><listOfReactions>")
WRONG = {
    "settles": ({"measurements": HEADS["measurements"].strip() + " preequilibrationConditionId\n"
                 "obs_a c0 0 0.7 c0\n"}, "begins where condition c0 settles"),
    "inf": ({"measurements": HEADS["measurements"] + "obs_a c0 inf 0.7\n"}, "'inf' is no number"),
    "event": ({"sbml": EVENT}, "has an event, which is not read"),
    "version": ({"yaml": YAML.replace("version: 1", "version: 2.0.0")}, "version 2.0.0"),
    "laplace": ({"observables": HEADS["observables"].strip() + " noiseDistribution\n"
                 "obs_a A 1 laplace\n"}, "noise of distribution laplace"),
    "code": ({"observables": HEADS["observables"] + "obs_a __import__('os').getcwd() 1\n"},
             "is more than names"),
    "unknown": ({"observables": HEADS["observables"] + "obs_a A*gain 1\n"}, "gain: neither"),
    "bounds": ({"parameters": HEADS["parameters"] + BEGINS + "k1 lin   1 1\nk2 lin 0 10 0.6 1\n"},
               "k1 has no bounds"),
    "no model": ({"yaml": YAML.replace("  sbml_files: [model.xml]\n", "")}, "give --equations"),
    "observable": ({"measurements": HEADS["measurements"] + "obs_b c0 0 1\n"}, "is of obs_b"),
    "no noise": ({"observables": HEADS["observables"] + "obs_a A 0\n"}, "its noise comes to 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_not_read_is_said_and_nothing_is_written(case, tmp_path, capsys):
    tables, said = WRONG[case]
    path = problem(tmp_path, **tables)
    assert run(["init", path, "-o", str(tmp_path / "out/bench.toml")]) == 1
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_there_is_kept(tmp_path, capsys):
    path = problem(tmp_path)
    words = ["init", path, "-o", str(tmp_path / "bench.toml")]
    (tmp_path / "c0.csv").write_text("mine")
    assert run(words) == 1
    assert "c0.csv is there already" in " ".join(capsys.readouterr().err.split())
    assert (tmp_path / "c0.csv").read_text() == "mine"
    assert not (tmp_path / "bench.toml").exists()
    assert run([*words, "--force"]) == 0
