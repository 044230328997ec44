"""``python -m operando``: the command line."""

from operando.cli import main

if __name__ == "__main__":
    main(prog_name="operando")
