import numpy as np
import pytest

from operando.data import FrequencyAxis, Frf, ModalModel, TimeRecord
from operando.data.time import Channel
from operando.dof import Dof, match_dofs
from operando.errors import DataError, DofError, UnitError
from operando.indicators import mac, mean_phase_deviation
from operando.units import parse_unit, si_factor
from structures import Chain


@pytest.mark.parametrize(("text", "shown"), [("12+Z", "12+Z"), ("12Z", "12+Z"), ("7-X", "7-X"), ("101+ry", "101+RY"), ("12", "12")])
def test_dof_labels(text, shown):
    dof = Dof.parse(text)
    assert str(dof) == shown
    assert Dof.from_uff(dof.node, dof.uff_code) == dof


@pytest.mark.parametrize("text", ["", "Z", "12+", "12+W", "-3+X", "1.5+X"])
def test_bad_dof_label(text):
    with pytest.raises(DofError, match="no DOF label"):
        Dof.parse(text)


def test_match_dofs_gives_signs():
    have = (Dof.parse("1+Z"), Dof.parse("2-Z"))
    assert match_dofs((Dof.parse("2+Z"), Dof.parse("1-Z")), have) == ([1, 0], [-1, -1])
    with pytest.raises(DofError, match="not measured"):
        match_dofs((Dof.parse("3+Z"),), have)


@pytest.mark.parametrize(
    ("unit", "quantity", "factor"),
    [("g", "acceleration", 9.80665), ("m/s^2", "acceleration", 1), ("m/s²", "acceleration", 1), ("m/sec**2", "acceleration", 1),
     ("lbf", "force", 4.4482216152605), ("in", "displacement", 0.0254), ("kN", "force", 1e3), ("mN", "force", 1e-3),
     ("MN", "force", 1e6), ("in/s^2", "acceleration", 0.0254), ("[mm]", "displacement", 1e-3)],
)  # fmt: skip
def test_units(unit, quantity, factor):
    assert parse_unit(unit, quantity) == (quantity, pytest.approx(factor, rel=1e-12))


def test_unit_of_other_quantity():
    with pytest.raises(UnitError, match="unit of force"):
        si_factor("N", "acceleration")
    with pytest.raises(UnitError, match="unknown unit"):
        si_factor("furlong")
    with pytest.raises(UnitError, match=r"for displacement \(known: cm, ft, in, m, mil, mm, nm, um\)"):
        si_factor("furlong", "displacement")


def test_record_invariants():
    with pytest.raises(DataError, match="rows"):
        TimeRecord(np.zeros((2, 5)), 100.0, (Channel(None),))
    record = TimeRecord(np.zeros((1, 5)), 100.0, (Channel(Dof.parse("1+Z"), "force"),))
    assert record.force_indices == [0]
    with pytest.raises(ValueError):
        record.data[0, 0] = 1


def test_model_frf_is_the_chain():
    chain = Chain(5)
    model = ModalModel(chain.hz, chain.zeta, chain.phi, tuple(f"{i}+Z" for i in range(1, 6)), "unit_modal_mass")
    f = np.linspace(5, 150, 400)
    frf = model.frf(f, "3-Z", "1+Z,2+Z")
    exact = chain.accelerance(f, [2], [0, 1])
    assert np.allclose(frf.data, -exact, rtol=1e-12, atol=1e-12)
    w = 2j * np.pi * f
    assert np.allclose(frf.to_quantity("receptance").data * w**2, frf.data)
    assert frf.select("3+Z", "2-Z").data == pytest.approx(-frf.data[:, 1:] * -1)


def test_quantity_at_zero_is_nan():
    frf = Frf(np.ones((1, 1, 3)), FrequencyAxis.even(0, 1, 3), ("1+Z",), ("1+Z",))
    converted = frf.to_quantity("receptance")
    assert np.isnan(converted.data[0, 0, 0])
    assert np.isfinite(converted.data[0, 0, 1:]).all()


def test_indicators():
    v = np.array([1.0, -2.0, 0.5])
    assert mac(v, v * (2 - 3j)) == pytest.approx(1)
    assert mean_phase_deviation(v * np.exp(0.7j)) == pytest.approx(0, abs=1e-7)
    assert mac(np.zeros(3), v) == 0


def test_covariance_selection_keeps_blocks():
    rng = np.random.default_rng(1)
    n, m = 3, 2
    a = rng.normal(size=(2 * n + 2 * n * m, 40))
    model = ModalModel([1.0, 2, 3], [0.01] * 3, rng.normal(size=(m, n)) + 1j, ("1+Z", "2+Z"), covariance=a @ a.T)
    part = model.select_modes([2, 0])
    assert part.frequency_std_hz == pytest.approx(model.frequency_std_hz[[2, 0]])
    assert part.shape_std == pytest.approx(model.shape_std[:, [2, 0]])
