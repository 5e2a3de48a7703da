"""What a running session shows: one live line on a terminal, plain lines elsewhere."""

import json
import re
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from session.processes import Event

_STAMP = re.compile(r'^\[[A-Z]+\] \[[\d.]+\] \[[^]]*\]: ')
_STYLES = {'warning': 'yellow', 'died': 'bold red', 'killed': 'red'}


class SessionProgress:
    """Shows the events of a supervisor and how far the session is; a context manager.

    Args:
        console: to write to.
        nodes: how many are waited for.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def tell(self, event: Event) -> None:
        """Shows one event."""
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
            page = json.loads(event.text)['page']
            self._console.print(f'page: {page}', highlight=False, soft_wrap=True)
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
        """Shows how far the session is.

        Args:
            elapsed: [s].
            seconds: that it should last [s].
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
