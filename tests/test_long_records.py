"""Records that stay in their file: the same numbers as in memory, read where they are asked for."""

import pickle

import numpy as np
import pytest
from scipy.io import wavfile

from operando.data import Channel, MappedSamples, TimeRecord, mapped, pieces, row_statistics, stored
from operando.dof import Dof
from operando.errors import FormatError
from operando.frf import estimate_frf
from operando.frf.periodic import period_of
from operando.io import read, write_hdf5, write_uff
from operando.oma import conditioning, fit_oma, harmonics
from operando.quality import check_record

RATE = 1024.0


def record(samples=20_000, dtype=np.float64):
    rng = np.random.default_rng(5)
    data = rng.standard_normal((4, samples)).astype(dtype)
    data[1:] += data[0]
    channels = [Channel(Dof(1, "Z"), "force", "N", "f")] + [Channel(Dof(i, "Z"), "acceleration", "m/s2", f"a{i}") for i in (1, 2, 3)]
    return TimeRecord(data, RATE, tuple(channels))


@pytest.fixture
def everything_stays(monkeypatch):
    monkeypatch.setattr(mapped, "MAPPED_FROM", 0)


def written(tmp_path, kind, dtype):
    path, made = tmp_path / f"r.{kind}", record(dtype=dtype)
    if kind == "uff":
        write_uff(path, made)
    elif kind == "big.uff":
        write_uff(path, made, big_endian=True)
    elif kind == "h5":
        write_hdf5(path, {"record": made})
    elif kind == "wav":
        wavfile.write(path, int(RATE), made.data.T)
    else:
        nptdms = pytest.importorskip("nptdms")
        with nptdms.TdmsWriter(path) as writer:
            for part in (slice(0, 8000), slice(8000, None)):
                rows = zip(made.data, made.channels, strict=True)
                writer.write_segment([nptdms.ChannelObject("g", c.name, r[part], {"wf_increment": 1 / RATE}) for r, c in rows])
    return path


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["uff", "big.uff", "h5", "wav", "tdms"])
def test_stays_in_its_file_with_the_numbers_of_one_in_memory(tmp_path, monkeypatch, kind, dtype):
    with monkeypatch.context() as long:
        long.setattr(mapped, "MAPPED_FROM", 0)  # written as a long record is: HDF5 does not pack it
        path = written(tmp_path, kind, dtype)
    # a file of operando keeps what its channels are
    specs = None if kind == "h5" else {"ch2": {"quantity": "acceleration", "unit": "g", "sensitivity": 0.5}}
    held = read(path, channels=specs)
    monkeypatch.setattr(mapped, "MAPPED_FROM", 0)
    stays = read(path, channels=specs)
    a, b = held.records[0], stays.records[0]
    assert isinstance(a.data, np.ndarray)
    assert isinstance(b.data, MappedSamples)
    assert b.data.dtype == a.data.dtype
    assert a.channels == b.channels
    assert a.sampling_hz == b.sampling_hz
    np.testing.assert_array_equal(a.data, np.asarray(b.data))
    assert [f.message for f in held.findings] == [f.message for f in stays.findings]


def test_parts_are_those_of_an_array(tmp_path, everything_stays):
    path = written(tmp_path, "uff", np.float64)
    held, stays = record(), read(path).records[0]
    x, y = held.data, stays.data
    assert isinstance(y[1:, 10:500], MappedSamples)
    assert isinstance(y[[2, 0]], MappedSamples)
    for key in (
        2, -1, (1, slice(5, 90)), (1, 7), (slice(None), slice(100, 300)), ([2, 0], slice(3, 9)), slice(1, 3),
        np.array([True, False, True, False]),
        (slice(None), slice(0, 900, 7)), (slice(None), 4), (slice(None), slice(-5, None)), (slice(None), slice(7, 3)),
    ):  # fmt: skip
        np.testing.assert_array_equal(x[key], np.asarray(y[key]))
    np.testing.assert_array_equal(x[1:, 50:500][[1, 0], 5:30], np.asarray(y[1:, 50:500][[1, 0], 5:30]))
    np.testing.assert_array_equal(x.mean(axis=1), y.mean(axis=1))
    np.testing.assert_array_equal(np.abs(x) - 1, np.abs(y) - 1)
    np.testing.assert_array_equal(np.concatenate([part for _, part in pieces(y, 777)], axis=1), x)
    np.testing.assert_array_equal(stays.cut(2.0, 5.5).data, held.cut(2.0, 5.5).data)
    np.testing.assert_array_equal(stays.select([3, 1]).data, held.select([3, 1]).data)
    for name in ("strides", "sort", "no_such_thing"):
        with pytest.raises(AttributeError, match="asarray"):
            getattr(y, name)


def test_a_file_that_changes_is_an_error(tmp_path, everything_stays):
    path = written(tmp_path, "uff", np.float64)
    stays = read(path).records[0]
    with open(path, "r+b") as stream:
        stream.truncate(path.stat().st_size - 1)
    with pytest.raises(FormatError, match="changed"):
        stays.data[0]


def test_few_files_are_open_at_a_time(tmp_path, everything_stays, monkeypatch):
    monkeypatch.setattr(stored, "MOST_OPEN", 2)
    for i in range(5):
        write_uff(tmp_path / f"{i}.uff", record(2000))
    stays = [read(tmp_path / f"{i}.uff").records[0] for i in range(5)]
    for one in (*stays, *stays[::-1]):
        np.testing.assert_array_equal(one.data, record(2000).data)
        assert sum(ref()._stream is not None for ref in stored.StoredFile._recent if ref() is not None) <= 3
    again = pickle.loads(pickle.dumps(stays[0]))
    np.testing.assert_array_equal(again.data[1], record(2000).data[1])
    (tmp_path / "0.uff").unlink()
    for one in stays[1:]:
        _ = one.data[0]
    with pytest.raises(FormatError, match="any more"):
        pickle.loads(pickle.dumps(stays[0]))


def test_a_large_read_only_map_gives_its_pages_back(tmp_path, everything_stays):
    np.save(tmp_path / "x.npy", record().data)
    labels = record().channels
    stays = TimeRecord(np.load(tmp_path / "x.npy", mmap_mode="r"), RATE, labels)
    assert isinstance(stays.data, MappedSamples)
    np.testing.assert_array_equal(stays.data, record().data)
    own = TimeRecord(np.load(tmp_path / "x.npy", mmap_mode="c"), RATE, labels)
    assert isinstance(own.data, np.ndarray)  # pages that were written to would be lost


def test_frfs_are_the_same(tmp_path, everything_stays):
    path = written(tmp_path, "uff", np.float64)
    a, b = estimate_frf(record()), estimate_frf(read(path).records[0])
    np.testing.assert_array_equal(a.data, b.data)
    np.testing.assert_array_equal(a.variance, b.variance)


def test_statistics_are_those_of_numpy():
    data = np.random.default_rng(0).standard_normal((5, 200_001)) * 1e-3 + 1e3
    data[1, 70_000:90_000] = np.nan
    data[2] = 7.3
    data[3] = np.nan
    labels = tuple(Channel(Dof(i, "Z"), "acceleration", "m/s2") for i in range(5))
    found = TimeRecord(data, RATE, labels).statistics
    assert found.finite.tolist() == [True, False, True, False, True]
    assert found.flat.tolist() == [False, False, True, True, False]
    assert found.std[2] == 0 == found.std[3]
    for i in (0, 1, 4):
        np.testing.assert_allclose([found.mean[i], found.std[i]], [np.nanmean(data[i]), np.nanstd(data[i])], rtol=1e-11)
        assert (found.low[i], found.high[i]) == (np.nanmin(data[i]), np.nanmax(data[i]))


def test_checks_are_the_same(tmp_path, everything_stays):
    held = record()
    held.data.flags.writeable = True
    held.data[2, 500:600] = 0.25
    held.data[3] = np.clip(held.data[3], -1.2, 1.2)
    write_uff(tmp_path / "r.uff", held)
    stays = read(tmp_path / "r.uff").records[0]
    found = [(f.kind, f.time_s, f.message) for f in check_record(held).findings]
    assert {kind for kind, _, _ in found} >= {"dropout", "overload"}
    assert [(f.kind, f.time_s, f.message) for f in check_record(stays).findings] == found


def resonant(samples, seed=0):
    """Two modes at three sensors, with a rotor order."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    data = 0.02 * rng.standard_normal((3, samples))
    for hz, shape in ((60.0, [1, 0.7, -0.4]), (95.0, [0.5, -1, 0.8])):
        pole = np.exp((-0.01 + 1j) * 2 * np.pi * hz / RATE)
        data += np.outer(shape, lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(samples)))
    data += np.outer([3.0, 2.0, 1.0], np.sin(2 * np.pi * 77.3 * np.arange(samples) / RATE + 0.4))
    labels = tuple(Channel(Dof(i, "Z"), "acceleration", "m/s2") for i in (1, 2, 3))
    return TimeRecord(data, RATE, labels)


def test_modes_are_the_same(tmp_path, monkeypatch):
    held = resonant(60_000)
    write_uff(tmp_path / "r.uff", held)
    a = fit_oma(held, band=(40.0, 120.0))
    monkeypatch.setattr(mapped, "MAPPED_FROM", 0)  # also what is resampled and cleaned of sinusoids then stays in files
    b = fit_oma(read(tmp_path / "r.uff").records[0], band=(40.0, 120.0))
    np.testing.assert_allclose(a.details.harmonics_hz, [77.3], atol=1e-3)
    np.testing.assert_allclose(b.details.harmonics_hz, a.details.harmonics_hz, rtol=1e-9)
    np.testing.assert_allclose(b.frequencies_hz, a.frequencies_hz, rtol=1e-8)
    np.testing.assert_allclose(b.damping_ratios, a.damping_ratios, rtol=1e-6)
    np.testing.assert_allclose(np.diag(b.covariance), np.diag(a.covariance), rtol=1e-3)


def test_a_record_taken_in_stretches_has_the_same_modes(tmp_path, everything_stays, monkeypatch):
    held = resonant(300_000)
    write_uff(tmp_path / "r.uff", held)
    whole = fit_oma(held, band=(40.0, 120.0))
    monkeypatch.setattr(conditioning, "STRETCH", 1 << 15)
    monkeypatch.setattr(conditioning, "MARGIN", 1 << 12)
    monkeypatch.setattr(harmonics, "LONGEST", 1 << 14)
    parts = fit_oma(read(tmp_path / "r.uff").records[0], band=(40.0, 120.0))
    np.testing.assert_allclose(parts.details.harmonics_hz, [77.3], atol=1e-3)
    std = np.sqrt(np.diag(whole.covariance))[: 2 * whole.frequencies_hz.size]
    change = np.concatenate([parts.frequencies_hz - whole.frequencies_hz, parts.damping_ratios - whole.damping_ratios])
    assert np.all(np.abs(change) < 0.1 * std)


def test_stretches_resample_as_the_whole(monkeypatch):
    data = np.random.default_rng(1).standard_normal((2, 200_000)) + 3
    monkeypatch.setattr(conditioning, "STRETCH", 1 << 15)
    monkeypatch.setattr(conditioning, "MARGIN", 1 << 12)
    parts, rate = conditioning.resample(data, 1000.0, 105.0, 250.0)
    assert rate == 250.0
    monkeypatch.setattr(conditioning, "STRETCH", 1 << 20)
    whole, same = conditioning.resample(data, 1000.0, 105.0, 250.0)
    assert same == rate
    inside = slice(2000, -2000)
    periods = conditioning.MARGIN / 1000.0 * 20.0  # of the flank's width, 105 to 125 Hz, in the margin
    assert np.abs(parts - whole)[:, inside].max() < periods**-3 * whole.std()


def test_the_envelope_of_bins_is_that_of_the_whole_spectrum(monkeypatch):
    data = resonant(400_000).data
    args = (data, RATE, 77.3, 32 * RATE / data.shape[1])
    whole = harmonics.envelope(*args)
    monkeypatch.setattr(harmonics, "LONGEST", 1000)
    parts = harmonics.envelope(*args)
    assert parts.shape == whole.shape
    # what lies a bin rate away comes through by 16 lines over the number of bins
    assert np.abs(parts - whole).max() < 16 / harmonics.ENVELOPE_BINS * np.abs(whole).max()


def test_the_period_of_a_long_force_is_found_in_its_middle(monkeypatch):
    from operando.frf import periodic

    one = np.random.default_rng(2).standard_normal(700)
    force = np.concatenate([np.zeros(5000), np.tile(one, 40), np.zeros(900)])
    assert period_of(force) == 700
    monkeypatch.setattr(periodic, "LONGEST", 4000)
    assert period_of(force) == 700


@pytest.mark.parametrize("samples", [6000, 5625, 4096])
def test_lines_of_a_long_row_are_those_of_its_transform(monkeypatch, samples):
    from operando.frf import rational

    x = np.random.default_rng(3).standard_normal(samples)
    lines = np.array([1, 2, 7, 400, 801, samples // 2 - 1, samples // 2])
    whole = np.fft.rfft(x)[lines]
    monkeypatch.setattr(rational, "LONGEST", 700)
    found = rational.spectrum_lines((x - 0.5)[np.newaxis], [0], lines, samples)[0]
    np.testing.assert_allclose(found, whole, rtol=1e-11)


def test_statistics_in_single_precision_hold_for_numbers_of_any_size_and_a_large_offset():
    small = np.random.default_rng(0).standard_normal(50_000)
    for size, offset in ((1.0, 0.0), (1.0, 1e4), (1e30, 0.0)):
        samples = (offset + size * small).astype(np.float32)
        found = row_statistics(samples[None])
        assert found.finite.all()
        np.testing.assert_allclose(found.std, samples.astype(float).std(), rtol=1e-5)
        np.testing.assert_allclose(found.mean, samples.astype(float).mean(), atol=1e-5 * size)
