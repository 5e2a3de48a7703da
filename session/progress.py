"""Progress of a running session: one live line on a terminal, plain lines elsewhere."""

import re
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from cutting_trainer.session.supervisor import Event
from cutting_trainer.session.terminal import settle

_STAMP = re.compile(r'^\[[A-Z]+\] \[[\d.]+\] \[[^]]*\]: ')
_MAX_LINK = 1000
_STYLES = {'warning': 'yellow', 'died': 'bold red', 'killed': 'red'}


class SessionProgress:
    """Show the events of a supervisor and the progress of the session; a context manager.

    Args:
        console: console to write to.
        nodes: number of nodes to wait for.
    """

    def __init__(self, console: Console, nodes: int) -> None:
        self._console = console
        self._nodes = nodes
        self._ready = 0
        self._phase = 'running'
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn('{task.description}'),
            BarColumn(bar_width=30),
            TextColumn('{task.fields[clock]}'),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task('starting', total=float(nodes), clock='')

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        settle(self._console)

    def show(self, event: Event) -> None:
        """Show one event."""
        text = escape(event.text)
        if event.kind == 'ready':
            self._ready += 1
            self._bar.update(
                self._task,
                description=f'{event.node} is ready',
                completed=self._ready,
                clock=f'{self._ready}/{self._nodes}',
            )
            self._plainly(f'{event.node} is ready')
        elif event.kind == 'message':
            for whose in ('page', 'instructor'):
                if page := event.content.get(whose):
                    link = escape(str(page)[:_MAX_LINK])
                    self._console.print(f'{whose}: {link}', highlight=False, soft_wrap=True)
        elif event.kind == 'phase':
            self._phase = text
            self._plainly(text)
        elif event.kind == 'ending':
            self._bar.update(self._task, description=text)
        else:
            if event.kind == 'warning':
                text = f'{event.node}: {escape(_STAMP.sub("", event.text))}'
            self._console.print(text, style=_STYLES[event.kind], highlight=False)

    def tick(self, elapsed: float, seconds: float) -> None:
        """Show the progress of the session.

        Args:
            elapsed: time since the start [s].
            seconds: nominal duration [s].
        """
        self._bar.update(
            self._task,
            description=self._phase,
            total=seconds,
            completed=elapsed,
            clock=f'{elapsed:.0f} of {seconds:.0f} s',
        )

    def _plainly(self, text: str) -> None:
        if not self._console.is_terminal:
            self._console.print(text, highlight=False)
