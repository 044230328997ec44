"""Pages that are made from the code: test file, effects, findings, commands, API; and formulas without JavaScript."""
