"""What is of another kind than declared is refused with words: fields of all public classes, arguments of all public functions."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import operando
from models import results
from operando.data import Channel, Frf, Geometry, ModalModel, TimeRecord, check_fields, listed, number_of
from operando.data.declared import explain_arguments, is_of
from operando.errors import DataError, ObjectError, OperandoError

IDLE = ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
FRF = IDLE.frf(np.arange(5, 80, 0.25), references="1+Z")
MOTION = Channel("1+Z", "acceleration", "m/s2")
RECORD = TimeRecord(np.ones((1, 100)), 256.0, [MOTION])
MASS = operando.Effect("point_mass", "1+Z", {"mass": 0.1})
MADE = results()

# Fields of classes.

OBJECTS = [
    MOTION, RECORD, IDLE, FRF, MASS, MADE, MADE.hybrid, operando.Dof(1, "Z"), operando.CheckRun("run 1", "", FRF),
    Geometry((1, 2), np.eye(3)[:2], ((1, 2),)), operando.Finding("overload", "3 samples"), operando.FrequencyAxis([1.0, 2.0]),
    operando.ResidualTerms([2.0], [0.01], [[0.1]]), operando.ModalCoupling(np.zeros((2, 2)), np.zeros((2, 2))),
    operando.Parameter("gap", "m", 1e-6, 1.0), operando.Model(IDLE, (MASS,)), operando.compare(IDLE, FRF), operando.compare(IDLE, IDLE),
    operando.Diagnosis("no_misfit", (), (), None, (), (), {}, None), operando.Content("run1.uff", "uff"),
]  # fmt: skip


def test_every_public_class_of_values_is_among_them():
    kinds = {kind for name in operando.__all__ if is_dataclass(kind := getattr(operando, name))}
    made_by_fits = {operando.Stabilization}
    assert {type(made) for made in OBJECTS} == kinds - made_by_fits


@pytest.mark.parametrize("made", OBJECTS, ids=lambda made: type(made).__name__)
def test_a_field_of_another_kind_is_refused(made: Any):
    """Either the value is understood, or the error says what was expected; nothing is kept as it is to fail later."""
    for field in fields(made):
        if not field.init or field.type == "Any":
            continue
        for given in (object(), lambda: None, *([[object()]] if "Any" not in field.type else [])):
            with pytest.raises(OperandoError) as refused:
                replace(made, **{field.name: given})
            assert str(refused.value)
        for given in (None, "x", 5, np.nan, -1.0, [1.0], np.zeros(3)):
            try:
                kept = getattr(replace(made, **{field.name: given}), field.name)
            except OperandoError:
                continue
            check_fields(replace(made, **{field.name: kept}))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: replace(IDLE, band_hz="x"), "band 'x': no numbers"),
        (lambda: replace(IDLE, band_hz=(60, 10)), "is reversed"),
        (lambda: replace(IDLE, misfit=-1.0), "the reduced chi-square -1 is below 0"),
        (lambda: replace(IDLE, damping_ratios=[0.01, np.nan]), "damping ratios must be finite"),
        (lambda: replace(IDLE, shapes=np.full((2, 2), np.nan)), "shapes must be finite"),
        (lambda: replace(IDLE, residuals="none"), "'residuals' of ModalModel is str 'none', expected ResidualTerms | None"),
        (lambda: Geometry((1, 2), np.eye(3)[:2], lines="x"), "'lines' of Geometry is str 'x', expected tuple[tuple[Node, ...], ...]"),
        (lambda: Geometry((1, 2), np.eye(3)[:2], lines=(1, 2)), "'lines' of Geometry is tuple of int"),
        (lambda: Geometry((1.5, 2), np.eye(3)[:2]), "1.5 is no node label"),
        (lambda: operando.Dof(None), "None is no node label"),
        (lambda: operando.Dof(1, 5), "unknown axis 5"),
        (lambda: replace(FRF, averages=-3), "averages -3 is below 0"),
        (lambda: replace(FRF, exponential_window_rate=np.nan), "is not one finite number"),
        (lambda: operando.CheckRun("run 1", "", "check.uff"), "'frf' of CheckRun is str 'check.uff', expected Frf"),
        (lambda: operando.CheckRun("run 1", "", FRF, -20.0), "force_n -20.0 is below 0"),
        (lambda: operando.Effect("point_mass", "1+Z", {"mass": "big"}), "mass of point_mass 'big': no numbers"),
        (lambda: operando.Effect("point_mass", "1+Z", {"mass": 0.1}, {"mass": -0.1}), "the standard deviation of mass"),
        (lambda: operando.Effect("point_mass", position=(1.0, 2.0), direction="+Z"), "not three numbers"),
        (lambda: operando.Parameter("gap", "m", np.nan, 1.0), "is NaN"),
        (lambda: operando.Model(IDLE, discrepancy="some"), "discrepancy 'some': no numbers"),
    ],
)
def test_what_no_value_can_be_is_refused(call: Callable[[], Any], said: str):
    with pytest.raises(OperandoError) as refused:
        call()
    assert said in str(refused.value)


def test_what_is_written_otherwise_is_taken():
    shown = Geometry(np.array([1, 2]), np.eye(3)[:2], lines=[[1, 2]], faces=np.array([[1, 2, 1]]))
    assert (shown.nodes, shown.lines, shown.faces) == ((1, 2), ((1, 2),), ((1, 2, 1),))
    assert replace(IDLE, band_hz=[5, 70]).band_hz == (5.0, 70.0)
    assert replace(IDLE, si=np.True_).si
    assert listed(iter([1, 2])) == (1, 2)
    assert number_of(0, "a number", "", 0.0) == 0.0
    with pytest.raises(DataError, match="below 0"):
        number_of(-1e-9, "a number", "", 0.0)


# Arguments of functions.


def public_functions() -> dict[str, Callable[..., Any]]:
    """Functions that the packages and operando itself name as public."""
    found: dict[str, Callable[..., Any]] = {}
    for room in pkgutil.iter_modules(operando.__path__):
        if room.name == "__main__":  # the command line, which is not imported by others
            continue
        module = importlib.import_module(f"operando.{room.name}")
        found |= {f"{room.name}.{name}": getattr(module, name) for name in getattr(module, "__all__", ())}
    found |= {name: getattr(operando, name) for name in operando.__all__}
    own = {"data.explain_arguments"}  # takes the name of a package of operando
    return {name: thing for name, thing in found.items() if inspect.isfunction(thing) and name not in own}


SAMPLES = (
    *OBJECTS,
    [RECORD],
    [FRF],
    [MASS],
    [operando.CheckRun("run 1", "", FRF)],
    (10.0, 60.0),
    20.0,
    0,
    np.arange(5.0, 70.0),
    MADE.comparison,
    "a",
)


@pytest.mark.parametrize("name", sorted(public_functions()))
def test_no_public_function_ends_in_a_bare_error(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With one required argument of another kind, or all of them: what is refused is refused with words and advice."""
    monkeypatch.chdir(tmp_path)
    function = public_functions()[name]
    kinds = [inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY]
    needed = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty and p.kind in kinds]
    hints = importlib.import_module("operando.data.declared")._declared(function)
    good = {p.name: next((made for made in SAMPLES if is_of(made, hints.get(p.name))), None) for p in needed}
    for given in (None, "no such thing", object(), [object()], FRF):
        for changed in ([p.name for p in needed], *([p.name] for p in needed)):
            options = good | dict.fromkeys(changed, given)
            ordered = [options.pop(p.name) for p in needed if p.kind is not inspect.Parameter.KEYWORD_ONLY]
            with suppress(OperandoError, FileNotFoundError):  # which names the file
                function(*ordered, **options)
    if "matplotlib" in sys.modules:
        import matplotlib.pyplot as plt

        plt.close("all")


def test_the_function_that_was_called_is_named_and_the_error_behind_it_kept():
    from operando import ema, quality

    with pytest.raises(ObjectError) as refused:  # fails in another public function, which it calls
        quality.check_record("run1.uff")
    assert str(refused.value) == "record of check_record is str 'run1.uff', expected TimeRecord (read(file).records are time records)"
    assert isinstance(refused.value.__cause__, AttributeError)
    with pytest.raises(ObjectError, match="details of an EMA"):
        ema.poles_by_hand(IDLE)
    with pytest.raises(TypeError, match="missing 1 required"):
        quality.check_record()


def test_an_error_with_right_arguments_stays_what_it_is(monkeypatch: pytest.MonkeyPatch):
    def fails(frf: Frf) -> None:
        raise KeyError("a fault of our own")

    room = type(sys)("operando_room_for_test")
    room.__all__, room.fails = ["fails"], fails
    monkeypatch.setitem(sys.modules, room.__name__, room)
    explain_arguments(room.__name__)
    with pytest.raises(KeyError, match="a fault of our own"):
        room.fails(FRF)
    with pytest.raises(ObjectError, match="frf of fails is int 3, expected Frf"):
        room.fails(3)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: operando.compare.maps.clear_lines(FRF, [1.0]), r"band of clear_lines is list of float, expected tuple\[float, float\]"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(3, bool), axis="x"), "axis of rms_over is str 'x', expected int"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(3, bool), axis=[0.5]), "axis of rms_over is list of float"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(3, bool), axis=1), "axis 1 of values with 1 axes"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(3, bool), axis=[0, 0]), "repeated axis"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(2, bool)), r"a mask of shape \(2,\)"),
        (lambda: operando.compare.maps.rms_over(np.ones(3), np.ones(3)), r"mask of rms_over is ndarray, expected NDArray\[np.bool_\]"),
        (lambda: operando.compare.maps.rms_over(np.ones(3) + 1j, np.ones(3, bool)), "values of rms_over is ndarray"),
        (lambda: FRF.decimate(None), "step of decimate is NoneType, expected int"),
        (lambda: FRF.beside(3), "others of beside is int 3, expected Frf"),
        (lambda: FRF.axis.band("a", 3), "low of band is str 'a', expected float"),
        (lambda: operando.FrequencyAxis.even("a", 1, 5), "start of even is str 'a', expected float"),
        (lambda: FRF.lines([9999]), r"\[9999\] names no lines of 300"),
        (lambda: FRF.lines(np.ones(7, bool)), "names no lines of 300"),
        (lambda: operando.mac([1.0, np.nan], [1.0, 2.0]), "not finite have no MAC"),
        (lambda: operando.plots.plot_psd(RECORD, channels=object()), "is no channel"),
        (lambda: RECORD[0], "0 is no channel"),
    ],
)
def test_optional_arguments_of_another_kind_are_named(call: Callable[[], Any], said: str):
    with pytest.raises(OperandoError, match=said):
        call()


def test_shapes_of_whole_numbers_have_a_mac():
    np.testing.assert_allclose(operando.mac([1, 1], [1, 2]), 0.9)


def test_what_was_taken_away_is_said():
    assert operando.parse_effect("point_mass@1+Z=mass:-0.1").short == "point_mass taken away at 1+Z, 100 g"


def test_axes_are_named_as_numpy_names_them():
    values = np.arange(24.0).reshape(2, 3, 4)
    over = [operando.compare.maps.rms_over(values, values > 2, axis=axis) for axis in ((0, 1), [0, 1], np.array([0, 1]), (-3, -2))]
    np.testing.assert_allclose(over, np.sqrt(np.sum((values * (values > 2)) ** 2, (0, 1)) / np.sum(values > 2, (0, 1))) * np.ones((4, 1)))


@pytest.mark.parametrize(
    ("dtype", "declared", "fits"),
    [("i4", np.float64, True), ("f4", np.complex128, True), ("?", np.bool_, True), ("f8", np.bool_, False), ("c16", np.float64, False)],
)
def test_numbers_of_an_array_are_of_the_declared_kind(dtype: str, declared: type, fits: bool):
    assert is_of(np.ones(2, dtype), np.typing.NDArray[declared]) is fits
    assert is_of(np.ones(2, dtype), np.typing.NDArray[Any])
