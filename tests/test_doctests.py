"""The examples in the docstrings of what users call run and show what they say."""

from __future__ import annotations

import doctest
import importlib
import re
import warnings
from pathlib import Path

import pytest

import operando

SOURCE = Path(operando.__file__).parent
MODULES = sorted(
    "operando." + ".".join(path.relative_to(SOURCE).with_suffix("").parts)
    for path in SOURCE.rglob("*.py")
    if re.search(r"^ *>>> ", path.read_text(encoding="utf-8"), re.MULTILINE)
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    import matplotlib.pyplot as plt

    if name == "operando.io.frames":
        pytest.importorskip("pandas")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "More than 20 figures")
        found = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    plt.close("all")
    assert found.attempted > 0, "a module of this list has an example"
    assert found.failed == 0
