"""Arguments of the Python interface that are of another kind, hold no numbers or name nothing: each is refused with words and advice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import operando
from operando import contrib, plots
from operando.errors import DataError, OperandoError

IDLE = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
RUNNING = operando.ModalModel([21.0, 46.0], [0.01, 0.02], np.array([[1, 1.1], [0.9, -1]]) + 0j, "1+Z, 2+Z")
FRF = IDLE.frf(np.arange(5, 80, 0.25), references="1+Z")
FORCE, MOTION = operando.Channel("1+Z", "force", "N"), operando.Channel("1+Z", "acceleration", "m/s2")
NOISE = np.random.default_rng(0).standard_normal((2, 2000))
RECORD = operando.TimeRecord(NOISE, 256.0, [FORCE, MOTION])
BOTH = [MOTION, operando.Channel("2+Z", "acceleration", "m/s2")]
MOVED = operando.TimeRecord(NOISE, 256.0, BOTH)
MASSIVE = operando.Model(IDLE).add("point_mass@1+Z=mass:0.2")
TEST = operando.load_test(Path(__file__).parents[1] / "data" / "example" / "test.toml")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: operando.TimeRecord("hello", 256, [FORCE]), "record data is 'hello': no numbers"),
        (lambda: operando.TimeRecord([[1, 2], [3]], 256, [FORCE, MOTION]), "no numbers"),
        (lambda: operando.TimeRecord(NOISE * 1j, 256, [FORCE, MOTION]), "record data are complex"),
        (lambda: operando.TimeRecord(NOISE, "fast", [FORCE, MOTION]), "sampling rate 'fast': no numbers"),
        (lambda: operando.TimeRecord(NOISE, [256, 256], [FORCE, MOTION]), "is not one finite number"),
        (lambda: operando.TimeRecord(NOISE, 256, None), "expected tuple[Channel"),
        (lambda: operando.TimeRecord(NOISE, 256, [{"dof": "1+Z"}, {"dof": "2+Z"}]), "expected tuple[Channel"),
        (lambda: operando.TimeRecord(NOISE, 256, [FORCE, MOTION], start_s="noon"), "start_s 'noon': no numbers"),
        (lambda: operando.Channel("1+Z", "acceleration", 9.81), "the unit is 9.81, no text"),
        (lambda: operando.Channel("1+Z", ["force"], "N"), "unknown quantity"),
        (lambda: operando.Frf(10**400, [1.0], "1+X", "1+X"), "no numbers"),
        (lambda: operando.estimate_frf(RECORD, references=[]), "references [] names no DOF"),
        (lambda: operando.estimate_frf(RECORD, block_seconds="long"), "block_seconds 'long': no numbers"),
        (lambda: operando.estimate_frf(RECORD, overlap="half"), "overlap 'half': no numbers"),
        (lambda: operando.estimate_frf(RECORD, hits_reject=3), "hits are named by texts, not int"),
        (lambda: operando.estimate_frf(RECORD, hits=["auto"]), "is none of auto, all, off"),
        (lambda: operando.fit_ema(FRF, exclude_bands=(24, 25)), "exclude_bands (24, 25) is no list of bands"),
        (lambda: operando.fit_ema(FRF, exclude_bands=[(25, 24)]), "is reversed"),
        (lambda: operando.fit_ema(FRF, exclude_bands=None), "is no list of bands"),
        (lambda: operando.fit_ema(FRF, records="run1.uff"), "the whole records are fitted, not str"),
        (lambda: operando.fit_ema(FRF, ema=["auto"]), "is not known"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), max_order="many"), "max_order = 'many' is no count"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), max_order=0), "max_order = 0 is no count"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), block_rows=-1), "block_rows = -1 is no count"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), block_rows=0), "block_rows = 0 is no count"),
        (lambda: IDLE.animate(0, operando.Geometry((1, 2), np.eye(2, 3)), frames=0), "frames = 0 is no count"),
        (lambda: operando.ModalModel([20.0], [0.01], [[1.0], [1.0]], "1+Z, 1-Z"), "DOF 1-Z appears twice (in either sense)"),
        (lambda: operando.Geometry((1, 7), [[0, 0, 0], [0, np.nan, 0]]), "the coordinates of node 7 are no finite numbers"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), known_harmonics_hz="24.6 Hz"), "known_harmonics_hz '24.6 Hz': no numbers"),
        (lambda: operando.fit_oma(MOVED, band=(5, 100), known_harmonics_hz=[np.nan]), "expected a list of positive frequencies"),
        (lambda: operando.scale_operational(IDLE, RUNNING, threshold="high"), "threshold 'high': no numbers"),
        (lambda: operando.scale_operational(IDLE, RUNNING, method=["auto"]), "is none of auto"),
        (lambda: operando.compare(IDLE, FRF, 30), "band 30 is no pair of frequencies"),
        (lambda: operando.compare(IDLE, RUNNING, (60, 10)), "is reversed"),
        (lambda: operando.Effect("point_mass", "1+Z", ["mass", 1]), "the values of point_mass are"),
        (lambda: operando.Effect(["point_mass"], "1+Z"), "unknown kind of effect"),
        (lambda: operando.parse_effect(None), "an effect is read from a text, not NoneType"),
        (lambda: operando.Model(IDLE, "point_mass@1+Z=mass:0.2"), "a model is made of effects, not str"),
        (lambda: operando.read("run1.uff", units="g"), "units is 'g'"),
        (lambda: operando.read("run1.uff", units={"accelerations": "g"}), "unknown key 'accelerations'"),
        (lambda: operando.read("run1.uff", channels=["1+Z"]), "channels is ['1+Z']"),
        (lambda: operando.write_uff(None, FRF), "a file is written to its path, not NoneType"),
        (lambda: operando.write_uff("", FRF), "a file is written to its path, not ''"),
        (lambda: operando.write_uff(".", FRF), "'.' names no file"),
        (lambda: operando.read(""), "a file is read from its path, not ''"),
        (lambda: FRF.without_bands([24, 25]), "is no list of bands"),
        (lambda: FRF[[], "1+Z"], "[] names no DOF"),
        (lambda: FRF.select("", None), "'' names no DOF"),
        (lambda: IDLE.frf([10.0], references=[]), "[] names no DOF"),
        (lambda: operando.Model(IDLE).frf([10.0], []), "[] names no DOF"),
        (lambda: operando.Model(IDLE).frf(["low"]), "frequencies ['low']: no numbers"),
        (lambda: IDLE.frf(FRF), "no numbers"),
        (lambda: RECORD[[]], "[] names no channel"),
        (lambda: FRF.plot(band="low"), "band 'low': no numbers"),
        (lambda: FRF.plot(band=(60, 10)), "is reversed"),
        (lambda: MOVED.plot_psd(band=(10,)), "is no pair of frequencies"),
        (lambda: MOVED.plot_psd(block_seconds=np.nan), "is not one finite number"),
        (lambda: plots.plot_nyquist(FRF, band=5), "is no pair of frequencies"),
        (lambda: MASSIVE.with_values(1, mass="2"), "mass of point_mass is '2'"),
        (lambda: MASSIVE.with_values(1, mass=[1, 2]), "mass of point_mass is [1, 2]"),
        (lambda: MASSIVE.with_values(1, mass=None), "mass of point_mass is None"),
        (lambda: MASSIVE.with_values(1, mass=np.nan), "mass of point_mass cannot be nan kg"),
        (lambda: operando.run(TEST, progress=3), "progress is 3, which cannot be called"),
        (lambda: operando.load_test(TEST.path, [3]), "changes are [3]"),
        (lambda: operando.load_test(TEST.path, "analysis.band=[1,2]"), "changes are 'analysis.band=[1,2]'"),
        (lambda: operando.Model(IDLE, geometry="frame.uff"), "effects stand on a geometry, not str"),
        (lambda: operando.diagnose(IDLE, check=FRF, geometry="frame.uff"), "effects stand on a geometry, not str"),
        (lambda: operando.diagnose(IDLE, check=FRF, operating="run1.uff"), "operating takes operational modes, not str"),
        (lambda: operando.diagnose(IDLE, check=FRF, kinds=3), "kinds of effects have names, not int"),
        (
            lambda: operando.apply_effects(IDLE, "point_mass@1+Z=mass:0.2", check=FRF, band=np.array([10, 20, 30])),
            "is no pair of frequencies",
        ),
    ],
)
def test_a_wrong_argument_is_refused_with_advice(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(OperandoError) as error:
        call()
    assert said in str(error.value)
    assert error.value.hint


def test_one_harmonic_and_one_record_are_lists_of_one() -> None:
    tone = np.sin(2 * np.pi * 24.6 * np.arange(20_000) / 256.0)
    noise = np.random.default_rng(1).standard_normal((2, 20_000))
    record = operando.TimeRecord(_shaken(noise) + tone, 256.0, BOTH)
    one, several = (operando.fit_oma(record, band=(10, 60), known_harmonics_hz=known) for known in (24.6, [24.6]))
    np.testing.assert_array_equal(one.frequencies_hz, several.frequencies_hz)


def _shaken(noise: np.ndarray) -> np.ndarray:
    """Motion of the two DOFs under noise at both."""
    hz = np.fft.rfftfreq(noise.shape[1], 1 / 256.0)
    hz[0] = 1e-3
    return np.fft.irfft(np.einsum("ijk,jk->ik", IDLE.frf(hz).data, np.fft.rfft(noise)), noise.shape[1])


def test_numbers_that_are_written_otherwise_are_taken() -> None:
    record = operando.TimeRecord([[0, 1, 2], [3, 4, 5]], np.float32(256), iter([FORCE, MOTION]))
    assert record.data.dtype == float
    assert (record.sampling_hz, type(record.sampling_hz)) == (256.0, float)
    assert operando.Channel(12).label == "12"
    assert FRF.without_bands(()) is FRF
    with pytest.raises(DataError, match="not positive"):
        operando.TimeRecord([[0.0, 1.0]], 0.0, [MOTION])


@pytest.mark.parametrize(
    "draw",
    [
        plots.plot_comparison,
        plots.plot_dynamic_stiffness,
        plots.plot_frf_rms,
        plots.plot_hybrid,
        plots.plot_stabilization_of,
        plots.plot_steps,
        plots.plot_where,
        lambda given: plots.plot_synthesis_correlation(given, IDLE),
        lambda given: plots.plot_synthesis_correlation(FRF, given),
        lambda given: plots.plot_frf_rms(FRF, given or "FRFs"),
        lambda given: plots.plot_location(given, operando.Geometry((1, 2), np.eye(3)[:2])),
    ],
)
@pytest.mark.parametrize("given", [None, "results", [1.0, 2.0]], ids=["none", "text", "list"])
def test_a_figure_of_something_else_is_refused_with_advice(draw: Callable[[Any], Any], given: Any) -> None:
    with pytest.raises(operando.errors.ObjectError) as error:
        draw(given)
    assert any(name in str(error.value) for name in (type(given).__name__, "str", "list of float"))
    assert error.value.hint


@pytest.mark.parametrize("given", [None, "force", [[1.0], [2.0, 3.0]]], ids=["none", "text", "ragged"])
def test_signals_that_are_no_numbers_are_refused_with_advice(given: Any) -> None:
    for call in (
        lambda: contrib.fit_single(given, [0.0, 1.0, 2.0], 100.0, (1.0, 20.0)),
        lambda: contrib.fit_single([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], given, (1.0, 20.0)),
    ):
        with pytest.raises(DataError) as error:
            call()
        assert error.value.hint
