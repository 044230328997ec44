"""Typed errors. Each says what was found, where, what was expected, and what to do."""

from __future__ import annotations


class OperandoError(Exception):
    """Base of all errors that operando raises on purpose.

    Parameters
    ----------
    message : str
        What was found and what was expected.
    where : str, optional
        File, set, channel or line, in words.
    hint : str, optional
        What the user can do about it.
    """

    def __init__(self, message: str, *, where: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.where = where
        self.hint = hint or None

    def __str__(self) -> str:
        text = f"{self.where}: {self.message}" if self.where else self.message
        return f"{text} ({self.hint})" if self.hint else text

    def to_dict(self) -> dict[str, str | None]:
        """JSON document ``operando/error/1``."""
        return {"schema": "operando/error/1", "error": self.message, "where": self.where, "hint": self.hint}


class FormatError(OperandoError):
    """A file cannot be understood."""


class UnitError(OperandoError):
    """A unit is unknown, missing, or of another quantity."""


class DofError(OperandoError, ValueError):
    """A DOF label cannot be parsed, is not found, or is ambiguous."""


class ObjectError(OperandoError, TypeError):
    """A function got an object of another kind than it works on."""


class DataError(OperandoError, ValueError):
    """Data break an invariant (shape, sampling, finite values, labels)."""


class ConfigError(OperandoError, ValueError):
    """A test file or an option is wrong."""


class UnknownKindError(ConfigError):
    """A kind of effect is not in the catalogue."""


class IdentificationError(OperandoError):
    """An estimation cannot be made from these data."""


class MissingError(OperandoError):
    """A needed file, stage, or optional package is missing."""


class WriteError(OperandoError):
    """A file cannot be written: no space, no permission, no such folder."""


class BusyError(OperandoError):
    """Another process is at work in the same results folder."""
