"""The examples in the docstrings of what users call run and show what they say."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import warnings
from pathlib import Path

import numpy as np
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


PUBLIC = [name for name in operando.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", PUBLIC)
def test_examples_of_public_names_run_when_pasted(name):
    import matplotlib.pyplot as plt

    thing = getattr(operando, name)
    if inspect.ismodule(thing):  # a package that can be called as the function of its name
        thing = getattr(importlib.import_module(operando._WHERE[name]), name)
    said: list[str] = []
    for test in doctest.DocTestFinder().find(thing, name, globs={"operando": operando, "np": np}):
        doctest.DocTestRunner(verbose=False, optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    plt.close("all")
    assert not said, "".join(said)
