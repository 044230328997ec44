"""What the report says of the nearness of operational FRFs: over the lines, at the peaks, against the noise."""

from __future__ import annotations

from operando.compare.verdict import FLOOR_DB
from operando.report.agreement import agreement, close_words, worst_peak

PEAKS = [
    {"frequency_hz": 7.94, "height_error_db": -0.3, "damping_error_percent": 3.1},
    {"frequency_hz": 27.31, "height_error_db": 1.44, "damping_error_percent": -15.2},
    {"frequency_hz": 60.0, "height_error_db": None, "damping_error_percent": None},
]


def model(**changes):
    return {"error_db": 0.35, "noise_floor_db": 0.2, "misfit": 1.1, "model_share": 0.8, "by_mode": PEAKS} | changes


def test_a_small_rms_over_the_lines_says_nothing_of_the_peaks():
    verdict, grade = close_words(model())
    assert verdict.endswith("over the lines than at its peaks: 0.35 dB rms over the lines, peaks up to 1.4 dB")
    assert grade == "fair"
    assert "agree" not in verdict
    assert worst_peak(model())["frequency_hz"] == 27.31
    assert agreement(model(), [])[1] == "Of 2 peaks compared the worst is off by +1.44 dB in height (damping −15.2 %), at 27.31 Hz."


def test_frfs_agree_where_lines_and_peaks_do():
    near = model(by_mode=PEAKS[:1])
    verdict = "The operational FRFs agree with the validation measurement: 0.35 dB rms over the lines, peaks up to 0.3 dB"
    assert close_words(near) == (verdict, "good")
    assert agreement(near, [])[1].startswith("The peak compared is off by −0.30 dB")
    verdict, grade = close_words(model(by_mode=[]))
    assert (verdict, grade) == ("The operational FRFs agree with the validation measurement: 0.35 dB rms over the lines", "good")
    assert len(agreement(model(by_mode=[]), [])) == 1


def test_noise_never_explains_more_than_the_whole_error():
    assert "explain 0.20 dB of it (reduced chi-square 1.10" in agreement(model(), [("idle", 9.0)])[0]
    larger = agreement(model(noise_floor_db=0.67, misfit=0.4), [])[0]
    assert "of it" not in larger
    assert "no larger than what noise of that measurement and the model's own uncertainty make" in larger
    assert "(0.67 dB, the larger part the model's uncertainty), so nothing is left to explain" in larger
    assert "rather too wide than too narrow (reduced chi-square 0.400" in larger
    untold = agreement(model(noise_floor_db=2 * FLOOR_DB), [])[0]
    assert f"may make more than {FLOOR_DB:g} dB, so how much of it is an error of the model cannot be stated" in untold
    assert "nothing is left" not in untold
    mixed = agreement(model(noise_floor_db=0.67, misfit=1.3, model_share=0.2), [])[0]
    assert "the larger part noise" in mixed
    assert "too wide" not in mixed, "a reduced chi-square above 1 says the contrary"
