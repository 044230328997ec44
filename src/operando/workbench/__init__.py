"""The workbench: modes, effects, channels and runs of one test in the browser, on this machine alone."""

from operando.workbench.bench import Bench
from operando.workbench.serve import Served

__all__ = ["Bench", "Served"]
