"""Structural rank from Lie derivatives: the answers of the literature, and in words."""

from __future__ import annotations

import json

import numpy as np
import pytest

from casest import DeclarationError, log, norm_2, signal
from casest.cli import run
from casest.dynamics import Motion, dynamics, measured, state
from casest.dynamics.structural import structure
from casest_problems.bias_gravity import bias_gravity, bias_gravity_position


@dynamics
def two_compartments(
    u=signal("1"),
    y=signal("1"),
    *,
    x1=state(),
    x2=state(),
    k1e=state("1/s"),
    k12=state("1/s"),
    k21=state("1/s"),
    b=state("1/s"),
):
    """Villaverde, Evans, Chappell & Banga (2019), IEEE Control Systems Letters 3, 272-277."""
    rates = {"x1": -(k1e + k12) * x1 + k21 * x2 + b * u, "x2": k12 * x1 - k21 * x2}
    return Motion(rates=rates, outputs=(measured(y, x1, intensity=1.0),))


def lotka_volterra(outputs):
    """x' = a x - b x y, y' = -c y + d x y."""

    @dynamics
    def predation(seen=signal(2), *, prey=state(), predator=state(),
                  a=state(), b=state(), c=state(), d=state()):  # fmt: skip
        rates = {"prey": a * prey - b * prey * predator,
                 "predator": -c * predator + d * prey * predator}  # fmt: skip
        either = {"prey": prey, "predator": predator}
        parts = [measured(seen, both(*(either[n] for n in outputs)), intensity=1.0)]
        return Motion(rates=rates, outputs=tuple(parts))

    return predation


def both(*parts):
    from casest import vertcat

    return vertcat(*(parts if len(parts) == 2 else parts * 2))


@dynamics
def lecourtier(u=signal("1"), y=signal("1"), *, x1=state(), x2=state(), x3=state(),
               p1=state(), p2=state(), p3=state(), p4=state()):  # fmt: skip
    """Lecourtier, Lamnabhi-Lagarrigue & Walter (1987), as in StructuralIdentifiability.jl."""
    rates = {"x1": -p1 * x1 + p2 * u, "x2": -p3 * x2 + p4 * u,
             "x3": -(p1 + p3) * x3 + (p4 * x1 + p2 * x2) * u}  # fmt: skip
    return Motion(rates=rates, outputs=(measured(y, x3, intensity=1.0),))


def test_two_compartments_are_identifiable_where_the_input_varies():
    found = structure(two_compartments)
    assert (found.rank, found.undetermined) == (6, ())
    assert found.gap > 1e6


def test_two_compartments_are_not_where_it_is_constant():
    """y'' + (k1e + k12 + k21) y' + k1e k21 y = b k21 u: three numbers for four parameters."""
    found = structure(two_compartments, varying=False)
    assert found.rank == 5
    assert set(found.undetermined) == {"x2", "k1e", "k12", "k21", "b"}
    assert found.gap > 1e6


def test_prey_alone_tells_all_but_the_scale_of_the_predators():
    """Known result (SIAN; Dong et al. 2023): a, c and d are identifiable, b is not."""
    found = structure(lotka_volterra(["prey"]))
    assert found.rank == 5
    assert found.undetermined == ("predator", "b")
    assert found.unobservable == ("only the product of predator and b is seen",)


def test_prey_and_predators_tell_everything():
    assert structure(lotka_volterra(["prey", "predator"])).observable


def test_a_pair_that_is_known_up_to_its_order_is_locally_observable():
    """StructuralIdentifiability.jl: p1 + p3, p1 p3 and p2 p4 are identifiable; p2, p4 are not."""
    found = structure(lecourtier)
    assert found.rank == 6
    assert found.undetermined == ("x1", "x2", "p2", "p4")
    words = "multiplying x1 and p2 by λ and x2 and p4 by 1/λ changes no reading"
    assert found.unobservable == (words,)


@pytest.mark.parametrize("model", [bias_gravity, bias_gravity_position])
def test_gravity_and_bias_need_a_rate_of_turn_that_varies(model):
    """Batista et al.: observable if and only if the direction of the angular velocity changes."""
    assert structure(model).observable
    held = structure(model, varying=False)
    assert held.rank == model.size - 1
    assert held.unobservable == ("gravity and bias along omega cannot be told apart",)


def test_units_do_not_count():
    """A range to a beacon with numbers of very different size."""

    @dynamics
    def beacon(y=signal("m"), *, place=state(3, "m", std=1e6), speed=state(3, "m/s", std=1e-3)):
        distance = norm_2(place * 1e6)
        return Motion(rates={"place": 1e-3 * speed}, outputs=(measured(y, distance, intensity=1),))

    found = structure(beacon)
    assert found.rank == 3  # length of place, and of speed along and across it
    assert found.gap > 1e3


def test_what_no_reading_depends_on_is_named():
    @dynamics
    def lonely(y=signal("m"), *, x=state("m"), other=state("m")):
        return Motion(rates={}, outputs=(measured(y, x, intensity=1.0),))

    assert structure(lonely).unobservable == ("other changes no reading",)


def test_time_runs_at_its_own_pace():
    """y = x·t: with time the state is seen, though the reading depends on no other input."""

    @dynamics
    def growing(t=signal("s"), y=signal("m"), *, x=state("m/s"), rate=state("m/s^2")):
        out = measured(y, x * t + rate * t**2, intensity=1.0)
        return Motion(rates={}, outputs=(out,))

    assert structure(growing).observable


def test_a_model_without_a_point_that_makes_sense_is_refused():
    @dynamics
    def nowhere(y=signal("m"), *, x=state("m")):
        return Motion(rates={}, outputs=(measured(y, log(-(x**2) - 1), intensity=1.0),))

    with pytest.raises(DeclarationError, match="not finite at 50 random points"):
        structure(nowhere)


# -- through the command line ----------------------------------------------------------------------


PREDATION = """
from casest import signal
from casest.dynamics import Motion, dynamics, measured, state

@dynamics
def predation(y=signal(), *, prey=state(), predator=state(), a=state(), b=state(), c=state(), d=state()):
    rates = {"prey": a * prey - b * prey * predator, "predator": -c * predator + d * prey * predator}
    return Motion(rates=rates, outputs=(measured(y, prey, intensity=1.0),))
"""  # noqa: E501


@pytest.fixture
def told(capsys):
    def call(*words):
        assert run(["observe", *words]) == 0
        return capsys.readouterr().out

    return call


def test_without_data_observe_says_the_structural_rank(told, tmp_path):
    (tmp_path / "lv.py").write_text(PREDATION, encoding="utf-8")
    said = told(str(tmp_path / "lv.py"))
    assert "predation: structural rank 5 of 6" in said
    assert "only the product of predator and b is seen" in said
    assert "not determined by any record: predator, b" in said


def test_what_constant_inputs_hide_is_said(told, tmp_path):
    said = told("bias-gravity", "-o", str(tmp_path))
    assert "structural rank 9 of 9" in said
    assert "with a and omega held constant: rank 8 of 9" in said
    assert "gravity and bias along omega cannot be told apart" in said
    assert (
        json.loads((tmp_path / "observe.json").read_text("utf-8"))["constant_inputs"]["rank"] == 8
    )
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "suitable data determine all 9 unknowns" in page
    assert "With constant inputs" in page


def test_a_record_that_hides_something_says_whether_another_would_not(told, tmp_path):
    t = np.arange(0, 5, 0.05)
    rng = np.random.default_rng(0)
    turn = np.c_[0 * t, 0 * t, 0.3 + 0.1 * np.sin(t)]
    table = np.c_[t, rng.standard_normal((len(t), 3)), turn, rng.standard_normal((len(t), 3))]
    names = ["t [s]", *(f"a{c} [m/s^2]" for c in "xyz"), *(f"omega_{c} [rad/s]" for c in "xyz")]
    head = ",".join([*names, *(f"v{c} [m/s]" for c in "xyz")])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=head, comments="")
    said = told("bias-gravity", str(tmp_path / "r.csv"))
    assert "rank 8 of 9" in said
    assert "another motion could show more: the structural rank is 9" in said


def test_a_calibration_needs_data(capsys):
    assert run(["observe", "wheel"]) == 1
    said = capsys.readouterr().err
    assert said == "casest: wheel: what can be seen depends on the record: give DATA\n"
