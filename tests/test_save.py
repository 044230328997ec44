"""Every result is saved and loaded as it was: each class that can be shown in short has an example here, made as a user makes it."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import operando
from models import results
from operando import contrib
from operando.data import Channel, Geometry, ModalModel, Provenance, ResidualTerms, TimeRecord
from operando.data.objects import Noun, Short
from operando.diagnosis import Diagnosis, RecordsApplied, RecordsDiagnosis
from operando.diagnosis.records import Detection
from operando.dof import Dof
from operando.errors import FormatError
from operando.io.content import SetInfo
from operando.store import load_results

HZ = np.arange(5.0, 80.0, 0.1)
MADE = results()
SPRING = operando.Effect("ground_spring", "2+Z", {"stiffness": 2e4}, {"stiffness": 100.0}, band_hz=(5.0, 80.0))
ROWS = ({"step": 0, "misfit": np.inf, "heldout_error_db": None}, {"step": 1, "misfit": float("nan"), "added": SPRING.to_dict()})

SETS = (SetInfo(0, 164, "units", "used", "", bytes(range(256)) * 40), SetInfo(1, 9999, "?", "not understood", "", b"-1\n\0"))


def idle() -> ModalModel:
    """Two modes with residual terms that are added and taken away, a mode outside the band, and a covariance."""
    rest = ResidualTerms([2.0, 200.0], [0.01, 0.02], [[0.1, 0.2], [0.2, -0.1]], [1.0, -1.0])
    model = ModalModel([20.0, 45.0], [0.01, 0.02], [[1, 1], [1, -1]], "1+Z, 2+Z", "unit_modal_mass", rest, in_band=[True, False])
    return replace(model, covariance=np.eye(model.n_parameters) * 1e-6)


def plain() -> ModalModel:
    return ModalModel([20.0, 45.0], [0.01, 0.02], [[1, 1], [1, -1]], "1+Z, 2+Z", "unit_modal_mass")


@cache
def record() -> TimeRecord:
    """Noise through two modes, with a tone that only runs while it is on."""
    rng = np.random.default_rng(3)
    lines = np.fft.rfftfreq(40_000, 1 / 200)
    lines[0] = 1e-3
    spectra = np.fft.rfft(rng.standard_normal((2, 40_000)))
    motion = np.fft.irfft(np.einsum("ijk,jk->ik", plain().frf(lines).data, spectra), 40_000)
    channels = [Channel(d, "acceleration", "g", f"acc {d}") for d in ("1+Z", "FRAM:2-Z")]
    finding = operando.Finding("overload", "3 samples", "error", "run1.uff", 2, "1+Z", (0.1, 0.2), (5.0, 6.0), "less", "repeat")
    return TimeRecord(motion, 200.0, channels, 1.5, "run/1.b", (finding,), Provenance((("run1.uff", "ab"),), ("read",), "2026-01-01"))


@cache
def fitted() -> ModalModel:
    return operando.fit_ema(plain().frf(HZ, references="1+Z"), band=(10.0, 70.0))


@cache
def operational() -> ModalModel:
    return operando.fit_oma(record(), band=(10.0, 60.0))


def running() -> operando.Frf:
    return operando.Model(plain(), (SPRING,)).frf(HZ, references="1+Z", variance=False)


@cache
def diagnosed() -> Diagnosis:
    return operando.diagnose(plain(), check=running(), kinds=["ground_spring"])


def loop() -> contrib.LoopFit:
    time = np.arange(2000) / 500
    way = 0.02 * np.sin(np.pi * time / 4) * np.sin(4 * np.pi * time)
    return contrib.fit_loop(way, 800 * np.sign(np.gradient(way)), 500.0)


def single() -> contrib.SingleFit:
    x = np.random.default_rng(0).standard_normal(4096)
    lines = np.fft.rfftfreq(4096, 1 / 200)
    spectrum = np.fft.rfft(x) * (lines < 40)
    x, force = (np.fft.irfft(s, 4096) for s in (spectrum, spectrum * (2e3 + 4j * lines - 2 * (2 * np.pi * lines) ** 2)))
    return contrib.fit_single(force, x, 200.0, (1.0, 30.0), kinds=["cubic_stiffness"])


def periodic() -> contrib.PeriodicResponse:
    rng = np.random.default_rng(0)
    force = np.tile(rng.standard_normal(1024), 8)
    return contrib.best_linear_approximation(force, 3 * force + 0.01 * rng.standard_normal(force.size), 1024.0)


def libraries() -> contrib.LibraryComparison:
    mode = contrib.LibraryMode(20.0, 20.1, 0.01, None, 0.99, True, "0.5 %", "1+Z")
    return contrib.LibraryComparison("idle", "sdypy-EMA 1", "LSCF", (mode,), 0.1, None, "a note")


def drawn() -> Geometry:
    from operando.data import Appearance, CoordinateSystem

    system = CoordinateSystem(3, 1, np.ones(3), np.eye(3), "local", 4)
    shown = Appearance({1: 3, "FRAM:2": 5}, ("edge",), (7,), (9,))
    return Geometry(
        (1, "FRAM:2", 3), np.eye(3), ((1, "FRAM:2"),), ((1, "FRAM:2", 3),), "plate", False, Provenance((), ("read",)),
        {"1+a": (0.6, 0.8, 0.0)}, (system,), {3: 3}, shown,
    )  # fmt: skip


def by_hand(kind: type[Any], **more: Any) -> Any:
    """An object of a class of results that only a long search makes, with values that are hard to write."""
    model = operando.Model(plain(), (SPRING,), drawn(), np.eye(1), 0.02)
    if issubclass(kind, Diagnosis):
        rest = {
            "candidates": ROWS,
            "where": {"by.dof": [], "by_dof": ROWS},
            "picture": {"a/b": np.eye(2), "a_b": np.zeros(2), "pair": (1, 2)},
        }
        return kind("explained", (SPRING,), (SPRING,), None, ROWS, noise_floor_db=np.inf, model=model, idle=plain(), **rest, **more)
    return kind(model, (SPRING,), ROWS, ("words",), {"level": 20.0, "runs": ["a", "b"]}, **more)


EXAMPLES: dict[str, Callable[[], Any]] = {
    "TimeRecord": record,
    "Frf": lambda: operando.estimate_frf(
        TimeRecord(np.random.default_rng(1).standard_normal((2, 4000)), 200.0, [Channel("1+Z", "force", "N"), *record().channels[:1]]),
        block_seconds=2.0,
    ),
    "Geometry": drawn,
    "ModalModel": idle,
    "ModalModel of an EMA": fitted,
    "EmaDetails": lambda: fitted().details,
    "Stabilization": lambda: fitted().details.stabilization,
    "ModalModel of an OMA": operational,
    "OmaDetails": lambda: operational().details,
    "HybridModel": lambda: MADE.hybrid,
    "Frf of a hybrid model": lambda: MADE.hybrid.frf(HZ),
    "Comparison": lambda: operando.compare(plain(), plain().frf(HZ)),
    "ModelComparison": lambda: operando.compare(plain(), plain()),
    "Results": lambda: MADE,
    "CheckRun": lambda: MADE.check[0],
    "Content": lambda: operando.Content("run1.uff", "uff", (record(),), (plain().frf(HZ),), (idle(),), drawn(), SETS),
    "Model": lambda: operando.Model(plain(), (SPRING, operando.Effect("point_mass", "1+Z", {"mass": -0.1}))),
    "Diagnosis": diagnosed,
    "Diagnosis by hand": lambda: by_hand(Diagnosis),
    "Applied": lambda: operando.apply_effects(plain(), SPRING, check=running()),
    "RecordsDiagnosis": lambda: by_hand(RecordsDiagnosis, detection=Detection((1.0, np.nan), location=("3+Z",))),
    "RecordsApplied": lambda: by_hand(RecordsApplied, better=((1, SPRING, 2.5),)),
    "LoopFit": loop,
    "SingleFit": single,
    "PeriodicResponse": periodic,
    "LibraryComparison": libraries,
}


def kinds_of(kind: type[Any] = Short) -> Iterator[type[Any]]:
    for part in kind.__subclasses__():
        yield part
        yield from kinds_of(part)


def test_every_class_of_results_has_an_example():
    for room in pkgutil.iter_modules(operando.__path__):
        importlib.import_module(f"operando.{room.name}")
    own = {kind.__name__ for kind in kinds_of() if kind.__module__.startswith("operando.")} - {Noun.__name__}
    assert own == {name.split(" ")[0] for name in EXAMPLES}


@pytest.mark.parametrize("name", EXAMPLES)
def test_what_is_loaded_is_what_was_saved(name: str, tmp_path: Path):
    made = EXAMPLES[name]()
    assert type(made).__name__ == name.split(" ")[0]
    made.save(tmp_path / "one.h5")
    again = operando.load(tmp_path / "one.h5", type(made))
    assert again == made
    assert repr(again) == repr(made)
    again.save(tmp_path / "two.h5")
    assert operando.load(tmp_path / "two.h5") == made


def test_a_loaded_model_works_as_the_one_saved(tmp_path: Path):
    made = diagnosed()
    made.save(tmp_path / "found.h5")
    again = operando.load(tmp_path / "found.h5", Diagnosis)
    assert made.model is not None
    assert again.model is not None
    np.testing.assert_array_equal(again.model.frf(HZ).data, made.model.frf(HZ).data)
    np.testing.assert_array_equal(again.model.frf(HZ).variance, made.model.frf(HZ).variance)
    assert again.to_dict() == made.to_dict()
    assert Dof(2, "Z") in again.effects[0].location


def test_all_results_compare_by_what_they_hold():
    """The comparison that dataclasses make by themselves fails on arrays."""
    assert not [kind.__name__ for kind in kinds_of() if kind.__module__.startswith("operando.") and "__eq__" in vars(kind)]


def test_results_are_not_loaded_from_another_file(tmp_path: Path):
    """A measurement given for a results folder is no damaged file."""
    (tmp_path / "run.uff").write_text("    -1\n    58\n")
    with pytest.raises(FormatError, match="holds no results of operando") as caught:
        load_results(tmp_path / "run.uff")
    assert "operando run" in caught.value.hint
