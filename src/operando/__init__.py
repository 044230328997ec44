"""operando: operational FRFs of running machines from raw vibration measurements.

Public names are loaded on first use, so that ``import operando`` stays light. It loads nothing itself: the command line minds Ctrl-C only
when it is through with it.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import ModuleType
    from typing import Any

    from operando import plots as plots
    from operando.compare import Comparison as Comparison
    from operando.compare import ModelComparison as ModelComparison
    from operando.compare import compare as compare
    from operando.config import load_test as load_test
    from operando.data import Channel as Channel
    from operando.data import Finding as Finding
    from operando.data import FrequencyAxis as FrequencyAxis
    from operando.data import Frf as Frf
    from operando.data import Geometry as Geometry
    from operando.data import ModalCoupling as ModalCoupling
    from operando.data import ModalModel as ModalModel
    from operando.data import ResidualTerms as ResidualTerms
    from operando.data import TimeRecord as TimeRecord
    from operando.diagnosis import Diagnosis as Diagnosis
    from operando.diagnosis import apply_effects as apply_effects
    from operando.diagnosis import diagnose as diagnose
    from operando.dof import Dof as Dof
    from operando.ema import fit_ema as fit_ema
    from operando.errors import OperandoError as OperandoError
    from operando.frf import estimate_frf as estimate_frf
    from operando.indicators import mac as mac
    from operando.io import Content as Content
    from operando.io import read as read
    from operando.io import write_uff as write_uff
    from operando.oma import fit_oma as fit_oma
    from operando.pipeline import run as run
    from operando.report import Report as Report
    from operando.results import CheckRun as CheckRun
    from operando.results import Results as Results
    from operando.scaling import HybridModel as HybridModel
    from operando.scaling import scale_operational as scale_operational
    from operando.stabilization import Stabilization as Stabilization
    from operando.store import load as load
    from operando.structure import Model as Model
    from operando.structure.effects import Effect as Effect
    from operando.structure.effects import EffectKind as EffectKind
    from operando.structure.effects import Parameter as Parameter
    from operando.structure.effects import catalogue as catalogue
    from operando.structure.effects import parse_effect as parse_effect
    from operando.structure.effects import register as register
else:
    ModuleType = type(sys)

__version__ = "0.2.0"

_NAMES = {
    "operando.dof": ("Dof",),
    "operando.data": (
        "Channel",
        "Finding",
        "FrequencyAxis",
        "Frf",
        "Geometry",
        "ModalCoupling",
        "ModalModel",
        "ResidualTerms",
        "TimeRecord",
    ),
    "operando.errors": ("OperandoError",),
    "operando.io": ("Content", "read", "write_uff"),
    "operando.store": ("load",),
    "operando.results": ("CheckRun", "Results"),
    "operando.report": ("Report",),
    "operando.config": ("load_test",),
    "operando.frf": ("estimate_frf",),
    "operando.ema": ("fit_ema",),
    "operando.oma": ("fit_oma",),
    "operando.stabilization": ("Stabilization",),
    "operando.indicators": ("mac",),
    "operando.scaling": ("scale_operational", "HybridModel"),
    "operando.compare": ("compare", "Comparison", "ModelComparison"),
    "operando.structure.effects": ("Effect", "EffectKind", "Parameter", "catalogue", "parse_effect", "register"),
    "operando.structure": ("Model",),
    "operando.diagnosis": ("Diagnosis", "diagnose", "apply_effects"),
    "operando.pipeline": ("run",),
}
_WHERE = {name: module for module, names in _NAMES.items() for name in names}
_ROOMS = ("plots",)
"""Packages that are reached by their name without an import of their own."""

_CALLED = ("compare",)
"""Packages that can be called as the public function of their name."""

__all__ = ["__version__", *_WHERE]

if not TYPE_CHECKING:  # else a name that is not there would be of any type to a checker

    def __getattr__(name: str) -> Any:
        import importlib

        if name in (*_ROOMS, *_CALLED):
            return importlib.import_module(f"operando.{name}")
        if name in _WHERE:
            return _function(name)
        raise AttributeError(f"module 'operando' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_ROOMS])


def _function(name: str) -> Any:
    import importlib

    return getattr(importlib.import_module(_WHERE[name]), name)


class _CalledPackage(ModuleType):
    """A package that can be called as the function of its name: ``operando.compare(a, b)``, and ``operando.compare.error_map``.

    Neither hides the other, whichever was imported first. The function is looked for when it is asked for.
    """

    def __call__(self, *args: Any, **options: Any) -> Any:
        return _function(self.__name__.rpartition(".")[2])(*args, **options)

    @property
    def __doc__(self) -> Any:  # type: ignore[override]
        return _function(self.__name__.rpartition(".")[2]).__doc__

    @property
    def __signature__(self) -> Any:
        import inspect

        return inspect.signature(_function(self.__name__.rpartition(".")[2]))

    def __reduce__(self) -> Any:
        import importlib

        return importlib.import_module, (self.__name__,)


class _Package(ModuleType):
    """Makes packages that have a function of their name callable, as soon as they are loaded."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in _CALLED and value.__name__ == f"{__name__}.{name}":
            value.__class__ = _CalledPackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
