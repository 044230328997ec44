"""A test in, a results folder out: stages cached by the content of their inputs, resumable."""

from operando.pipeline.runner import STAGES, lacking, run
from operando.pipeline.summary import summary

__all__ = ["STAGES", "lacking", "run", "summary"]
