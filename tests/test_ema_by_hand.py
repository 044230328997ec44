"""Modes named by hand: what a frequency means, what is refused, and what is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from operando.data import Frf, ModalModel
from operando.ema import fit_ema, poles_by_hand
from operando.ema.by_hand import NEAR_WIDTHS, _with_marks, modes_by_hand
from operando.ema.candidates import Candidate
from operando.errors import DataError, IdentificationError, ObjectError
from operando.stabilization import HAND_TOLERANCE

HZ = np.array([27.24, 30.33, 58.49])
ZETA = np.array([0.0098, 0.0073, 0.0044])
SHAPES = np.array([[0.5, 0.4, 0.6], [0.3, -0.6, 0.2], [-0.4, 0.2, 0.5], [0.6, 0.3, -0.4]])
DOFS = "1+Z, 2+Z, 3+Z, 4+Z"
F = np.arange(5.0, 80.0, 0.1)
BAND = (20.0, 70.0)


def candidate(hz, zeta):
    """What one fit of twenty saw."""
    return Candidate(hz, zeta, np.ones(4, complex), 1, 20, 0.5, 0.0, False)


@pytest.fixture(scope="module")
def found():
    truth = ModalModel(HZ, ZETA, SHAPES, DOFS, "unit_modal_mass")
    h = truth.frf(F, references="1+Z, 4+Z")
    rng = np.random.default_rng(0)
    size = 1e-3 * np.sqrt(np.mean(np.abs(h.data) ** 2) / 2)
    frf = Frf(h.data + size * (rng.standard_normal(h.data.shape) + 1j * rng.standard_normal(h.data.shape)), F, h.responses, h.references)
    model = fit_ema(frf, band=BAND, ema="linear")
    return frf, replace(model, details=replace(model.details, candidates=tuple(c for c in model.details.candidates if c.prominent)))


def with_candidates(model, *others):
    return replace(model, details=replace(model.details, candidates=(*model.details.candidates, *others)))


def by_hand(found, *others, **asked):
    frf, model = found
    return fit_ema(frf, band=BAND, automatic=with_candidates(model, *others), **asked)


def test_the_modes_are_found(found):
    np.testing.assert_allclose(found[1].frequencies_hz, HZ, rtol=1e-4)


def test_a_frequency_means_a_pole_within_the_tolerance_whatever_its_damping(found):
    """29 Hz reached a candidate of large damping at 28.28 Hz, 2.5 % off, which the fit then moved to the mode at 27.24 Hz."""
    broad = candidate(28.283, 0.05)
    assert abs(28.283 / HZ[0] - 1) > NEAR_WIDTHS * ZETA[0]
    with pytest.raises(
        IdentificationError, match=r"near 29 Hz; the nearest is at 28.283 Hz, the next at 30.3\d* Hz; .* within 1 %"
    ) as caught:
        by_hand(found, broad, modes_hz=[29.0])
    assert caught.value.hint
    with pytest.raises(IdentificationError, match="no stable pole near 26 Hz"):
        by_hand(found, broad, modes_hz=[26.0, 28.0])


@pytest.mark.parametrize("times", [0.99, 1.01])
def test_one_tolerance_for_modes_taken_and_left_out(found, times):
    hz = float(found[1].frequencies_hz[1]) / (1 - times * HAND_TOLERANCE)
    if times < 1:
        assert by_hand(found, modes_hz=hz).frequencies_hz == pytest.approx([HZ[1]], rel=1e-4)
        assert by_hand(found, reject_hz=hz).n_modes == 2
        return
    for key in ("modes_hz", "select_hz", "reject_hz"):
        with pytest.raises(IdentificationError, match="no stable pole near 30"):
            by_hand(found, **{key: hz})


def test_of_two_poles_the_nearest_counts(found):
    pool = poles_by_hand(with_candidates(found[1], candidate(57.5, 0.004)))
    assert (57.5, 0.004, -1) in pool
    assert by_hand(found, candidate(57.5, 0.004), modes_hz=[58.1]).frequencies_hz == pytest.approx([HZ[2]], rel=1e-4)


def test_a_pole_that_becomes_a_part_of_a_mode_is_refused(found):
    """Without the mode in the fit it came out as one beside it, with a damping of several per cent."""
    frf, model = found
    fewer = fit_ema(frf, band=BAND, automatic=model, reject_hz=HZ[0])
    assert fewer.n_modes == 2
    two = with_candidates(fewer, candidate(27.0, 0.04), candidate(27.6, 0.02))
    with pytest.raises(IdentificationError, match=r"no stable pole near 27.* once it is fitted"):
        fit_ema(frf, band=BAND, automatic=two, modes_hz=[27.0, 27.6])


@pytest.mark.parametrize("times", [0.99, 1.01])
def test_a_part_of_a_mode_lies_within_a_few_half_bandwidths_of_it(found, times):
    """NEAR_WIDTHS, for what a fit makes of a candidate as for the candidates themselves."""
    model = found[1]
    hz, zeta = float(model.frequencies_hz[2]), float(model.damping_ratios[2])
    there = hz * (1 + times * NEAR_WIDTHS * zeta)
    if times > 1:
        assert (there, 0.01, -1) in poles_by_hand(with_candidates(model, candidate(there, 0.01)))
        return
    assert (there, 0.01, -1) not in poles_by_hand(with_candidates(model, candidate(there, 0.01)))

    def fitted(poles_hz, _):
        return SimpleNamespace(mean_hz=np.array([*poles_hz[:-1], there]), poles=SimpleNamespace(zeta=np.full(4, 0.004))), None

    near = with_candidates(model, candidate(hz * (1 + 1.2 * NEAR_WIDTHS * zeta), 0.01))
    with pytest.raises(IdentificationError, match=r"near 59.3 .* once it is fitted, a part of the one at 58.\d* Hz; the nearest is at 58"):
        modes_by_hand(near, (59.3,), (), (), fitted)


def test_a_pole_in_doubt_named_by_hand_is_said(found):
    frf, model = found
    named = by_hand(found, candidate(45.876, 0.0048), select_hz=45.876)
    assert abs(named.frequencies_hz[2] / 45.876 - 1) <= HAND_TOLERANCE
    said = [f for f in named.findings if f.kind == "doubtful_by_hand"]
    assert len(said) == 1
    assert said[0].consequence
    assert said[0].action
    again = fit_ema(frf, band=BAND, automatic=fit_ema(frf, band=BAND, automatic=model, reject_hz=HZ[1]), select_hz=HZ[1])
    np.testing.assert_allclose(again.frequencies_hz, HZ, rtol=1e-4)
    assert not [f for f in again.findings if f.kind == "doubtful_by_hand"]


def test_modes_by_hand_stand_in_rising_order(found):
    frf, model = found
    residual = model.terms.residual.copy()
    residual[0] = True  # in doubt: it stands behind the modes
    named = fit_ema(frf, band=BAND, automatic=_with_marks(model, residual), modes_hz=HZ[[2, 0, 1]])
    np.testing.assert_allclose(named.frequencies_hz, HZ, rtol=1e-4)
    np.testing.assert_allclose(named.damping_ratios, model.damping_ratios, rtol=1e-9)
    np.testing.assert_allclose(named.shapes, model.shapes, rtol=1e-9)
    np.testing.assert_allclose(named.frequency_std_hz, model.frequency_std_hz, rtol=1e-9)
    np.testing.assert_allclose(named.details.stabilization.selected_hz, named.frequencies_hz)


@pytest.mark.parametrize(
    "asked",
    [
        {"modes_hz": [27.2, 27.25]},
        {"modes_hz": [27.2, 58.5, 27.25]},
        {"modes_hz": [27.2], "select_hz": [27.25]},
        {"reject_hz": [27.2, 27.25]},
    ],
)
def test_two_frequencies_that_reach_one_pole_are_refused(found, asked):
    with pytest.raises(IdentificationError, match=r"27.2 Hz and 27.25 Hz reach one pole, at 27.24\d* Hz; the nearest other") as caught:
        by_hand(found, **asked)
    assert "leave one" in caught.value.hint


def test_a_mode_that_is_there_may_be_selected(found):
    same = by_hand(found, select_hz=[27.2])
    np.testing.assert_array_equal(same.frequencies_hz, found[1].frequencies_hz)
    assert "27.2 Hz, which is a mode already" in same.details.rounds[-1]


def test_one_number_is_a_list_of_one(found):
    assert by_hand(found, modes_hz=27.2).n_modes == 1
    assert by_hand(found, reject_hz=27.2).n_modes == 2
    assert by_hand(found, modes_hz=np.array([27.2, 30.3]), select_hz=None).n_modes == 2
    for wrong in (-27.2, [np.nan], [[27.2]]):
        with pytest.raises(DataError, match=r"modes_hz .*: expected a list of positive frequencies"):
            by_hand(found, modes_hz=wrong)


def test_what_is_no_model_is_refused(found):
    with pytest.raises(ObjectError, match="automatic is the model that other modes are chosen in, not Frf"):
        fit_ema(found[0], band=BAND, modes_hz=[27.2], automatic=found[0])


def test_a_band_ends_with_the_lines(found):
    frf, model = found
    last = float(frf.frequencies_hz[-1])
    for high, kinds in ((last + 0.05, []), (700.0, ["band_beyond_lines"])):
        named = fit_ema(frf, band=(20.0, high), modes_hz=[27.2], automatic=model)
        assert [f.kind for f in named.findings if f.kind == "band_beyond_lines"] == kinds
    wide = fit_ema(frf, band=(20.0, 700.0), ema="linear")
    assert wide.band_hz == (20.0, last)
    again = fit_ema(frf, band=(20.0, 700.0), automatic=wide, modes_hz=[27.2])
    assert [f.kind for f in again.findings].count("band_beyond_lines") == 1


def test_the_short_form_counts_the_modes_in_band(found):
    model = found[1]
    assert "3 modes at 27.24, 30.33, 58.49 Hz;" in repr(model)
    assert "2 modes at 27.24, 58.49 Hz in band, 1 outside the band;" in repr(replace(model, in_band=[True, False, True]))
    assert "0 modes in band, 3 outside the band;" in repr(replace(model, in_band=[False] * 3))
