"""Run the command line: `python -m cutting_trainer.cli COMMAND`."""

from cutting_trainer.cli.main import main

main()
