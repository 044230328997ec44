"""What objects, FRFs and estimates refuse, and what they say of lines they cannot use."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import operando
from operando.data import Frf, ModalModel, TimeRecord
from operando.data.arrays import ByContent, frozen
from operando.data.frf import ROUNDING
from operando.errors import DataError, IdentificationError
from operando.frf import averaged

LINES = np.arange(5, 80, 0.1)
IDLE = ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
MADE = IDLE.frf(LINES, references="1+Z")
RNG = np.random.default_rng(0)


def noisy_record(force_noise: float = 0.0, motion_noise: float = 0.05, n: int = 120_000) -> TimeRecord:
    """White force on the structure, noise on what is measured."""
    rate = 256.0
    force = RNG.standard_normal(n)
    hz = np.fft.rfftfreq(n, 1 / rate)
    hz[0] = 1e-3
    motion = np.fft.irfft(IDLE.frf(hz, references="1+Z").data[:, 0] * np.fft.rfft(force), n)
    motion = motion + motion_noise * motion.std(axis=1, keepdims=True) * RNG.standard_normal(motion.shape)
    channels = [operando.Channel("1+Z", "force", "N"), *(operando.Channel(d, "acceleration", "m/s2") for d in ("1+Z", "2+Z"))]
    return TimeRecord(np.vstack([force + force_noise * RNG.standard_normal(n), motion]), rate, tuple(channels))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"variance": -np.ones((1, 1, 2))}, r"variance of 1\+X/1\+X at 1 Hz is -1; 2 of 2 values cannot be"),
        ({"coherence": 2 * np.ones((1, 1, 2))}, r"coherence of 1\+X/1\+X at 1 Hz is 2"),
        ({"coherence": np.array([[[0.5, -0.1]]])}, r"at 2 Hz is -0.1; 1 of 2"),
        ({"data": "hello"}, "FRF data is 'hello': no numbers"),
        ({"axis": "hello"}, "frequency axis is 'hello': no numbers"),
        ({"axis": [1, 2j]}, "frequency axis is complex, real numbers are due"),
        ({"variance": 1j * np.ones((1, 1, 2))}, "variance is complex"),
        ({"data": np.ma.array(np.ones((1, 1, 2)), mask=[[[0, 1]]])}, "FRF data has 1 masked values"),
    ],
)
def test_values_that_cannot_be_are_refused(given: dict[str, Any], words: str) -> None:
    plain: dict[str, Any] = {"data": np.ones((1, 1, 2)), "axis": [1, 2], "responses": "1+X", "references": "1+X"}
    with pytest.raises(DataError, match=words):
        Frf(**(plain | given))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"frequencies_hz": [20 + 1j]}, "frequencies_hz is complex"),
        ({"covariance": np.full((3, 3), np.nan)}, "not finite"),
        ({"covariance": -np.eye(3)}, "variances below 0"),
        ({"covariance": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "not symmetric"),
        ({"covariance": np.eye(2)}, r"shape \(2, 2\), expected \(3, 3\)"),
    ],
)
def test_modes_that_cannot_be_are_refused(given: dict[str, Any], words: str) -> None:
    plain: dict[str, Any] = {"frequencies_hz": [20.0], "damping_ratios": [0.02], "shapes": [[1.0]], "dofs": "1+Z"}
    with pytest.raises(DataError, match=words):
        ModalModel(**(plain | given))


def test_a_covariance_is_as_exact_as_its_products() -> None:
    """Products that cancel leave less than nothing of a variance: the diagnosis of a mass on a measured plate ended there."""
    rounded = np.diag([1.0, -1e-20, 1e-30])
    rounded[1, 2] = 1e-20
    assert ModalModel([20.0], [0.02], [[1.0]], "1+Z", covariance=rounded).covariance is not None


def test_objects_keep_what_they_were_made_of() -> None:
    data, lines, shapes = np.ones((1, 1, 2)), np.array([1.0, 2.0]), np.ones((1, 1))
    frf = Frf(data, lines, "1+X", "1+X", variance=data.real)
    model = ModalModel([20.0], [0.02], shapes, "1+Z")
    record = TimeRecord(data[0], 100.0, (operando.Channel("1+X", "force", "N"),))
    data[:], lines[:], shapes[:] = 5.0, [3.0, 4.0], 7.0
    assert frf.data.tolist() == [[[1, 1]]]
    assert frf.variance is not None
    assert frf.variance.tolist() == [[[1, 1]]]
    assert frf.frequencies_hz.tolist() == [1, 2]
    assert model.shapes.tolist() == [[1]]
    assert record.data.tolist() == [[1, 1]]
    view = np.ones(4)
    held = frozen(np.broadcast_to(view, (2, 4)))
    view[:] = 3.0
    assert held.max() == 1
    assert np.shares_memory(frozen(held), held)  # what nobody can write into is not copied


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda record, frf: record.select([5]), r"\[5\] names no channels of 3"),
        (lambda record, frf: IDLE.select_terms([9]), r"\[9\] names no terms of 2"),
        (lambda record, frf: IDLE.mode_dict(5), r"\[5\] names no modes of 2"),
        (lambda record, frf: frf.without_bands([(0, 1e6)]), "hold all 750 lines, 5 to 79.9 Hz"),
        (lambda record, frf: frf.at(np.nan), "not all finite"),
        (lambda record, frf: frf.plot(band=(1e3, 2e3)), "holds no lines of the FRFs, which lie at 5 to 79.9 Hz"),
        (lambda record, frf: frf.plot(parts=()), "no part of the figure is named"),
        (lambda record, frf: record.plot_psd(block_seconds=0), "holds no two samples"),
        (lambda record, frf: record.plot_psd(band=(1e3, 2e3)), "which reaches 128 Hz"),
        (lambda record, frf: operando.fit_oma(record, band=(5, 80), references=[]), "names no DOF"),
        (lambda record, frf: operando.estimate_frf(record, estimator="lrm", line_spacing_hz=0), "line_spacing_hz = 0 is no distance"),
        (lambda record, frf: operando.estimate_frf(record, estimator="lrm", line_spacing_hz=500), "lines 500 Hz apart: none from"),
        (lambda record, frf: operando.estimate_frf(record, estimator="lrm", max_lines=0), "max_lines = 0 is no count"),
        (
            lambda record, frf: operando.estimate_frf(record, estimator="lrm", window_lines=99_999),
            "a window of 99999 lines .* fewer window_lines",
        ),
    ],
)
def test_calls_that_cannot_be_met_say_why(call: Callable[[TimeRecord, Frf], object], words: str) -> None:
    with pytest.raises(DataError, match=words):
        call(noisy_record(n=10_000), MADE)


def test_white_noise_has_no_modes() -> None:
    channels = tuple(operando.Channel(d, "acceleration", "m/s2") for d in ("1+Z", "2+Z"))
    noise = TimeRecord(np.random.default_rng(0).standard_normal((2, 20_000)), 1000.0, channels)
    with pytest.raises(IdentificationError, match=r"is certain enough to be a mode|no mode found"):
        operando.fit_oma(noise, band=(5, 400))


def test_one_line_and_one_part_of_an_frf_are_drawn() -> None:
    assert MADE.lines(3).frequencies_hz == pytest.approx([5.3])
    axes = MADE["1+Z", "1+Z"].plot(parts="magnitude")
    IDLE.frf(LINES, "1+Z", "1+Z").plot(axes, labels=["EMA"])
    assert [line.get_label() for line in axes.lines][1:] == ["EMA"]
    MADE.lines([3]).plot()


def test_rounding_of_coherence_and_variance_is_allowed() -> None:
    frf = Frf(np.ones((1, 1, 2)), [1, 2], "1+X", "1+X", variance=np.array([[[1.0, -1e-9]]]), coherence=np.array([[[1.00001, np.nan]]]))
    assert frf.variance is not None
    one = np.ones((1, 1, 2))
    assert Frf(one, [1, 2], "1+X", "1+X", coherence=one + 0.9 * ROUNDING).coherence is not None
    with pytest.raises(DataError, match="coherence"):
        Frf(one, [1, 2], "1+X", "1+X", coherence=one + 1.1 * ROUNDING)


def test_a_coherence_that_cannot_be_is_left_out_of_a_file(tmp_path: Path) -> None:
    frf = replace(MADE, coherence=np.full(MADE.data.shape, 0.9))
    assert frf.coherence is not None
    frf.coherence.flags.writeable = True
    frf.coherence[0, 0, 3] = 7.0
    operando.write_uff(tmp_path / "frf.uff", frf)
    found = operando.read(tmp_path / "frf.uff")
    assert [f.kind for f in found.findings if "coherence" in f.kind] == ["impossible_coherence"]
    assert found.frfs[0].coherence is not None
    assert np.flatnonzero(np.isnan(found.frfs[0].coherence[0, 0])).tolist() == [3]


def test_objects_are_equal_where_their_content_is() -> None:
    hole = MADE.data.copy()
    hole[0, 0, 3] = np.nan
    first, second = replace(MADE, data=hole), replace(MADE, data=hole.copy())
    assert first == second
    assert first != MADE
    assert MADE.axis == operando.FrequencyAxis(LINES)
    assert replace(IDLE, shapes=np.array(IDLE.shapes)) == IDLE
    assert replace(IDLE, shapes=2 * IDLE.shapes) != IDLE
    assert IDLE != "a model"
    record = noisy_record(n=100)
    assert record == replace(record, data=np.array(record.data))
    assert record != replace(record, name="another")
    assert operando.Model(IDLE) == operando.Model(IDLE)
    assert first in [MADE, second]


def test_every_public_class_with_arrays_is_compared_by_content() -> None:
    assert MADE.frequencies_hz is not LINES
    assert IDLE.terms == replace(IDLE).terms
    assert issubclass(type(IDLE.terms), ByContent)
    kinds = [kind for name in operando.__all__ if isinstance(kind := getattr(operando, name), type) and dataclasses.is_dataclass(kind)]
    for kind in kinds:
        if "NDArray" in str(kind.__annotations__) or "Frf" in str(kind.__annotations__) or "ModalModel" in str(kind.__annotations__):
            assert not kind.__dataclass_params__.eq, kind  # type: ignore[attr-defined]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_line_without_a_number_is_left_out_and_said(value: float) -> None:
    data = MADE.data.copy()
    data[1, 0, 150] = value
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = operando.fit_ema(replace(MADE, data=data, variance=None), band=(10, 70))
    np.testing.assert_allclose(model.frequencies_hz, [20, 45], rtol=1e-4)
    said = [f.message for f in model.findings if f.kind == "nan"]
    assert said == ["1 line of the FRF 2+Z/1+Z hold no number (20 Hz)"]


def test_frfs_that_are_all_zero_are_refused() -> None:
    with pytest.raises(DataError, match="all values of the FRFs are zero"):
        operando.fit_ema(replace(MADE, data=0 * MADE.data), band=(10, 70))


@pytest.mark.parametrize("order", [0, -3, 10.5, "many", float("nan")])
def test_an_order_that_is_none_is_refused(order: Any) -> None:
    with pytest.raises(DataError, match="give a whole number from 1 on"):
        operando.fit_ema(MADE, band=(10, 70), max_order=order)


def test_an_order_that_the_lines_do_not_allow_for_is_said() -> None:
    model = operando.fit_ema(MADE, band=(10, 70), max_order=2000)
    assert [f.kind for f in model.findings if f.kind == "no_diagram"] == ["no_diagram"]
    assert model.n_modes == 2


@pytest.mark.parametrize("seconds", [-1, 0, float("nan"), float("inf")])
def test_blocks_of_no_length_are_refused(seconds: float) -> None:
    with pytest.raises(DataError, match="give a positive number of seconds"):
        operando.estimate_frf(noisy_record(n=2000), estimator="h1", block_seconds=seconds)


def test_the_estimator_is_named_in_any_case() -> None:
    record = noisy_record(n=4000)
    large, small = (operando.estimate_frf(record, estimator=name, block_seconds=4.0) for name in ("H1", "h1"))
    np.testing.assert_array_equal(large.data, small.data)


@pytest.mark.parametrize(("estimator", "said"), [("h1", False), ("h2", True), ("hv", True)])
def test_the_bias_by_noise_on_the_responses_is_said(estimator: str, said: bool) -> None:
    frf = operando.estimate_frf(noisy_record(motion_noise=0.3), estimator=estimator, block_seconds=4.0)
    found = [f for f in frf.findings if f.kind == "biased_estimator"]
    assert bool(found) is said
    for finding in found:
        assert "of the FRFs, on average" in finding.message
        assert estimator.capitalize() in (finding.consequence or "")


@pytest.mark.parametrize(("of_limit", "said"), [(0.8, True), (1.25, False)])
def test_a_bias_is_said_from_three_standard_deviations_on(monkeypatch: pytest.MonkeyPatch, of_limit: float, said: bool) -> None:
    assert averaged.BIASED == 9.0
    record = noisy_record(motion_noise=0.3)
    noisy = lambda: operando.estimate_frf(record, estimator="h2", block_seconds=10.0)  # noqa: E731
    [finding] = [f for f in noisy().findings if f.kind == "biased_estimator"]
    times = float(finding.message.split("on average ")[1].split(" times")[0])
    monkeypatch.setattr(averaged, "BIASED", of_limit * times**2)
    assert ("biased_estimator" in {f.kind for f in noisy().findings}) is said


def test_h2_without_noise_is_not_said_to_be_biased() -> None:
    frf = operando.estimate_frf(noisy_record(motion_noise=1e-9), estimator="h2", block_seconds=60.0)
    assert "biased_estimator" not in {f.kind for f in frf.findings}


def test_a_band_that_is_none_says_what_is_wrong() -> None:
    with pytest.raises(DataError, match="the band of 50 to 10 Hz is reversed"):
        MADE.band(50, 10)
    with pytest.raises(DataError, match="the band of 500 to 600 Hz holds no lines of the FRFs, which lie at 5 to"):
        MADE.band(500, 600)
    with pytest.raises(DataError, match="the band of -5 to 60 Hz begins below 0 Hz"):
        operando.fit_ema(MADE, band=(-5, 60))
    with pytest.raises(DataError, match="reversed"):
        operando.fit_ema(MADE, band=(60, 5))
    with pytest.raises(IdentificationError, match="holds 0 lines"):
        operando.fit_ema(MADE, band=(500, 600))
    with pytest.raises(DataError, match="reversed"):
        operando.estimate_frf(noisy_record(n=2000), band=(60, 5))


def test_the_table_of_frfs_holds_deviation_and_coherence() -> None:
    pytest.importorskip("pandas")
    frf = replace(MADE, variance=np.full(MADE.data.shape, 4.0), coherence=np.full(MADE.data.shape, 0.9))
    table = frf.to_dataframe()
    assert table["2+Z", "1+Z"].iloc[3] == frf.data[1, 0, 3]
    assert table["2+Z", "1+Z std"].iloc[3] == 2.0
    assert table["2+Z", "1+Z coherence"].iloc[3] == 0.9
    assert MADE.to_dataframe().shape == (LINES.size, 2)
