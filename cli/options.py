"""Options and arguments that several commands have, declared once."""

from pathlib import Path
from typing import Annotated

import typer

from cutting_trainer.session.exit_status import Status

EXIT_STATUSES = 'Exit status: ' + '; '.join(f'{int(s)} {s.meaning}' for s in Status) + '.'

_SCENE = 'Name of a scene in config/scenes, or path of a scene file.'

BagArgument = Annotated[Path, typer.Argument(help='Folder of the bag.')]
SceneArgument = Annotated[str, typer.Argument(help=_SCENE)]
SceneOption = Annotated[str, typer.Option(help=_SCENE)]
Seed = Annotated[int, typer.Option(min=0, max=2**63 - 1, help='Seed of everything random.')]
Domain = Annotated[
    str,
    typer.Option(help='ROS domain; "free": one of its own; none: that of ROS_DOMAIN_ID, or 0.'),
]
AsJson = Annotated[
    bool, typer.Option('--json', help='Print the outcome as JSON on standard output.')
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        '--with',
        help='Change a key of the scene, as key=value; may be given again. The recorded hand then '
        'meets the changed tissue.',
    ),
]
Workers = Annotated[
    int, typer.Option(min=0, max=1024, help='Own workers; 0: one for each processor.')
]
Scheduler = Annotated[
    str,
    typer.Option(help='Address of a Dask scheduler whose workers compute, as tcp://host:8786.'),
]
