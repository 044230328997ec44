"""Nouns in the forms of other libraries; the work is done in the rooms of those forms, loaded when it is asked for."""

from __future__ import annotations

import importlib
from typing import Any


class ForOthers:
    """Adds ``to_pyuff`` to a noun."""

    def to_pyuff(self) -> list[dict[str, Any]]:
        """Sets of UFF as the dictionaries of pyuff (:func:`operando.io.uff.dictionaries.dictionaries`)."""
        # By name: data is above io in the order of rooms, and imports nothing of it.
        sets: list[dict[str, Any]] = importlib.import_module("operando.io.uff.dictionaries").dictionaries(self)
        return sets
