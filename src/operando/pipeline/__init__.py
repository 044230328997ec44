"""A test in, a results folder out: stages cached by the content of their inputs, resumable."""

from operando.pipeline.runner import STAGES, run
from operando.pipeline.summary import summary

__all__ = ["STAGES", "run", "summary"]
