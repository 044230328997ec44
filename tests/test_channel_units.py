"""Units of channels: one conversion to SI, whatever way a record takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import operando
from operando.data import Channel, TimeRecord, mapped
from operando.errors import ConfigError, DataError, UnitError
from operando.io import from_sep005, make_record
from operando.units import G_STANDARD

N = 2048
RNG = np.random.default_rng(0)
FORCE = RNG.standard_normal(N)
MOTION = 0.3 * FORCE + 0.1 * RNG.standard_normal(N)


def record(
    unit: str = "m/s2", per_si: float = 1.0, force_unit: str = "N", force_per_si: float = 1.0, quantity: str = "acceleration"
) -> TimeRecord:
    """A force and a response, given in some units."""
    channels = [Channel("1+X", "force", force_unit), Channel("2+X", quantity, unit)]
    return TimeRecord(np.stack([FORCE * force_per_si, MOTION * per_si]), 512.0, tuple(channels))


@pytest.mark.parametrize(
    ("unit", "per_si", "force_unit", "force_per_si"),
    [
        ("g", 1 / G_STANDARD, "N", 1.0), ("mm/s2", 1e3, "N", 1.0), ("mm/s^2", 1e3, "N", 1.0), ("m/s²", 1.0, "N", 1.0),
        ("m/s2", 1.0, "kN", 1e-3), ("m/s2", 1.0, "lbf", 1 / 4.4482216152605),
    ],
)  # fmt: skip
def test_samples_given_in_any_unit_become_si(unit: str, per_si: float, force_unit: str, force_per_si: float) -> None:
    converted, si = record(unit, per_si, force_unit, force_per_si), record()
    np.testing.assert_allclose(converted.data, si.data, rtol=1e-12)
    assert [c.unit for c in converted.channels] == ["N", "m/s2"]
    assert converted.channels[1].source_unit == ("" if unit == "m/s2" else unit)
    frf = operando.estimate_frf(converted)
    assert frf.si
    np.testing.assert_allclose(frf.data, operando.estimate_frf(si).data, rtol=1e-9)


def test_samples_are_converted_once() -> None:
    converted = record("g")
    for same in (
        converted.select([1]),
        converted["2+X"],
        converted.cut(0.0, 2.0).select([1]),
        TimeRecord(converted.data, 512.0, converted.channels).select([1]),
    ):
        np.testing.assert_allclose(same.data[0, :100], MOTION[:100] * G_STANDARD)


@pytest.mark.filterwarnings("ignore:lost in .*source units")
@pytest.mark.parametrize("suffix", ["h5", "uff", "mat", "csv"])
def test_files_and_memory_hold_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    given = record("g", 1 / G_STANDARD, "kN", 1e-3)
    given.save(tmp_path / f"record.{suffix}")
    found = operando.read(tmp_path / f"record.{suffix}").records[0]
    np.testing.assert_allclose(found.data, np.stack([FORCE, MOTION]), rtol=1e-6)
    assert [c.unit for c in found.channels] == ["N", "m/s2"]


def test_sep005_and_arrays_hold_the_same_numbers() -> None:
    made = make_record(np.stack([FORCE, MOTION]), 512.0, ["force 1+X", "acc 2+X"], ["kN", "g"])
    np.testing.assert_allclose(made.data, record("g", force_unit="kN").data)
    parts = [
        {"data": FORCE, "fs": 512.0, "name": "force 1+X", "unit_str": "kN"},
        {"data": MOTION, "fs": 512.0, "name": "2+X", "unit_str": "g"},
    ]
    np.testing.assert_allclose(from_sep005(parts).data, made.data)


def test_samples_that_stay_in_their_file_are_converted_as_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapped, "MAPPED_FROM", 1000)
    np.save(tmp_path / "samples.npy", np.stack([FORCE, MOTION]))
    samples = np.load(tmp_path / "samples.npy", mmap_mode="r")
    found = TimeRecord(samples, 512.0, (Channel("1+X", "force", "N"), Channel("2+X", "acceleration", "g")))
    assert isinstance(found.data, mapped.MappedSamples)
    np.testing.assert_allclose(np.asarray(found.data), np.stack([FORCE, MOTION * G_STANDARD]))


def _stored_unit(path: Path, unit: str) -> None:
    """Write a file as older versions did: with samples in the unit of the channel."""
    plain = record()
    object.__setattr__(plain.channels[1], "unit", unit)
    plain.save(path)
    with h5py.File(path) as file:
        assert unit in str(next(iter(file.values()))["__tree__"][()])


def test_an_older_file_with_samples_in_g_is_converted_or_refused(tmp_path: Path) -> None:
    _stored_unit(tmp_path / "old.h5", "g")
    found = operando.read(tmp_path / "old.h5").records[0]
    np.testing.assert_allclose(found.data[1], MOTION * G_STANDARD)
    assert (found.channels[1].unit, found.channels[1].source_unit) == ("m/s2", "g")
    _stored_unit(tmp_path / "worse.h5", "bananas")
    with pytest.raises(operando.errors.FormatError, match="unknown unit 'bananas'"):
        operando.load(tmp_path / "worse.h5")


@pytest.mark.filterwarnings("ignore:lost in .*source units")
def test_run_on_a_record_in_g_gives_the_same_from_every_format(tmp_path: Path) -> None:
    heights = []
    for suffix in ("h5", "uff"):
        folder = tmp_path / suffix
        folder.mkdir()
        record("g", 1 / G_STANDARD).save(folder / f"i.{suffix}")
        (folder / "test.toml").write_text(f'name = "x"\n[idle]\nrecords = ["i.{suffix}"]\n', encoding="utf-8")
        operando.run(folder / "test.toml", folder / "out", until="frf")
        heights.append(operando.read(folder / "out" / "idle_frf.uff").frfs[0].data)
    np.testing.assert_allclose(heights[0], heights[1], rtol=1e-5)
    np.testing.assert_allclose(np.median(np.abs(heights[0])), 0.3, rtol=0.1)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("force", "m/s2"), "'m/s2' is a unit of acceleration, not of force"),
        (("acceleration", "mV"), "'mV' is a unit of voltage, not of acceleration"),
        (("acceleration", "bananas"), r"1\+X: unknown unit 'bananas' for acceleration \(known: "),
        (("accel", "m/s2"), "unknown quantity 'accel' .did you mean 'acceleration'"),
    ],
)  # fmt: skip
def test_a_unit_that_cannot_be_is_refused_with_what_can(given: Any, words: str) -> None:
    with pytest.raises(UnitError, match=words):
        Channel("1+X", *given)


def test_a_unit_tells_the_quantity_and_none_is_no_unit() -> None:
    assert Channel("1+X", unit="g").quantity == "acceleration"
    assert Channel("1+X", "acceleration").unit == ""
    for quantity, unit in (("stress", "MPa"), ("reaction_force", "kN"), ("heat_flux", "W/m2"), ("rpm", "rpm"), ("order", "")):
        assert Channel(None, quantity, unit).quantity == quantity
    without = TimeRecord(np.stack([FORCE, MOTION]), 512.0, (Channel("1+X", "force", "N"), Channel("2+X", "acceleration")))
    assert not operando.estimate_frf(without).si


def test_labels_instead_of_channels_are_refused() -> None:
    with pytest.raises(DataError, match=r"write operando\.Channel"):
        TimeRecord(np.zeros((3, 5)), 100.0, "1+X")  # type: ignore[arg-type]


def saved(folder: Path, kind: str, name: str = "run") -> Path:
    """A file of a format with a record and, in the same folder, one with an FRF; both state units."""
    record().save(folder / f"{name}.{kind}")
    operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z").save(folder / f"frf.{kind}")
    return folder / f"{name}.{kind}"


@pytest.mark.parametrize("kind", ["uff", "csv", "h5", "mat"])
def test_entries_for_no_channel_and_units_of_another_quantity_are_refused(tmp_path: Path, kind: str) -> None:
    run = saved(tmp_path, kind)
    for path in (run, tmp_path / f"frf.{kind}", tmp_path / f"*.{kind}"):
        with pytest.raises(ConfigError, match="'nonsense' names no channel"):
            operando.read(path, channels={"nonsense": {"unit": "g"}})
        with pytest.raises(UnitError, match="'N' is a unit of force, not of acceleration"):
            operando.read(path, units={"acceleration": "N"})
        with pytest.raises(ConfigError, match="acceleration is 3, expected a unit"):
            operando.read(path, units={"acceleration": 3})
        with pytest.raises(ConfigError, match="2\\+X is 3, expected a dict"):
            operando.read(path, channels={"2+X": 3})  # type: ignore[dict-item]
    if kind != "h5":
        with pytest.raises(ConfigError, match="did you mean '2\\+X'"):
            operando.read(run, channels={"2+Y": {"unit": "g"}})
        with pytest.raises(ConfigError, match="sensitivity 'a' is no number"):
            operando.read(run, channels={"2+X": {"sensitivity": "a"}})
        both = operando.read(tmp_path / f"*.{kind}", channels={"7+Z": {"dof": "8+Z"}})  # of one file of the two
        assert [str(d) for d in both.frfs[0].responses] == ["8+Z"]


@pytest.mark.parametrize("kind", ["uff", "csv", "h5", "mat"])
def test_a_unit_that_the_file_takes_the_place_of_is_named(tmp_path: Path, kind: str) -> None:
    run = saved(tmp_path, kind)
    for path, of in ((run, "2+X"), (tmp_path / f"frf.{kind}", "")):
        found = [f for f in operando.read(path, units={"acceleration": "g", "force": "N", "length": "m"}).findings if "unit" in f.kind]
        assert [f.kind for f in found] == ["unused_unit"]
        assert f'acceleration = "g" is not used for {of}' in found[0].message
        assert "states m/s2" in found[0].message
        assert not operando.read(path, units={"acceleration": "m/s^2"}).findings


def test_a_length_that_a_unit_set_takes_the_place_of_is_named(tmp_path: Path) -> None:
    operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]]).save(tmp_path / "a.uff")
    (told,) = operando.read(tmp_path / "a.uff", units={"length": "mm"}).findings
    assert (told.kind, 'length = "mm" is not used for the geometry' in told.message) == ("unused_unit", True)


def test_entries_for_no_channel_of_several_files_are_refused(tmp_path: Path) -> None:
    run = saved(tmp_path, "csv")
    with pytest.raises(ConfigError, match="'nonsense' names no channel"):
        operando.io.inspect_files([run], channels={"nonsense": {"unit": "g"}})
    assert operando.io.inspect_files([run, tmp_path / "frf.csv"], channels={"7+Z": {"unit": "g"}})["files"][0]["error"] is None
    with pytest.raises(ConfigError, match="did you mean 'accel'"):
        from_sep005({"data": np.arange(9.0), "name": "accel", "unit_str": "g", "fs": 8.0}, channels={"acel": {"unit": "g"}})
