"""`python -m bench COMMAND`."""

from bench.commands import app
from cutting_trainer.cli.main import run_app

if __name__ == '__main__':
    run_app(app, 'trainer bench')
