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
else:
    ModuleType = type(sys)

__version__ = "0.1.0"

_WHERE = {
    "Dof": "operando.dof",
    "Channel": "operando.data",
    "Finding": "operando.data",
    "FrequencyAxis": "operando.data",
    "Frf": "operando.data",
    "Geometry": "operando.data",
    "ModalModel": "operando.data",
    "ResidualTerms": "operando.data",
    "TimeRecord": "operando.data",
    "OperandoError": "operando.errors",
    "read": "operando.io",
    "write_uff": "operando.io",
    "load_test": "operando.config",
    "estimate_frf": "operando.frf",
    "fit_ema": "operando.ema",
    "fit_oma": "operando.oma",
    "scale_operational": "operando.scaling",
    "HybridModel": "operando.scaling",
    "compare": "operando.compare",
    "Comparison": "operando.compare",
    "Effect": "operando.effects",
    "EffectKind": "operando.effects",
    "Parameter": "operando.effects",
    "catalogue": "operando.effects",
    "parse_effect": "operando.effects",
    "register": "operando.effects",
    "Model": "operando.diagnose",
    "Diagnosis": "operando.diagnose",
    "diagnose": "operando.diagnosis",
    "apply_effects": "operando.diagnose",
    "run": "operando.pipeline",
}

__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        import importlib

        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'operando' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


class _Package(ModuleType):
    """Keeps ``operando.compare`` the function although a room of the same name exists (importing it would put the module there)."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in _WHERE and value.__name__ == f"{__name__}.{name}":
            if _WHERE[name] != value.__name__:
                return  # the function stands in another room, and is found there when it is asked for
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
